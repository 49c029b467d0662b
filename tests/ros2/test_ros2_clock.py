"""The clock of another machine: an old frame is never believed to be new."""

import math
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from services.kit.node import ServiceError
from services.robot.gate import MAX_AGE_S
from services.ros2.clock import DRIFT, LEAP_S, LEARN_S, StampedClock
from tests.ros2.rig import AHEAD_S, BEGIN, Rig

FRAME_S = 0.1  # From frame to frame.


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path).begun()


def fresh(rig: Rig) -> bool:
    return rig.clock.now_s - rig.body.look(1).captured_s < MAX_AGE_S


@given(
    st.floats(-1e6, 1e6),
    st.lists(st.tuples(st.floats(0.001, 0.2), st.floats(0.0, 0.2)), min_size=2, max_size=50),
)
def test_age_is_at_least_the_delay_and_at_most_the_round_trip(
    ahead: float, trips: list[tuple[float, float]]
) -> None:
    clock = StampedClock()
    least = math.inf
    leaps = 0
    for number, (delay, there) in enumerate(trips):
        made = 1000.0 + number * 0.3
        told = clock.made_s(made + ahead, made + delay, delay + there)
        # After a leap, as which a link that became fast counts, the bounds are of later messages.
        least = there if clock.leaps > leaps else min(least, there)
        leaps = clock.leaps
        drift = DRIFT * 0.3 * (number + 1)
        assert told is not None
        assert made - least - drift - 1e-6 <= told <= made + 1e-6


def test_frames_become_old_when_the_link_becomes_slow() -> None:
    clock = StampedClock()
    assert clock.made_s(0.0, 0.01, 0.02) == pytest.approx(-0.01)
    for number in range(1, 600):  # for a minute
        told = clock.made_s(number / 10, number / 10 + 0.3, 0.6)
    assert told == pytest.approx(number / 10 - 0.01, abs=0.02)
    assert clock.delay_s == pytest.approx(0.31, abs=0.02)
    assert clock.known
    assert clock.leaps == 0


@pytest.mark.parametrize("by_s", [0.0, -0.2, -1.3, -3600.0])
@pytest.mark.parametrize("late_from", [0, 30])
def test_age_is_the_delay_when_a_clock_is_set_back(by_s: float, late_from: int) -> None:
    clock = StampedClock()
    for number in range(100):
        made = number * FRAME_S
        delay = 0.5 if number >= late_from else 0.005
        told = clock.made_s(made + (by_s if number >= 50 else 0.0), made + delay, 2 * delay)
        if told is not None:
            assert made + delay - told >= delay - LEAP_S
    assert told is not None
    assert made + delay - told <= 2 * delay + LEAP_S


def test_clock_is_unknown_when_no_echo_comes_back() -> None:
    clock = StampedClock()
    for number in range(100):
        clock.made_s(number * FRAME_S, number * FRAME_S + 0.5, math.inf)
    assert not clock.known
    assert clock.delay_s == math.inf


def test_robot_stands_when_no_echo_comes_back(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.echoes = False
    rig.known()
    assert not rig.may_go("forward")
    assert rig.body.detail()["camera_age_s"] is None
    with pytest.raises(
        ServiceError, match=r"^base: the age of messages is unknown: the robot.s router"
    ):
        rig.body.begin(BEGIN)


# The link hangs for a while, and what was sent meanwhile comes when it is over; the clock is set at some frame.
@given(
    st.lists(st.tuples(st.integers(1, 15), st.integers(0, 40)), max_size=4),
    st.integers(0, 100),
    st.floats(-9, 9),
)
@example([(15, 30)], 20, -1.3)
@example([(15, 30)], 20, 3.0)
def test_old_frame_stays_old_when_link_hangs_or_clock_is_set(
    hangs: list[tuple[int, int]], set_at: int, by_s: float
) -> None:
    clock = StampedClock()
    freed = {}
    first = 0
    for calm, hung in hangs:
        first += calm + 10
        freed |= dict.fromkeys(range(first, first + hung), first + hung)
        first += hung
    for number in range(first + 60):
        made_s = number * FRAME_S
        arrived_s = freed.get(number, number) * FRAME_S + 0.005
        told = clock.made_s(
            made_s + (by_s if number >= set_at else 0.0), arrived_s, arrived_s - made_s
        )
        if told is not None and clock.known:
            assert told <= made_s + 0.005 + MAX_AGE_S + DRIFT * made_s + 1e-6
            assert told <= arrived_s + 1e-6
    if set_at < first + 60 - (LEARN_S + max(0.0, -by_s)) / FRAME_S - 5:
        assert clock.known


@pytest.mark.parametrize("by_s", [-3600.0, -1.3, -0.2, 0.2, 3600.0])
def test_robot_stands_when_its_clock_was_set_until_it_is_learned(rig: Rig, by_s: float) -> None:
    assert rig.may_go("forward")
    begun_s = rig.clock.now_s
    ahead_s = []
    while not ahead_s or rig.clock.now_s < begun_s + 4.0:
        rig.passes(0.05, at_s=rig.clock.now_s + 0.05 + by_s)
        is_fresh = fresh(rig)
        if rig.may_go("forward"):
            assert is_fresh
            ahead_s.append(rig.clock.now_s - begun_s)
    assert LEARN_S <= ahead_s[0] <= LEARN_S + 0.2
    assert rig.air.robot_s == pytest.approx(rig.clock.now_s + by_s + AHEAD_S, abs=0.01)
    assert rig.body.detail()["camera_clock_leaps"] == 1


def test_late_frame_is_old_when_the_clock_was_set_back(rig: Rig) -> None:
    rig.clock.now_s += 3.0
    for number in range(2):
        rig.passes(0.0, "picture")
        rig.picture(rig.clock.now_s - 3.0 - 1.3 + 0.1 * number)
        assert not fresh(rig)
        assert not rig.may_go("forward")
        rig.clock.now_s += 0.1
    with pytest.raises(
        ServiceError, match=r"^base: the clock of /camera\S+ is being learned; wait 2 s$"
    ):
        rig.body.begin(BEGIN)


@pytest.mark.parametrize("name", ["picture", "wheels", "scan", "hazards"])
def test_topic_counts_as_silent_when_its_stamps_are_frozen(rig: Rig, name: str) -> None:
    frozen_s = rig.clock.now_s
    for _ in range(12):
        rig.passes(0.05, name)
        getattr(rig, name)(at_s=frozen_s)
    assert not (fresh(rig) and rig.may_go("forward"))


def test_robot_stands_when_two_senders_use_different_clocks(rig: Rig) -> None:
    for number in range(100):
        rig.passes(0.05, "picture")
        rig.picture(rig.clock.now_s - 50.0 * (number % 2))
        assert number < 2 or not rig.may_go("forward")
