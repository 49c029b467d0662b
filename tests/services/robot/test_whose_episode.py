"""Ownership of an episode: beginning and ending it, resuming after a stop or a takeover."""

from typing import get_args

import pytest

from schemas.command import StopCause
from schemas.rpc import ArmRequest, EndRequest, ResumeRequest
from services.kit.node import ServiceError
from services.robot.runner import CLIENT_S
from services.robot.task import OperatorsTask
from tests.services.robot import gating
from tests.services.robot.driving import Runner, advance, answer, begin, reset, runner_of
from tests.services.robot.line import Clock, LineBody


def beat(
    runner: Runner, session: str, sequence: int = 0, *, operator: bool = False, present: bool = True
) -> None:
    answers = runner.pulse().number if operator else None
    runner.hear(gating.beat(session, sequence, answers, present=present))


@pytest.mark.parametrize("cause", get_args(StopCause))
@pytest.mark.parametrize("driver", ["policy", "expert", "teleop"])
def test_stopped_robot_begins_no_episode_until_it_is_armed(cause: StopCause, driver: str) -> None:
    runner, _ = begin(LineBody(Clock()))
    runner.gate.stop(cause)
    episode = runner.running
    with pytest.raises(ServiceError, match=r"smal teleop \(n\)"):
        reset(runner, driver=driver)
    assert runner.running is episode, "a refused reset ends nothing"
    with pytest.raises(ServiceError, match="another stop was latched since"):
        runner.arm(ArmRequest(stop=runner.gate.latched_stop + 1))
    runner.arm(ArmRequest(stop=runner.gate.latched_stop))
    reset(runner, driver="teleop")
    assert runner.running is not episode


def test_after_a_stop_the_driver_goes_on_when_it_is_told_to() -> None:
    clock = Clock()
    body = LineBody(clock)
    runner, _ = begin(body, mode="realtime")
    answer(runner)
    advance(runner, clock, 0.1)
    runner.gate.stop()
    advance(runner, clock, 0.1)
    runner.arm(ArmRequest(stop=runner.gate.latched_stop))
    answer(runner)
    advance(runner, clock, 0.1)
    assert body.orders[-1][0] == "stop"
    with pytest.raises(ServiceError, match="a person has taken over"):
        reset(runner, driver="policy")
    run = runner.running
    with pytest.raises(
        ServiceError, match="another episode has begun, or the person has commanded since"
    ):
        runner.resume(ResumeRequest(episode="other", tick=9))
    runner.resume(ResumeRequest(episode=run.id, tick=run.tick))
    answer(runner)
    advance(runner, clock, 0.04)
    assert body.orders[-1][0] == "forward"


def test_stop_between_episodes_is_released_by_any_person() -> None:
    runner, _ = begin(LineBody(Clock()), mode="realtime")
    runner.end()
    runner.gate.stop()
    runner.arm(ArmRequest(stop=runner.gate.latched_stop))
    with pytest.raises(ServiceError, match="a person has taken over"):
        reset(runner)
    runner.resume(ResumeRequest(episode="none", tick=0))
    reset(runner)
    with pytest.raises(ServiceError, match="another episode has begun"):
        runner.resume(ResumeRequest(episode="none", tick=0))


def test_episode_of_a_present_client_is_protected() -> None:
    clock = Clock()
    runner, _ = begin(LineBody(clock), session="a", mode="realtime")
    run = runner.running
    for k in range(10):
        clock.now_s += CLIENT_S / 2
        beat(runner, "a", k)
        beat(runner, "b", k)
        for session in ("b", ""):
            with pytest.raises(ServiceError, match="belongs to another client"):
                reset(runner, session=session)
    assert runner.running is run
    assert runner.gate.stop_cause is None
    reset(runner, session="a")
    assert runner.running is not run, "whose it is may begin the next"
    beat(runner, "a")
    clock.now_s += CLIENT_S + 0.01
    beat(runner, "a")  # it comes twice, and counts once
    reset(runner, session="b")
    beat(runner, "b", 10)
    beat(runner, "b", 11, present=False)
    reset(runner, session="c")


def test_person_after_a_takeover_begins_an_episode() -> None:
    runner, _ = begin(LineBody(Clock()), session="a", mode="realtime")
    with pytest.raises(ServiceError, match="belongs to another client"):
        reset(runner, session="o", driver="teleop")
    answer(runner, "stop", source="teleop")
    reset(runner, session="o", driver="teleop")
    assert runner.running.request.session == "o"


HELD = r"only the operator \(at desk\) may do that"


def taken_over() -> Runner:
    """Return a runner of client a's run, from which operator o has taken over."""
    runner, _ = begin(LineBody(Clock()), session="a", mode="realtime")
    beat(runner, "o", operator=True)
    answer(runner, "stop", source="teleop", session="o")
    assert runner.gate.taken_over
    return runner


def test_only_the_operator_begins_an_episode_after_a_takeover() -> None:
    runner = taken_over()
    run = runner.running
    for session in ("a", "b", ""):
        for driver in ("teleop", "policy", "expert"):
            with pytest.raises(ServiceError, match=HELD):
                reset(runner, session=session, driver=driver)
    assert (runner.running, runner.gate.taken_over) == (run, True)


def test_the_end_of_its_episode_does_not_undo_a_takeover() -> None:
    runner = taken_over()
    with pytest.raises(ServiceError, match=HELD):
        runner.end_by(EndRequest(episode=runner.running.id, session="b"))
    runner.end_by(EndRequest(episode=runner.running.id, session="a"))
    with pytest.raises(ServiceError, match=HELD):
        reset(runner, session="a", driver="teleop")
    with pytest.raises(ServiceError, match=HELD):
        reset(runner, session="a")
    runner.resume(ResumeRequest(episode="none", tick=0, session="o"))
    reset(runner, session="a")


@pytest.mark.parametrize("how", ["leaves", "is lost"])
def test_takeover_ends_when_its_operator_is_gone(how: str) -> None:
    runner = taken_over()
    if how == "leaves":
        beat(runner, "o", 1, operator=True, present=False)
    else:
        runner.gate.watch(1000.0)
        runner.arm(ArmRequest(stop=runner.gate.latched_stop))
    with pytest.raises(ServiceError, match="a person has taken over; resume"):
        reset(runner, session="a")
    reset(runner, session="b", driver="teleop")


def test_episode_that_an_operator_drives_is_protected() -> None:
    runner, _ = begin(LineBody(Clock()), session="o", driver="teleop", mode="realtime")
    beat(runner, "o", operator=True)
    run = runner.running
    with pytest.raises(ServiceError, match=HELD):
        runner.end_by(EndRequest(episode=run.id, session="b"))
    with pytest.raises(ServiceError, match=HELD):
        reset(runner, session="b", driver="teleop")
    with pytest.raises(ServiceError, match="belongs to another client"):
        reset(runner, session="b")
    runner.end_by(EndRequest(episode=run.id, session="o", found=True))
    reset(runner, session="b")
    assert runner.running is not None, "an operator who looks on holds up no program"
    assert runner.running.request.session == "b"


def test_lost_operator_stops_the_robot_in_every_mode() -> None:
    for mode in ("lockstep", "realtime"):
        clock = Clock()
        runner, _ = begin(LineBody(clock), mode=mode)
        beat(runner, "o", operator=True)
        clock.now_s += 0.05 + runner.gate.absent_s
        list(runner.poll())
        assert runner.gate.stop_cause == "operator_lost"


def test_goal_is_found_when_the_operator_reports_it() -> None:
    runner = runner_of(LineBody(Clock()), task=OperatorsTask())
    reset(runner, purpose="drive", driver="teleop")
    run = runner.running
    beat(runner, "o", operator=True)
    with pytest.raises(ServiceError, match=HELD):
        runner.end_by(EndRequest(episode=run.id, found=True, session="x"))
    with pytest.raises(ServiceError, match="episode other is not running"):
        runner.end_by(EndRequest(episode="other", found=True, session="o"))
    (ended,) = runner.end_by(EndRequest(episode=run.id, found=True, session="o"))
    assert (ended.outcome, ended.judge) == ("found", "operator")
    with pytest.raises(ServiceError, match="is not running"):
        runner.end_by(EndRequest(episode=run.id))
