"""Ticks, velocities and ways hold for any times that a source can have."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.importers.drive import ImportedDrive, ImportFailure, Tally, motion_of
from services.importers.ticks import (
    TICK_S,
    Moves,
    gap_of,
    nominal,
    odometry,
    shares_of,
    ticks,
)


def shown(times_s: list[float]) -> tuple[list[int], list[int], Tally]:
    """Return the numbers of the ticks, the frame of each, and what was counted."""
    tally = Tally()
    made = ticks(np.array(times_s), 0.0, 1e9, tally)
    return made.numbers.tolist(), made.frames.tolist(), tally


def moves(*rows: tuple[float, float, float]) -> Moves:
    return Moves(motion_of(rows, Tally()))


@given(st.lists(st.floats(0.0, 30.0), min_size=1, max_size=60).map(sorted))
def test_ticks_show_the_nearest_frame_within_the_gap(times_s: list[float]) -> None:
    numbers, frames, _ = shown(times_s)
    assert numbers == sorted(set(numbers))
    assert numbers[0] == 0
    gap_s = gap_of(np.unique(times_s))
    for number, frame in zip(numbers, frames, strict=True):
        due_s = times_s[0] + TICK_S * number
        off = abs(times_s[frame] - due_s)
        assert off <= min(gap_s, *(abs(time_s - due_s) for time_s in times_s)) + 1e-4
    # And no tick is missing that a frame is near to.
    span = max(0, math.floor((times_s[-1] - times_s[0]) / TICK_S))
    for number in set(range(span)) - set(numbers):
        due_s = times_s[0] + TICK_S * number
        assert min(abs(time_s - due_s) for time_s in times_s) > gap_s - 1e-4


@pytest.mark.parametrize("jitter_s", [0.0, 0.02, 0.04])
def test_a_camera_of_ten_hertz_that_jitters_has_each_frame_once(jitter_s: float) -> None:
    rng = np.random.default_rng(1)
    times_s = (
        0.1 * np.arange(200) + rng.uniform(-jitter_s, jitter_s, 200) * (np.arange(200) > 0)
    ).tolist()
    _, frames, tally = shown(times_s)
    assert frames == list(range(200))
    assert tally.lines() == []


def test_ticks_are_missing_when_frames_have_a_gap() -> None:
    numbers, _, tally = shown([0.0, 0.1, 0.2, 5.0, 5.1])
    assert numbers == [0, 1, 2, 3, 49, 50, 51]
    assert tally.counts == {"ticks have no frame": 45, "ticks show the frame of the tick before": 2}


@pytest.mark.parametrize("late_s", [1e9, 1e30, 1e308])
def test_times_that_are_not_seconds_are_named(late_s: float) -> None:
    with pytest.raises(ImportFailure, match="in seconds"):
        shown([0.0, 0.1, late_s])


ROWS = st.lists(
    st.tuples(st.floats(0.0, 20.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)), max_size=30
)


@given(ROWS)
def test_velocity_holds_until_the_next_or_the_timeout(
    rows: list[tuple[float, float, float]],
) -> None:
    motion = motion_of(rows, Tally())
    moves = Moves(motion)
    holds_s = np.minimum(np.append(motion[1:, 0], np.inf) - motion[:, 0], moves.hold_s)
    gone = np.diff(moves.until(np.array([-1.0, 90.0])), axis=0)[0]
    assert gone == pytest.approx((motion[:, 1:] * holds_s[:, None]).sum(axis=0), abs=1e-6)


def tracked(
    rows: list[tuple[float, float, float, float]], times_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    drive = ImportedDrive.of_rows("lap", np.zeros(0), lambda: iter(()), [], rows, Tally())
    return odometry(drive, times_s, None)


def test_odometry_begins_at_zero_when_heading_wraps() -> None:
    rows = [(0.1 * k, 5.0, -2.0, math.remainder(3.0 + 0.1 * k, math.tau)) for k in range(20)]
    poses, known = tracked(rows, 0.05 + 0.1 * np.arange(18))
    assert known.all()
    assert poses[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert np.unwrap(poses[:, 2])[-1] == pytest.approx(1.7, abs=1e-6)


def test_odometry_is_unknown_when_source_is_silent() -> None:
    rows = [(0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(40) if not 10 <= k < 30]
    _, known = tracked(rows, 0.1 * np.arange(40))
    assert set(range(15, 25)) <= set(np.flatnonzero(~known).tolist()) <= set(range(14, 26))


def test_way_begins_ahead_when_the_robot_turned_before() -> None:
    turned = moves((0.0, 0.0, 1.0), (1.0, 1.0, 0.0), (1.5, 1.0, 0.0))
    assert turned.way(np.array([1.0, 2.0]))[1] == pytest.approx([1.0, 0.0, 0.0])


def test_velocity_holds_for_its_period_when_sent_once_a_second() -> None:
    slow = moves(*((float(k), 0.5, 0.0) for k in range(10)))
    assert slow.silent(0.1 * np.arange(90)) == 0
    assert slow.way(np.array([0.0, 9.0]))[1, 0] == pytest.approx(4.5)


def test_ticks_show_all_frames_when_camera_is_slow() -> None:
    numbers, frames, tally = shown([k / 3.0 for k in range(9)])
    assert numbers == list(range(len(numbers)))
    assert set(frames) == set(range(9))
    assert "ticks have no frame" not in tally.counts


@pytest.mark.parametrize("scale", [0.2, 30.0])
def test_atoms_follow_shares_of_nominal_velocities(scale: float) -> None:
    usual = nominal(scale * np.array([[1.0, 0.0], [1.0, 1.0], [1.0, -1.0]]))
    table = [
        (1.0, 0.0, "forward"), (-1.0, 0.0, "backward"), (0.0, 1.0, "left"), (0.0, -1.0, "right"), (0.0, 0.0, "stop"),
        (0.05, 0.05, "stop"), (1.0, 0.4, "forward"), (1.0, 0.6, "left"), (0.6, -0.6, "right"), (0.0, 0.2, "left"),
        (0.2, 0.2, "forward"), (-0.5, -0.7, "right"), (1.5, -1.0, "right"),
    ]  # fmt: skip
    shares = shares_of(scale * np.array([row[:2] for row in table]), usual)
    assert [share.atom() for share in shares] == [row[2] for row in table]
    np.testing.assert_allclose(shares, np.clip([row[:2] for row in table], -1.0, 1.0), atol=1e-6)
