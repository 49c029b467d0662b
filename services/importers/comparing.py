"""Comparison of the streams of a drive with each other, and repair of its odometry.

Poses form a strand as long as each is within reach of the pose before, at the robot's own usual
speed. A reset of the odometry ends a strand and begins the next; a second publisher or an outlier
makes strands beside. The largest strands are kept and joined end to end. The step between two
strands is that of the velocities. If the view jumps with the pose, the robot was moved, and the
drive is cut there. Poses that stand or never turn although the velocities do are replaced by the
way that follows from the velocities.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.importers.drive import Array, Image, ImportedDrive, Tally, spans
from services.importers.ticks import (
    HOLD_S,
    LEAST_ANGULAR,
    LEAST_LINEAR,
    Moves,
    motion_along,
    moving,
    tracked,
)
from services.importers.views import ViewChanges, views_go_on
from smal.movement import in_degrees, placed, seen_from, wrapped

#: Times the usual speed that no robot exceeds from one pose to the next.
_REACH: Final = 3.0
#: Turn rate that any robot may reach, radians per second: a straight drive shows no usual one.
_LEAST_TURN: Final = np.pi
#: Poses between two of the same publisher, at most. A pose continues a strand within as many.
_AHEAD: Final = 10
_USUAL: Final = 0.95  # Quantile of the moving poses that is the usual speed.
_STILL: Final = 1e-4  # Change of a pose at rest, in metres, radians and their rates.
_MOST_STRANDS: Final = 100
_LEAST_KEPT: Final = 0.3  # Least share of the poses in the kept strands; else it is no path.
_PAUSE: Final = 3.0  # Times the usual period of the camera that is a pause.
_WINDOW_S: Final = 1.0  # Duration over which poses and velocities are compared: a command lags.
_CLEARLY: Final = 3.0  # Times the least velocity that certainly moves the robot.
_ALWAYS: Final = 0.9  # Share of the windows that stands for the whole drive.
#: Units of poses that are not metres; the measured ratio is within `_ROUGHLY` of the unit.
_UNITS: Final = {1000.0: "millimetres", 100.0: "centimetres"}
_ROUGHLY: Final = 1.5
_NOTABLE: Final = 3.0  # Ratio of the lengths of two ways, or seconds of standing, to report.


def sound(drive: ImportedDrive, tally: Tally) -> list[ImportedDrive]:
    """Return a drive with sound odometry, in parts if a repair is uncertain."""
    return [_as_seen(part, tally) for part in _repaired(drive, tally)]


def _repaired(drive: ImportedDrive, tally: Tally) -> list[ImportedDrive]:
    """Return a drive whose odometry agrees with itself and with the velocities."""
    drive = _without_pauses(drive, tally)
    if not len(drive.track):
        return [drive]
    moves = _reference(drive)
    if in_degrees(drive.track[:, 1:]) or _turns_in_degrees(drive.track, moves):
        tally.say(f"{drive.called}: the headings are in degrees; converted to radians")
        drive = replace(drive, track=drive.track * (1.0, 1.0, 1.0, np.radians(1.0)))
    kept = _kept_strands(drive, moves, tally)
    track = drive.track[kept.rows]
    if moves is not None:
        windows = _windows(track, kept.breaks, moves)
        wrong = _wrong(windows) if len(track) else "the odometry is no path"
        if wrong:
            tally.say(f"{drive.called}: {wrong}; odometry is computed from the velocities")
            way = np.column_stack([drive.track[:, 0], moves.way(drive.track[:, 0])])
            return [replace(drive, track=way, reckoned=True)]
        _report_standing(drive, windows, tally)
        track[:, 1:3] *= _scale(drive, windows, tally)
    elif not len(track):
        tally.say(f"{drive.called}: the odometry is no path; it is left out")
    return _joined(replace(drive, track=track), kept.breaks, moves, tally)


def _as_seen(drive: ImportedDrive, tally: Tally) -> ImportedDrive:
    """Return a drive whose odometry and velocities move when, and turn to where, its views do.

    Without velocities, the motion is that of the odometry.
    """
    seen = ViewChanges.of(drive)
    measured = len(drive.track) > 0 and not drive.reckoned
    late_s = seen.lateness_s(drive.track) if measured else 0.0
    if late_s:
        tally.say(
            f"{drive.called}: the images are {late_s:.1f} s late, as the view turns after the "
            "odometry; aligned"
        )
    if not len(drive.motion):
        drive = replace(drive, motion=motion_along(drive.track), turn_rate=None)
    drive = replace(drive, times_s=drive.times_s - late_s)
    return _on_its_side(drive, seen._replace(times_s=seen.times_s - late_s), tally)


def _on_its_side(drive: ImportedDrive, seen: ViewChanges, tally: Tally) -> ImportedDrive:
    """Mirror the odometry or the velocities if they alone turn to the other side than the views."""
    begin_s, end_s = seen.times_s
    moves = Moves(drive.motion)
    turns = {"velocities": (moves.until(end_s) - moves.until(begin_s))[:, 1]}
    if len(drive.track):
        turned = tracked(drive.track, end_s)[0] - tracked(drive.track, begin_s)[0]
        turns["odometry"] = wrapped(turned[:, 2])
    against = [name for name, turned in turns.items() if seen.contradict(turned)]
    if len(against) == len(turns):
        tally.say(
            f"{drive.called}: the views turn to the other side than the robot; if the camera is "
            f"upside down, give --rotate 180; {_mirrored(drive)}"
        )
    elif against:
        tally.say(
            f"{drive.called}: turns of the {against[0]} are to the other side than those of the "
            "views; mirrored"
        )
        if "odometry" in against:
            drive = replace(drive, track=drive.track * (1.0, 1.0, -1.0, -1.0))
        else:
            drive = replace(drive, motion=drive.motion * (1.0, 1.0, -1.0))
    return drive


def _mirrored(drive: ImportedDrive) -> str:
    """Return the remedy for a drive whose turns to the right are positive."""
    if drive.turn_rate is None:
        return "if the axes of the poses are left-handed, convert the poses to right-handed axes"
    return f"if turns to the right are positive, negate them (--turn-rate {-drive.turn_rate:g})"


def _without_pauses(drive: ImportedDrive, tally: Tally) -> ImportedDrive:
    """Report pauses of the camera, and omit those in which neither pose nor view changed.

    Either the recording stopped while the robot stood, or a clock was set ahead.
    """
    frames_s = drive.times_s
    later_s = np.diff(frames_s)
    usual_s = float(np.median(later_s)) if later_s.size else 0.0
    gaps = np.flatnonzero(later_s > max(HOLD_S, _PAUSE * usual_s))
    middles_s = (frames_s[gaps] + frames_s[gaps + 1]) / 2.0
    still = views_go_on(drive, middles_s) if len(drive.track) else [False] * gaps.size
    omitted_s = 0.0
    left_out: list[str] = []
    kept: list[str] = []
    for gap, middle_s, view_goes_on in zip(gaps.tolist(), middles_s.tolist(), still, strict=True):
        took_s = float(later_s[gap])
        pause = f"for {took_s:.1f} s at {frames_s[gap] - frames_s[0]:.1f} s"
        if view_goes_on and _stands(drive, middle_s - omitted_s):
            drive = drive.without(middle_s - omitted_s, took_s - usual_s)
            omitted_s += took_s - usual_s
            left_out.append(pause)
        else:
            kept.append(pause)
    tally.say_all(f"{drive.called}: no image", kept)
    tally.say_all(f"{drive.called}: left out, as neither pose nor view changes:", left_out)
    return drive


def _stands(drive: ImportedDrive, at_s: float) -> bool:
    """Return whether no pose is near a time, and those around it are a usual step apart."""
    rows = _beside(drive.track, None)
    after = int(np.searchsorted(rows[:, 0], at_s))
    if not 0 < after < len(rows) or rows[after, 0] - rows[after - 1, 0] <= HOLD_S:
        return False
    reach = _Reach(rows)
    end = rows[after]
    end[0] = rows[after - 1, 0] + reach.period_s
    return bool(reach.shares(rows[after - 1], end) <= 1.0)


def _reference(drive: ImportedDrive) -> Moves | None:
    """Return the motion to compare the poses with: as the odometry reports it, or commands."""
    for motion in (drive.twist, drive.motion if drive.metric else drive.twist):
        if moving(motion).any():
            return Moves(motion)
    return None


def _turns_in_degrees(track: Array, moves: Moves | None) -> bool:
    """Return whether headings turn as many degrees as the velocities turn radians."""
    times_s = np.arange(track[0, 0], track[-1, 0], _WINDOW_S)
    if moves is None or times_s.size < 2:
        return False
    turned = np.abs(np.diff(np.interp(times_s, track[:, 0], track[:, 3])))
    commanded = np.abs(np.diff(moves.until(times_s)[:, 1]))
    clearly = commanded > _CLEARLY * LEAST_ANGULAR * _WINDOW_S
    ratio = float(np.median(turned[clearly] / commanded[clearly])) if clearly.any() else 0.0
    return bool(1.0 / _ROUGHLY < np.radians(ratio) < _ROUGHLY)


class _Kept(NamedTuple):
    """The poses of the strands that follow each other."""

    rows: NDArray[np.intp]  # Rows of the track.
    breaks: NDArray[np.intp]  # Positions among them that begin a further strand.


def _kept_strands(drive: ImportedDrive, moves: Moves | None, tally: Tally) -> _Kept:
    """Return the largest strands that are not beside a larger one."""
    labels = _strands(_beside(drive.track, moves))
    order = np.argsort(-np.bincount(labels), kind="stable")[:_MOST_STRANDS]
    taken = np.zeros(labels.size, dtype=bool)
    kept = np.zeros(labels.size, dtype=bool)
    for label in order.tolist():
        mine = np.flatnonzero(labels == label)
        span = slice(int(mine[0]), int(mine[-1]) + 1)
        if not taken[span].any():
            taken[span] = True
            kept[mine] = True
    if kept.sum() < _LEAST_KEPT * kept.size:
        kept[:] = False
    elif not kept.all():
        tally.say_all(
            f"{drive.called}: {int((~kept).sum())} of {kept.size} poses contradict the others, "
            "as of a second publisher, and are left out, at",
            spans(drive.track[~kept, 0] - drive.times_s[0]),
        )
    rows = np.flatnonzero(kept)
    return _Kept(rows, np.flatnonzero(np.diff(labels[rows])) + 1)


def _beside(track: Array, moves: Moves | None) -> Array:
    """Return time, pose and the pose by the velocities, (n, 7)."""
    way = np.zeros((len(track), 3)) if moves is None else moves.way(track[:, 0])
    return np.column_stack([track, way])


class _Reach:
    """How far poses are usually apart: from each other, and from the step by the velocities.

    The usual distance has a part that grows with time, and the jitter of the poses.
    """

    def __init__(self, rows: Array) -> None:
        passed_s = np.diff(rows[:, 0])
        later = passed_s[passed_s > 0.0]
        self.period_s = float(np.median(later)) if later.size else 1.0
        gone = np.full((len(rows) - 1, 2, 2), np.inf)  # To the nearest of the next poses.
        rates = gone.copy()
        for ahead in range(1, min(_AHEAD, len(rows) - 1) + 1):
            steps = _apart(rows[:-ahead], rows[ahead:])
            took_s = np.maximum(rows[ahead:, 0] - rows[:-ahead, 0], self.period_s)
            near = slice(0, len(steps))
            gone[near] = np.minimum(gone[near], steps)
            rates[near] = np.minimum(rates[near], steps / took_s[:, None, None])
        self._jitter = _usual(gone)
        self._rates = _usual(rates)
        self._rates[0] = np.maximum(self._rates[0], [LEAST_LINEAR, _LEAST_TURN / _REACH])
        # Velocities that are exact in a simulator are not a reason to call a slip a jump.
        self._rates[1] = np.maximum(self._rates[1], self._rates[0] / 2.0)

    def shares(self, begin: Array, end: Array) -> Array:
        """Return how far apart rows (..., 7) are as shares of the reach; above 1 is a jump."""
        took_s = np.abs(end[..., 0] - begin[..., 0]) + self.period_s
        reach = _REACH * (self._rates * took_s[..., None, None] + self._jitter)
        return np.asarray((_apart(begin, end) / reach).max(axis=(-2, -1)))


def _apart(begin: Array, end: Array) -> Array:
    """Return distance and turn between rows, and those that the velocities leave, (..., 2, 2)."""
    step = seen_from(end[..., 1:4], begin[..., 1:4])
    left = step - seen_from(end[..., 4:], begin[..., 4:])
    both = np.stack([step, left], axis=-2)
    return np.stack([np.hypot(both[..., 0], both[..., 1]), np.abs(wrapped(both[..., 2]))], axis=-1)


def _usual(values: Array) -> Array:
    """Return the usual value, over rows, among the values that are not at rest."""
    found = np.zeros(values.shape[1:])
    for place in np.ndindex(found.shape):
        column = values[(slice(None), *place)]
        column = column[column > _STILL]
        if column.size:
            found[place] = np.quantile(column, _USUAL, method="lower")
    return found


def _strands(rows: Array) -> NDArray[np.intp]:
    """Return the strand of each pose."""
    reach = _Reach(rows)
    jumps = np.flatnonzero(reach.shares(rows[:-1], rows[1:]) > 1.0) + 1
    bounds = [0, *jumps.tolist(), len(rows)]
    labels = np.zeros(len(rows), dtype=np.intp)
    count = 0
    tips: dict[int, int] = {}  # The last pose of each strand.
    for begin, end in pairwise(bounds):
        recent = [one for one, tip in tips.items() if begin - tip <= _AHEAD]
        label = count
        if recent:
            apart = reach.shares(rows[[tips[one] for one in recent]], rows[begin])
            nearest = int(apart.argmin())
            label = recent[nearest] if apart[nearest] <= 1.0 else label
        count = max(count, label + 1)
        labels[begin:end] = label
        tips = {one: tips[one] for one in recent} | {label: end - 1}
    return labels


class _Windows(NamedTuple):
    """Rates by the poses and by the velocities, a row for each window."""

    times_s: Array  # Begin of each window.
    gone: Array  # Distance by the poses and by the velocities, metres a second, (n, 2).
    turned: Array  # Turn likewise, radians a second.


def _windows(track: Array, breaks: NDArray[np.intp], moves: Moves) -> _Windows:
    since_s = track[:, 0] - track[:1, 0]
    _, edges = np.unique(np.floor(since_s / _WINDOW_S), return_index=True)
    begin = edges[:-1]
    end = edges[1:]
    whole = np.searchsorted(breaks, begin, side="right") == np.searchsorted(breaks, end, "right")
    begin = begin[whole]
    end = end[whole]
    took_s = track[end, 0] - track[begin, 0]
    steps = seen_from(track[end, 1:], track[begin, 1:])
    commanded = moves.until(track[end, 0]) - moves.until(track[begin, 0])
    gone = np.column_stack([np.hypot(steps[:, 0], steps[:, 1]), np.abs(commanded[:, 0])])
    turned = np.column_stack([np.abs(steps[:, 2]), np.abs(wrapped(commanded[:, 1]))])
    return _Windows(since_s[begin], gone / took_s[:, None], turned / took_s[:, None])


def _wrong(windows: _Windows) -> str:
    """Return how the poses contradict the velocities over the whole drive, empty if they do not."""
    for name, rates, least in (
        ("moves", windows.gone, LEAST_LINEAR),
        ("turns", windows.turned, LEAST_ANGULAR),
    ):
        clearly = rates[:, 1] > _CLEARLY * least
        stands = rates[clearly, 0] < least
        if stands.size and stands.mean() > _ALWAYS:
            return f"the pose never {name} although the velocities do"
    return ""


def _report_standing(drive: ImportedDrive, windows: _Windows, tally: Tally) -> None:
    """Report when the poses stand although the velocities drive, for a part of the drive."""
    stands = (windows.gone[:, 0] < LEAST_LINEAR) & (windows.turned[:, 0] < LEAST_ANGULAR)
    found_s = windows.times_s[stands & (windows.gone[:, 1] > _CLEARLY * LEAST_LINEAR)]
    if found_s.size * _WINDOW_S > _NOTABLE:
        tally.say_all(
            f"{drive.called}: the odometry stands although the velocities drive (the robot was "
            "blocked, or its odometry failed) at",
            spans(found_s + drive.track[0, 0] - drive.times_s[0]),
        )


def _scale(drive: ImportedDrive, windows: _Windows, tally: Tally) -> float:
    """Return the unit of the poses in metres, and report ways that differ in length."""
    both = (windows.gone > LEAST_LINEAR).all(axis=1)
    if not both.any():
        return 1.0
    poses, velocities = windows.gone[both].sum(axis=0)
    ratio = poses / velocities
    for unit, name in _UNITS.items():
        if max(ratio / unit, unit / ratio) < _ROUGHLY:
            tally.say(f"{drive.called}: the odometry is in {name}; converted to metres")
            return 1.0 / unit
    if max(ratio, 1.0 / ratio) > _NOTABLE:
        tally.say(
            f"{drive.called}: the odometry goes {ratio:.2g} times as far as the velocities; "
            "check --speed"
        )
    return 1.0


def _joined(
    drive: ImportedDrive, breaks: NDArray[np.intp], moves: Moves | None, tally: Tally
) -> list[ImportedDrive]:
    """Join the strands end to end, and cut the drive where the join is uncertain."""
    track = drive.track.copy()
    cuts: list[float] = []
    reports: list[str] = []
    middles_s = (track[breaks - 1, 0] + track[breaks, 0]) / 2.0
    for at, middle_s, view_goes_on in zip(
        breaks.tolist(), middles_s.tolist(), views_go_on(drive, middles_s), strict=True
    ):
        took_s = track[at, 0] - track[at - 1, 0]
        jump = seen_from(track[at, 1:], track[at - 1, 1:])
        cut_because = ""
        if not view_goes_on:
            cut_because = "the view changes too"
        elif moves is None and took_s > HOLD_S:
            cut_because = "there are no velocities in between"
        if cut_because:
            done = f"the drive is cut there, as {cut_because}"
            cuts.append(middle_s)
        else:
            done = "joined, as the view goes on"
            step = _step(track, at, moves)
            track[at:, 1:] = placed(
                seen_from(track[at:, 1:], track[at, 1:]), placed(step, track[at - 1, 1:])
            )
        reports.append(
            f"{np.hypot(jump[0], jump[1]):.2f} m and {np.degrees(jump[2]):.0f} degrees at "
            f"{middle_s - drive.times_s[0]:.1f} s ({done})"
        )
    tally.say_all(f"{drive.called}: the odometry jumps by", reports)
    return list(_parts(replace(drive, track=track), cuts))


def _step(track: Array, at: int, moves: Moves | None) -> Array:
    """Return the step to a pose from the pose before, by the velocities or the steps beside."""
    if moves is not None:
        return np.asarray(moves.way(track[at - 1 : at + 1, 0])[1])
    took_s = track[at, 0] - track[at - 1, 0]
    beside = [
        seen_from(track[one, 1:], track[one - 1, 1:]) / (track[one, 0] - track[one - 1, 0])
        for one in (at - 1, at + 1)
        if 0 < one < len(track) and track[one, 0] > track[one - 1, 0]
    ]
    return np.asarray(np.mean(beside or [np.zeros(3)], axis=0) * took_s)


def _parts(drive: ImportedDrive, cuts_s: list[float]) -> Iterator[ImportedDrive]:
    """Yield the parts of a drive between cuts; only the last can have reached the goal."""
    if not cuts_s:
        yield drive
        return
    bounds = [-np.inf, *cuts_s, np.inf]
    for number, (begin_s, end_s) in enumerate(pairwise(bounds), 1):
        frames = slice(*np.searchsorted(drive.times_s, [begin_s, end_s]).tolist())
        last = number == len(bounds) - 1
        yield replace(
            drive,
            name=f"{drive.name}-part-{number}",
            times_s=drive.times_s[frames],
            images=partial(_images, drive, frames),
            motion=_between(drive.motion, begin_s, end_s),
            track=_between(drive.track, begin_s, end_s),
            success=drive.success if last else False,
        )


def _images(drive: ImportedDrive, frames: slice) -> Iterator[Image]:
    return islice(drive.images(), frames.start, frames.stop)


def _between(rows: Array, begin_s: float, end_s: float) -> Array:
    return rows[(rows[:, 0] >= begin_s) & (rows[:, 0] < end_s)]
