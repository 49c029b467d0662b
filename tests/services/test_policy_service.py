"""The policy by the filter, its handler alone: a belief in, an action and a command out."""

from pathlib import Path

import pytest

from schemas.base import Message
from schemas.command import CommandApplied, Reason
from schemas.state import State
from services.kit.model_service import LoadedModel
from services.policy.service import PolicyService
from tests import corridor
from tests.places import places
from tests.services.chain import state, wheels, with_model


@pytest.fixture(scope="module")
def papers_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "paper.smal"
    corridor.paper_model().save(path)
    return path


@pytest.fixture
def policy(model: Path) -> PolicyService:
    return with_model(PolicyService(), model)


def belief(tick: int, model: Path, keyframe: int = 5, turned_rad: float = 0.0, lost: float = 0.0,
           episode: str = "e", left_m: float = 0.0) -> State:  # fmt: skip
    status = "unknown" if lost > 0.5 else "recognized"
    return state(
        tick,
        model,
        episode,
        status=status,
        places=places((keyframe, 0.0, left_m, turned_rad, 1.0)),
        lost=lost,
        cosine=0.8,
        tracked_m=1.0 + tick,
    )


def made(answer: list[Message]) -> tuple[str, int | None, str]:
    """Return kind and state of the decision, and the atom of the command, which are all that was said."""
    action, command = answer
    assert (action.atoms, command.source, command.tick) == ((command.atom,), "policy", action.tick)
    return action.kind, action.state, command.atom


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ({}, ("follow", 5, "forward")),
        ({"turned_rad": 0.5}, ("follow", 5, "right")),
        ({"turned_rad": -0.5}, ("follow", 5, "left")),
        ({"left_m": 1.0}, ("follow", 5, "right")),
        ({"keyframe": -1}, ("goal", -1, "stop")),
        ({"lost": 0.9}, ("look_around", None, "left")),
    ],
    ids=str,
)
def test_a_belief_becomes_an_action_and_a_command(
    policy: PolicyService,
    model: Path,
    where: dict[str, float],
    expected: tuple[str, int | None, str],
) -> None:
    last = len(corridor.model().mapped.keyframes) - 1
    if "keyframe" in where:
        where = {"keyframe": last}
        expected = (expected[0], last, expected[2])
    assert made(policy.handle(belief(0, model, **where))) == expected


def test_how_long_its_commands_take_is_heard_from_the_actuator(model: Path) -> None:
    turns = {}
    for delay_ms in (0, 60):
        service = with_model(PolicyService(), model)
        for tick in range(12):
            told = {
                "atom": "left",
                "linear": 0.0,
                "angular": 1.0,
                "reason": "command",
                "answered_tick": tick,
            }
            for source, ms in (("policy", delay_ms), ("teleop", 90)):
                service.see_applied(
                    CommandApplied.after(
                        belief(tick, model), **told, source=source, delay_ns=ms * 1_000_000
                    )
                )
        service.handle(belief(12, model, turned_rad=-0.15))
        command = service.handle(belief(13, model, turned_rad=-0.07))[1]
        turns[delay_ms] = command.angular
    assert turns[0] > turns[60]


@pytest.mark.parametrize(("reason", "backs_off"), [("obstacle", True), ("latched_stop", False)])
def test_robot_backs_off_when_its_actuator_reports_obstacles(
    policy: PolicyService, model: Path, reason: Reason, *, backs_off: bool
) -> None:
    commands = []
    for tick in range(30):
        here = belief(tick, model)
        x_m = 0.1 * min(tick, 15)  # An obstacle stops it there.
        policy.obstacles.store_odometry(wheels(tick, (x_m, 0.0, 0.0)))
        _, command = policy.handle(here)
        commands.append(command)
        if tick >= 15:
            policy.see_applied(
                CommandApplied.after(
                    here, source="policy", reason=reason, atom="stop", linear=0.0, angular=0.0
                )
            )
    assert commands[15].linear > 0.0
    assert (commands[-1].linear < 0.0) == backs_off


def test_repeated_state_has_the_same_answer(policy: PolicyService, model: Path) -> None:
    answer = policy.handle(belief(0, model, lost=0.9))
    assert all(policy.handle(belief(0, model, lost=0.9)) == answer for _ in range(500))
    assert made(policy.handle(belief(1, model, lost=0.9)))[0] == "look_around"


def test_a_new_episode_starts_afresh(policy: PolicyService, model: Path) -> None:
    last = len(corridor.model().mapped.keyframes) - 1
    assert made(policy.handle(belief(0, model, last)))[0] == "goal"
    # It has arrived, and stays; the next episode begins.
    assert made(policy.handle(belief(1, model)))[0] == "goal"
    assert made(policy.handle(belief(0, model, episode="next"))) == ("follow", 5, "forward")


def test_no_robot_stands_between_two_maps(
    policy: PolicyService, model: Path, tmp_path: Path
) -> None:
    def atom(tick: int, of: Path) -> str:
        command = policy.handle(belief(tick, of))[-1]
        return command.atom

    renewed = corridor.save_renewed(tmp_path / "renewed.smal")
    policy.load(LoadedModel.read(renewed))
    assert [atom(0, model), atom(1, model)] == ["forward"] * 2  # Recognition has the one before.
    assert [atom(2, renewed), atom(3, renewed)] == ["forward"] * 2
    assert atom(4, model) == "stop"  # There is no way back.
    policy.load(LoadedModel.read(model))
    assert [atom(5, renewed), atom(6, model), atom(7, renewed)] == ["forward", "forward", "stop"]


@pytest.mark.parametrize(
    "fields", [{"status": "recognized", "state": 2}, {"status": "unknown"}], ids=str
)
def test_it_stops_for_a_state_of_another_scheme(
    policy: PolicyService, model: Path, papers_model: Path, fields: dict[str, object]
) -> None:
    papers = with_model(PolicyService(), papers_model)
    for service, theirs in ((policy, state(0, model, **fields)), (papers, belief(0, papers_model))):
        (command,) = service.handle(theirs)
        assert command.atom == "stop"


def test_it_stops_for_a_place_that_its_model_does_not_have(
    policy: PolicyService, model: Path, papers_model: Path
) -> None:
    papers = with_model(PolicyService(), papers_model)
    beyond = state(0, papers_model, status="recognized", state=1_000_000)
    for service, wrong in ((policy, belief(0, model, keyframe=1_000_000)), (papers, beyond)):
        (command,) = service.handle(wrong)
        assert command.atom == "stop"
    assert made(policy.handle(belief(1, model)))[2] == "forward"
