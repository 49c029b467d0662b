"""The client that has episodes run, and what `smal run` makes of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from threading import Timer
from typing import cast

import pytest

from schemas.action import Action
from schemas.base import Message
from schemas.episode import Episode, Outcome
from schemas.rpc import ArmRequest, EndRequest, LoadReply, LoadRequest, ResetReply, ResetRequest
from services.cli.episodes.client import EpisodeClient, EpisodeRecord, check_world_of
from services.cli.options import Camera, camera_of_own_stack, world_of_stack
from services.cli.run import CHAIN, _check_models, _run_all, summarize
from services.cli.simulator_options import simulator_of_own_stack
from services.cli.stack.processes import Access
from services.expert.service import ExpertService
from services.kit.errors import JobError, UsageError
from services.kit.model_service import identity_of
from services.kit.node import Detail, Node, ServiceError
from services.kit.process import EXIT_FAILED, EXIT_USAGE
from services.kit.settings import ServiceSettings
from services.robot.episode import RunOutcome
from tests import corridor
from tests.services.cli.conftest import Smal
from tests.services.conftest import RunNode

REQUEST = ResetRequest(seed=3)
CAUSE = Message(robot="rescuebot", episode="e", tick=0, stamp_ns=0)


class FakeSimulator:
    """Begins an episode in the world "campus", with decisions of some kinds, and ends it at tick 4 when asked to."""

    decisions = (("follow", 4), ("look_around", None), ("guess", 5), ("stop", 5), ("look_around", None))
    outcome: Outcome = "found"
    stop_cause: str | None = "not_armed"
    attended = False
    judge = "task"

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
            "stop_cause": self.stop_cause, "emergency_stop": 7, "attended": self.attended,
            "judge": self.judge, "operator": True,
        }  # fmt: skip

    def reset(self, _request: ResetRequest) -> ResetReply:
        self.begun = True
        for tick, (kind, state) in enumerate(self.decisions):
            cause = CAUSE.model_copy(update={"tick": tick})
            self._node.publish(Action.after(cause, kind=kind, state=state, atoms=("left",), arrived=kind == "goal"))
        return ResetReply(episode="e", world="campus", route=((0.0, 0.0), (1.0, 0.0)), speed_m_s=2.0, found_m=5.0)

    def end(self, request: EndRequest) -> None:
        self.ended.append("found" if request.found else request.episode)
        last = CAUSE.model_copy(update={"tick": 4})
        self._node.publish(
            Episode.after(
                last, event="ended", purpose="run", driver="policy", world="campus", seed=3, outcome=self.outcome
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


def test_decisions_without_a_state_and_before_the_end_are_counted(
    simulator: FakeSimulator, client: EpisodeClient
) -> None:
    record = client.run(REQUEST, done=lambda: bool(client._record and len(client._record.decisions) == 5))
    assert list(record.decisions.values()) == ["follow", "look_around", "guess", "stop"]
    assert record.unknown == 1
    assert simulator.ended == ["e"]


@pytest.mark.parametrize(("truth", "outcome"), [("found", "found"), ("aborted", "false_goal")])
def test_a_robot_that_says_that_it_has_arrived_is_judged(
    truth: Outcome, outcome: RunOutcome, simulator: FakeSimulator, client: EpisodeClient
) -> None:
    simulator.decisions, simulator.outcome = (("follow", 4), ("goal", 9)), truth
    record = client.run(REQUEST)
    assert (record.outcome, record.arrived, simulator.ended) == (outcome, True, ["e"])


def test_where_the_operator_judges_they_are_waited_for(simulator: FakeSimulator, client: EpisodeClient) -> None:
    simulator.decisions, simulator.judge = (("goal", 9),), "operator"
    record = client.run(REQUEST)
    assert (record.outcome, simulator.ended) == ("found", ["found"])


@pytest.mark.parametrize(
    ("cause", "attended", "armed"),
    [("not_armed", False, [7]), ("not_armed", True, []), ("emergency_stop", False, []), (None, False, [])],
)
def test_who_begins_a_run_arms_a_robot_that_was_just_started_and_no_other(
    cause: str | None, attended: bool, armed: list[int], simulator: FakeSimulator, client: EpisodeClient
) -> None:
    simulator.stop_cause, simulator.attended, simulator.decisions = cause, attended, (("goal", 9),)
    for _ in range(2):
        client.run(REQUEST)
    assert simulator.armed == armed, "once: one that was started again meanwhile is armed by a person"


def test_only_a_robot_that_drives_itself_arrives(simulator: FakeSimulator, client: EpisodeClient) -> None:
    simulator.decisions = (("goal", 9), ("goal", 9), ("follow", 4))
    request = ResetRequest(seed=3, purpose="drive", driver="expert")
    record = client.run(request, done=lambda: bool(client._record and len(client._record.decisions) == 3))
    assert (record.outcome, record.arrived) == ("found", False)


def test_another_world_than_asked_for_is_an_error_and_its_episode_is_ended(
    simulator: FakeSimulator, client: EpisodeClient
) -> None:
    with pytest.raises(JobError, match="the stack runs campus, not yard; start it with --world yard"):
        client.run(REQUEST, on_begin=partial(check_world_of, wanted="yard"))
    assert simulator.ended == ["e"]


def test_an_aborted_run_is_an_error_after_the_finished_ones(settings: ServiceSettings, tmp_path: Path) -> None:
    class Client:
        def run(self, request: ResetRequest, **_: object) -> EpisodeRecord:
            return EpisodeRecord(request, outcome="found" if request.seed < 3 else "aborted")

    records: list[EpisodeRecord] = []
    requests = [ResetRequest(seed=seed) for seed in (1, 2, 3, 4)]
    access = Access(settings, lambda: None, tmp_path)
    with pytest.raises(JobError) as caught:
        records.extend(_run_all(cast("EpisodeClient", Client()), requests, access, "yard"))
    assert str(caught.value) == (
        f"run with seed 3: no command came; see the logs of recognition and policy ({tmp_path})"
    )
    assert [one["seed"] for one in summarize("yard", records)["episodes"]] == [1, 2]  # type: ignore[attr-defined]


@pytest.mark.parametrize("others", ["fedcba9876543210", None])
@pytest.mark.parametrize("wrong", CHAIN)
def test_results_of_another_model_are_an_error(
    wrong: str, others: str | None, settings: ServiceSettings, run_node: RunNode, client: EpisodeClient
) -> None:
    has: dict[str, str | None] = dict.fromkeys(CHAIN, "0123456789abcdef")
    for service in CHAIN:
        node = Node(service, settings)
        node.detail = lambda service=service: {"checksum": has[service]}  # type: ignore[misc]
        run_node(node)
    _check_models(client, "0123456789abcdef", None)
    has[wrong] = others
    with pytest.raises(JobError, match=f"^{wrong} has model {others or 'none'}, not 0123456789abcdef"):
        _check_models(client, "0123456789abcdef", None)


@pytest.mark.parametrize(
    ("flags", "start", "kidnap_tick"),
    [((), "start", None), (("--start", "anywhere"), "anywhere", None), (("--kidnap", "5"), "start", 5)],
)
def test_start_and_kidnap_reach_the_simulator(
    flags: tuple[str, ...], start: str, kidnap_tick: int | None, settings: ServiceSettings, run_node: RunNode,
    tmp_path: Path, smal: Smal,
) -> None:  # fmt: skip
    asked: list[ResetRequest] = []
    loaded: list[LoadRequest] = []
    path = corridor.save_model(tmp_path / "mapped.smal")
    identity = identity_of(corridor.model())

    def reset(request: ResetRequest) -> ResetReply:
        asked.append(request)
        raise ServiceError("enough seen")

    def load(request: LoadRequest) -> LoadReply:
        loaded.append(request)
        return LoadReply(scheme="filter", stride=1)

    fakes = {name: Node(name, settings) for name in ("robot", "features", *CHAIN)}
    fakes["robot"].serve("reset", ResetRequest, reset)
    fakes["features"].detail = lambda: {"fingerprint": corridor.FEATURES.fingerprint}
    for name in CHAIN:
        fakes[name].detail = lambda: {"checksum": identity, "root": str(tmp_path)}
        fakes[name].serve("load", LoadRequest, load)
    for node in fakes.values():
        run_node(node)
    status, _, said = smal("run", "--model", str(path), "--world", "yard", "--episodes", "1", *flags,
                           "--connect", settings.router)  # fmt: skip
    assert (status, said.splitlines()[-1]) == (EXIT_FAILED, "smal: robot reset: enough seen")
    assert [(one.start, one.kidnap_tick, one.purpose) for one in asked] == [(start, kidnap_tick, "run")]
    assert loaded == [LoadRequest(model="mapped.smal")] * 2


def test_a_model_that_the_stack_does_not_read_is_one_line_that_says_what_to_do(
    settings: ServiceSettings, run_node: RunNode, tmp_path: Path, smal: Smal
) -> None:
    path, root = corridor.save_model(tmp_path / "mapped.smal"), tmp_path / "root"
    for name in CHAIN:
        node = Node(name, settings)
        node.detail = lambda: {"root": str(root)}
        run_node(node)
    status, _, said = smal("run", "--model", str(path), "--world", "yard", "--connect", settings.router)
    assert status == EXIT_USAGE
    assert said == (
        f"smal: --model {path}: the recognition of this stack takes only what is below {root}; put it there, or start "
        "the stack with --root\n"
    )
    status, _, said = smal("run", "--model", str(path), "--modalities", "color", "--connect", settings.router)
    assert (status, said.split(":")[1]) == (EXIT_USAGE, " --modalities")


def test_what_a_running_stack_has_cannot_be_chosen() -> None:
    assert simulator_of_own_stack("yard", None, "tcp/127.0.0.1:1").camera == Camera(1024, 768)
    with pytest.raises(UsageError, match=r"^--shake: with --connect .* `smal up`$"):
        simulator_of_own_stack("yard", None, "tcp/127.0.0.1:1", shake=0.0)


def test_camera_belongs_to_the_stack_that_is_started() -> None:
    assert camera_of_own_stack(None, "tcp/127.0.0.1:1") == Camera(1024, 768)
    assert camera_of_own_stack("64x48", None) == Camera(64, 48)
    with pytest.raises(UsageError, match="--connect"):
        camera_of_own_stack("64x48", "tcp/127.0.0.1:1")


def test_with_connect_the_robot_may_be_anywhere_unless_a_world_is_named() -> None:
    running = "tcp/127.0.0.1:1"
    assert world_of_stack(None, None) == ("campus", "campus")
    assert world_of_stack("yard", running) == ("yard", "yard")
    assert world_of_stack(None, running) == ("campus", None)
    check_world_of(ResetReply(episode="e", world="turtlebot4", speed_m_s=0.3), None)
    with pytest.raises(UsageError, match=r"^--world nowhere: "):
        world_of_stack("nowhere", running)


def test_the_expert_cannot_drive_where_nobody_knows_the_way() -> None:
    with pytest.raises(JobError, match="turtlebot4: nobody knows the way there; demonstrate it by hand"):
        ExpertService().begin(ResetReply(episode="e", world="turtlebot4", speed_m_s=0.3))
