"""Ticks, velocities and ways hold for any times that a source can have."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import ATOMS
from services.importers.atoms import Thresholds, ahead_in_turns, atoms_of, nominal
from services.importers.drive import Drive, Frame, ImportFailure, Motion, Tally, Track
from services.importers.resample import GAP_S, HOLD_S, TICK_S, Moves, odometry, ticks

TIMES = st.lists(st.floats(0.0, 30.0), min_size=1, max_size=60).map(sorted)


def frames(times_s: list[float]) -> list[Frame]:
    return [Frame(time_s, bytes) for time_s in times_s]


@given(TIMES)
def test_every_tick_shows_the_nearest_frame_and_none_that_is_far(times_s: list[float]) -> None:
    made = list(ticks(iter(frames(times_s)), 0.0, 1e9, Tally()))
    numbers = [tick.number for tick in made]
    assert numbers == sorted(set(numbers))
    assert numbers[0] == 0
    for tick in made:
        due_s = times_s[0] + TICK_S * tick.number
        off = abs(tick.frame.time_s - due_s)
        assert off <= min(GAP_S, *(abs(time_s - due_s) for time_s in times_s)) + 1e-4
    # And no tick is missing that a frame is near to.
    span = max(0, math.floor((times_s[-1] - times_s[0]) / TICK_S))
    for number in set(range(span)) - set(numbers):
        due_s = times_s[0] + TICK_S * number
        assert min(abs(time_s - due_s) for time_s in times_s) > GAP_S - 1e-4


@pytest.mark.parametrize("jitter_s", [0.0, 0.02, 0.04])
def test_a_camera_of_ten_hertz_that_jitters_has_each_frame_once(jitter_s: float) -> None:
    rng = np.random.default_rng(1)
    times_s = (0.1 * np.arange(200) + rng.uniform(-jitter_s, jitter_s, 200) * (np.arange(200) > 0)).tolist()
    tally = Tally()
    made = list(ticks(iter(frames(times_s)), 0.0, 1e9, tally))
    assert [tick.frame.time_s for tick in made] == times_s
    assert tally.lines() == []


def test_a_gap_is_a_gap_and_counted() -> None:
    tally = Tally()
    made = list(ticks(iter(frames([0.0, 0.1, 0.2, 5.0, 5.1])), 0.0, 1e9, tally))
    assert [tick.number for tick in made] == [0, 1, 2, 3, 49, 50, 51]
    assert tally.counts == {"ticks have no frame": 45, "ticks show the frame of the tick before": 2}


@pytest.mark.parametrize("late_s", [1e9, 1e30, 1e308])
def test_times_that_are_not_seconds_are_named(late_s: float) -> None:
    with pytest.raises(ImportFailure, match="not in seconds"):
        list(ticks(iter(frames([0.0, 0.1, late_s])), 0.0, 1e9, Tally()))


def test_times_that_go_back_are_counted() -> None:
    tally = Tally()
    made = list(ticks(iter(frames([0.0, 0.1, 0.05, float("nan"), 0.2])), 0.0, 1e9, tally))
    assert [tick.frame.time_s for tick in made] == [0.0, 0.1, 0.2]
    assert tally.counts == {"frames are not later than the one before": 2}


ROWS = st.lists(st.tuples(st.floats(0.0, 20.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)), max_size=30)


@given(ROWS)
def test_a_velocity_holds_until_the_next_and_as_long_as_a_base_obeys(
    rows: list[tuple[float, float, float]],
) -> None:
    motion = Motion.of(rows, Tally())
    ends = np.minimum(np.append(motion.times_s[1:], np.inf), motion.times_s + HOLD_S)
    gone, turned = Moves(motion).until(np.array([-1.0, 30.0]))
    assert gone[1] - gone[0] == pytest.approx(float((motion.linear * (ends - motion.times_s)).sum()), abs=1e-6)
    assert turned[1] - turned[0] == pytest.approx(float((motion.angular * (ends - motion.times_s)).sum()), abs=1e-6)


def test_a_silent_driver_stands() -> None:
    moves = Moves(Motion.of([(0.0, 1.0, 0.0), (5.0, 1.0, 0.0)], Tally()))
    due_s = 0.1 * np.arange(55)
    linear, _ = moves.velocities(due_s)
    assert linear[:5] == pytest.approx(1.0)
    assert linear[5:50] == pytest.approx(0.0)
    assert moves.silent(due_s) == 45
    assert Moves(Motion.of([], Tally())).silent(due_s) == 55


def test_a_way_is_reckoned_as_the_robot_drives_it() -> None:
    """A quarter of a circle of 2 m, and then a turn on the spot."""
    quarter = math.pi / 2.0
    rows = [(0.1 * k, 0.2 * math.pi / 2.0, quarter / 5.0) if k < 50 else (0.1 * k, 0.0, -quarter) for k in range(60)]
    way = Moves(Motion.of(rows, Tally())).way(0.1 * np.arange(61))
    radius_m = (0.2 * math.pi / 2.0) / (quarter / 5.0)
    assert way[50] == pytest.approx([radius_m, radius_m, quarter], abs=1e-3)
    assert way[60] == pytest.approx([radius_m, radius_m, 0.0], abs=1e-3)


def test_odometry_begins_at_zero_and_its_heading_may_pass_half_a_turn() -> None:
    rows = [(0.1 * k, 5.0, -2.0, math.remainder(3.0 + 0.1 * k, math.tau)) for k in range(20)]
    drive = Drive("d", Motion.of([], Tally()), lambda: iter(()), 0, Track.of(rows, Tally()))
    found = odometry(drive, 0.05 + 0.1 * np.arange(18), None)
    assert found is not None
    poses, known = found
    assert known.all()
    assert poses[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert np.unwrap(poses[:, 2])[-1] == pytest.approx(1.7, abs=1e-6)


def test_odometry_that_jumps_is_named() -> None:
    rows = [(0.1 * k, 0.1 * k + 100.0 * (k > 12), 0.0, 0.0) for k in range(20)]
    drive = Drive("lap", Motion.of([], Tally()), lambda: iter(()), 0, Track.of(rows, Tally()))
    with pytest.raises(ImportFailure, match=r"drive lap: the odometry jumps by 100 m within 0.1 s, 1.2 s after"):
        odometry(drive, 0.1 * np.arange(20), None)


def test_where_odometry_was_silent_there_is_none() -> None:
    rows = [(0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(40) if not 10 <= k < 30]
    drive = Drive("lap", Motion.of([], Tally()), lambda: iter(()), 0, Track.of(rows, Tally()))
    found = odometry(drive, 0.1 * np.arange(40), None)
    assert found is not None
    assert set(range(15, 25)) <= set(np.flatnonzero(~found[1]).tolist()) <= set(range(14, 26))


@pytest.mark.parametrize("scale", [0.2, 1.0, 30.0])
@pytest.mark.parametrize(
    ("linear", "angular", "atom"),
    [
        (1.0, 0.0, "forward"), (-1.0, 0.0, "backward"), (0.0, 1.0, "left"), (0.0, -1.0, "right"), (0.0, 0.0, "stop"),
        (0.05, 0.05, "stop"), (1.0, 0.4, "forward"), (1.0, 0.6, "left"), (1.0, -0.6, "right"), (0.0, 0.2, "left"),
        (0.2, 0.2, "forward"), (-1.0, -0.7, "right"),
    ],
)  # fmt: skip
def test_atoms_of_velocities_as_shares_of_what_is_usual(linear: float, angular: float, atom: str, scale: float) -> None:
    thresholds = Thresholds()
    usual = nominal(scale * np.array([[1.0, 1.0, 1.0], [0.0, 1.0, -1.0]]), thresholds)
    assert ATOMS[atoms_of(scale * np.array([[linear], [angular]]), usual, thresholds)[0]] == atom


def test_a_turn_keeps_how_fast_it_goes_ahead() -> None:
    """As a share of the usual speed, which backwards is negative; nothing else needs it."""
    thresholds = Thresholds()
    velocities = 3.0 * np.array([[1.0, 1.0, 0.6, 0.0, -0.5, 2.0, 0.0], [0.0, 1.0, -1.0, 1.0, 1.0, -1.0, 0.0]])
    usual = nominal(3.0 * np.array([[1.0, 1.0, 1.0], [0.0, 1.0, -1.0]]), thresholds)
    ahead = ahead_in_turns(velocities, atoms_of(velocities, usual, thresholds), usual)
    assert ahead == pytest.approx([0.0, 1.0, 0.6, 0.0, -0.5, 1.0, 0.0])


def test_noise_of_a_robot_that_never_turns_is_no_turn() -> None:
    rng = np.random.default_rng(1)
    velocities = np.stack([np.ones(100), rng.normal(0.0, 0.01, 100)])
    usual = nominal(velocities, Thresholds())
    assert {ATOMS[atom] for atom in atoms_of(velocities, usual, Thresholds())} == {"forward"}


def test_a_robot_that_never_drives_teaches_nothing() -> None:
    with pytest.raises(ImportFailure, match="the robot never drives"):
        nominal(np.zeros((2, 10)), Thresholds())
