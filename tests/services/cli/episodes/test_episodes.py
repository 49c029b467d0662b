"""The client that has episodes run, and what `smal run` makes of them."""

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from threading import Timer

import pytest

from schemas.action import Action
from schemas.base import Message
from schemas.command import CommandApplied
from schemas.episode import Episode, Outcome
from schemas.rpc import ArmRequest, EndRequest, LoadReply, LoadRequest, ResetReply, ResetRequest
from services.cli.episodes.client import EpisodeClient
from services.cli.run import CHAIN, _check_models
from services.kit.errors import JobError
from services.kit.model_service import identity_of
from services.kit.node import Detail, Node, ServiceError
from services.kit.process import EXIT_FAILED
from services.kit.settings import ServiceSettings
from smal.features import FeatureSettings
from tests import corridor
from tests.services.cli.conftest import Mistake, Smal
from tests.services.conftest import RunNode

REQUEST = ResetRequest(seed=3)
CAUSE = Message(robot="rescuebot", episode="e", tick=0, stamp_ns=0)


class FakeSimulator:
    """Begins an episode in the world "campus", with decisions of some kinds, and ends it at tick 4 when asked to."""

    decisions = (
        ("follow", 4), ("look_around", None), ("guess", 5), ("stop", 5), ("look_around", None),
    )  # fmt: skip
    outcome: Outcome = "found"
    stop_cause: str | None = "not_armed"
    attended = False
    judge = "task"
    fault: str | None = None
    operator = True
    route: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1.0, 0.0))

    def __init__(self, node: Node) -> None:
        self._node = node
        self.ended: list[str] = []
        self.armed: list[int] = []
        self.begun = False
        node.serve("arm", ArmRequest, lambda request: self.armed.append(request.stop))
        node.serve("reset", ResetRequest, self.reset)
        node.serve("end", EndRequest, self.end)
        node.detail = self.detail

    def detail(self) -> Detail:
        """Tell how it is; an operator who is asked says after a moment that the goal is found."""
        found = EndRequest(episode="e", found=True)
        if self.judge == "operator" and self.begun:
            Timer(0.2, self.end, (found,)).start()
        return {
            "stop_cause": self.stop_cause, "latched_stop": 7, "attended": self.attended,
            "judge": self.judge, "operator": self.operator, "fault": self.fault,
        }  # fmt: skip

    def reset(self, _request: ResetRequest) -> ResetReply:
        self.begun = True
        if self.fault is not None:
            stop = {"latched_stop": 8, "stop_cause": "fault", "reason": "latched_stop"}
            still = {"atom": "stop", "linear": 0.0, "angular": 0.0, "source": None}
            self._node.publish(CommandApplied.after(CAUSE, **still, **stop))
        for tick, (kind, state) in enumerate(self.decisions):
            cause = CAUSE.model_copy(update={"tick": tick})
            self._node.publish(
                Action.after(
                    cause,
                    kind=kind,
                    state=state,
                    atoms=("left",),
                    says="found" if kind == "goal" else None,
                )
            )
        return ResetReply(episode="e", world="campus", route=self.route, speed_m_s=2.0, found_m=5.0)

    def end(self, request: EndRequest) -> None:
        self.ended.append("found" if request.found else request.episode)
        last = CAUSE.model_copy(update={"tick": 4})
        self._node.publish(
            Episode.after(
                last,
                event="ended",
                purpose="run",
                driver="policy",
                world="campus",
                seed=3,
                outcome=self.outcome,
            )
        )


@pytest.fixture
def simulator(settings: ServiceSettings, run_node: RunNode) -> FakeSimulator:
    node = Node("robot", settings)
    fake = FakeSimulator(node)
    run_node(node)
    return fake


@pytest.fixture
def client(settings: ServiceSettings) -> Iterator[EpisodeClient]:
    """Give a client that has episodes run, in place of the bus alone."""
    with closing(EpisodeClient("test", settings)) as client:
        client.node.bus.wait_connected(5.0)
        yield client


@pytest.mark.parametrize(("truth", "outcome"), [("found", "found"), ("aborted", "false_goal")])
def test_a_robot_that_says_that_it_has_arrived_is_judged(
    truth: Outcome, outcome: Outcome, simulator: FakeSimulator, client: EpisodeClient
) -> None:
    simulator.decisions = (("follow", 4), ("goal", 9))
    simulator.outcome = truth
    record = client.run(REQUEST)
    assert (record.outcome, record.said, simulator.ended) == (outcome, "found", ["e"])


def test_where_the_operator_judges_they_are_waited_for(
    simulator: FakeSimulator, client: EpisodeClient
) -> None:
    simulator.decisions = (("goal", 9),)
    simulator.judge = "operator"
    record = client.run(REQUEST)
    assert (record.outcome, simulator.ended) == ("found", ["found"])


@pytest.mark.parametrize(
    ("cause", "attended", "armed"),
    [
        ("not_armed", False, [7]),
        ("not_armed", True, []),
        ("emergency_stop", False, []),
        (None, False, []),
    ],
)
def test_run_arms_only_the_robot_that_it_started(
    cause: str | None,
    attended: bool,
    armed: list[int],
    simulator: FakeSimulator,
    client: EpisodeClient,
) -> None:
    simulator.stop_cause = cause
    simulator.attended = attended
    simulator.decisions = (("goal", 9),)
    for _ in range(2):
        client.run(REQUEST)
    assert simulator.armed == armed, (
        "once: one that was started again meanwhile is armed by a person"
    )


def test_run_fails_at_once_when_the_body_fails(
    simulator: FakeSimulator, client: EpisodeClient
) -> None:
    simulator.fault = "the wheels do not answer"
    simulator.operator = False
    with pytest.raises(JobError, match="the robot's body has failed: the wheels do not answer"):
        client.run(REQUEST)
    assert simulator.ended == ["e"]


def test_episode_is_ended_when_its_world_is_another(
    simulator: FakeSimulator, client: EpisodeClient
) -> None:
    with pytest.raises(
        JobError, match="the stack runs campus, not yard; start it with --world yard"
    ):
        client.run(REQUEST, world="yard")
    assert simulator.ended == ["e"]


@pytest.mark.parametrize("things", [(((1e6, 0.0),),), (((0.0, 0.0),) * 101,), ((),) * 101])
def test_things_that_no_report_could_show_are_an_error(
    things: tuple[tuple[tuple[float, float], ...], ...], settings: ServiceSettings, run_node: RunNode,
    client: EpisodeClient,
) -> None:  # fmt: skip
    robot = Node("robot", settings)
    said = ResetReply(episode="e", world="campus", speed_m_s=2.0).model_copy(
        update={"things": things}
    )
    robot.serve("reset", ResetRequest, lambda _request: said)
    run_node(robot)
    with pytest.raises(JobError, match="robot reset: invalid reply: things"):
        client.run(REQUEST)


@pytest.mark.parametrize("others", ["fedcba9876543210", None])
@pytest.mark.parametrize("wrong", CHAIN)
def test_results_of_another_model_are_an_error(
    wrong: str,
    others: str | None,
    settings: ServiceSettings,
    run_node: RunNode,
    client: EpisodeClient,
) -> None:
    has: dict[str, str | None] = dict.fromkeys(CHAIN, "0123456789abcdef")
    for service in CHAIN:
        node = Node(service, settings)
        node.detail = lambda service=service: {"checksum": has[service]}  # type: ignore[misc]
        run_node(node)
    _check_models(client.node.bus, "0123456789abcdef", None)
    has[wrong] = others
    with pytest.raises(
        JobError, match=f"^{wrong}: model is {others or 'none'}, not 0123456789abcdef"
    ):
        _check_models(client.node.bus, "0123456789abcdef", None)


class FakeStack:
    """A stack that `smal run` may use: it loads any model, and begins `begins` episodes."""

    def __init__(
        self, settings: ServiceSettings, run_node: RunNode, root: Path, features: FeatureSettings
    ) -> None:
        self.asked: list[ResetRequest] = []
        self.loaded: list[LoadRequest] = []
        self.begins = 0
        self._robot = Node("robot", settings)
        self._robot.serve("reset", ResetRequest, self.reset)
        nodes = {name: Node(name, settings) for name in ("features", *CHAIN)}
        nodes["features"].detail = lambda: {
            "fingerprint": features.fingerprint,
            "modalities": "color hog",
        }
        for name in CHAIN:
            nodes[name].detail = lambda: {
                "checksum": identity_of(corridor.model()),
                "root": str(root),
            }
            nodes[name].serve("load", LoadRequest, self.load)
        for node in (self._robot, *nodes.values()):
            run_node(node)

    def reset(self, request: ResetRequest) -> ResetReply:
        """Begin an episode that ends at once: the first ones find the victim, the next is aborted."""
        self.asked.append(request)
        if len(self.asked) > self.begins + 1:
            raise ServiceError("enough seen")
        outcome: Outcome = "found" if len(self.asked) <= self.begins else "aborted"
        last = CAUSE.model_copy(update={"tick": 4, "episode": f"e{len(self.asked)}"})
        told = {
            "purpose": "run",
            "driver": "policy",
            "world": "yard",
            "seed": request.seed,
            "outcome": outcome,
        }
        Timer(0.2, lambda: self._robot.publish(Episode.after(last, event="ended", **told))).start()
        return ResetReply(episode=last.episode, world="yard", speed_m_s=2.0)

    def load(self, request: LoadRequest) -> LoadReply:
        """Note what is loaded."""
        self.loaded.append(request)
        return LoadReply(scheme="filter", stride=1)


@pytest.mark.parametrize(
    ("flags", "start", "kidnap_tick"),
    [(("--start", "anywhere"), "anywhere", None), (("--kidnap", "5"), "start", 5)],
)
def test_finished_runs_are_written_when_a_later_run_fails(
    flags: tuple[str, ...], start: str, kidnap_tick: int | None, settings: ServiceSettings, run_node: RunNode,
    tmp_path: Path, smal: Smal,
) -> None:  # fmt: skip
    stack = FakeStack(settings, run_node, tmp_path, corridor.FEATURES)
    stack.begins = 2
    path = corridor.save_model(tmp_path / "mapped.smal")
    more = ("--episodes", 4, "--connect", settings.router, "--json", tmp_path / "runs.json", *flags)
    status, _, said = smal("run", "--model", path, "--world", "yard", *more)
    last = "smal: run with seed 3: no command received; see the logs of recognition and policy"
    assert (status, said.splitlines()[-1]) == (EXIT_FAILED, last)
    assert [(one.seed, one.start, one.kidnap_tick, one.purpose) for one in stack.asked] == [
        (seed, start, kidnap_tick, "run") for seed in (1, 2, 3)
    ]
    assert stack.loaded == [LoadRequest(model="mapped.smal")] * 2
    written = json.loads((tmp_path / "runs.json").read_text())
    assert [(one["seed"], one["outcome"]) for one in written["episodes"]] == [
        (1, "found"),
        (2, "found"),
    ]
    assert written["success_rate"] == 1.0


def test_run_is_refused_when_model_has_other_features(
    settings: ServiceSettings, run_node: RunNode, tmp_path: Path, mistake: Mistake
) -> None:
    stack = FakeStack(settings, run_node, tmp_path, FeatureSettings())
    path = corridor.save_model(tmp_path / "mapped.smal")
    said = mistake(
        EXIT_FAILED, "run", "--model", path, "--world", "yard", "--connect", settings.router
    )
    names = ",".join(corridor.FEATURES.modalities)
    assert (
        f"uses the features {names}, but the stack computes color,hog; start it with `smal up --mod"
        in said
    )
    assert stack.asked == []
