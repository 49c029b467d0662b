"""Changes of the view along a drive: whether it goes on at a time, and as the odometry moves."""

from collections.abc import Collection
from itertools import islice, pairwise
from typing import Final, NamedTuple, Self

import numpy as np

from services.importers.drive import Array, Image, ImportedDrive
from services.importers.ticks import tracked
from services.kit.jpeg import decode_jpeg, shrunk
from smal.movement import seen_from

_THUMBNAIL: Final = 32  # Columns of a compared view.
_FRAMES: Final = 3  # Frames before and after a jump.
_JUMP: Final = 1.5  # Times the usual change between two views that is a jump.
_NOISE: Final = 0.05  # Change between two views of the same place, in deviations of a pixel.
_MOST_FRAMES: Final = 600  # Frames that are compared with the odometry: a minute at 10 Hz.
_LEAST_FRAMES: Final = 60
#: Delays that are tried, seconds, and those that are too short to matter.
_LATE_S: Final = np.arange(-30, 31) / 10.0
_SHORT_S: Final = 0.25
#: Least share of the changes that the movement explains at the right delay. In 22 drives of the
#: simulator it is 0.49 or more, and 0.13 or less at delays that differ by more than 0.5 s.
_EXPLAINED: Final = 0.3
_MOST_SHIFT: Final = 1.5  # Columns; the linear estimate is wrong beyond.
#: Correlation between shifts of the view and turns below which they are to opposite sides. In
#: drives of three real cars and the simulator it is 0.16 to 0.93.
_OPPOSITE: Final = -0.5


def views_go_on(drive: ImportedDrive, times_s: Array) -> list[bool]:
    """Return at which times the view changes as it does just before and after.

    Each view is compared with the next. Without views beside a time the answer is yes.
    """
    middles = np.searchsorted(drive.times_s, times_s).tolist()
    beside = [range(max(0, at - _FRAMES), at + _FRAMES) for at in middles]
    wanted = {frame for frames in beside for frame in frames}
    views = _views(drive, wanted)
    return [_goes_on(views, frames, at) for frames, at in zip(beside, middles, strict=True)]


class ViewChanges(NamedTuple):
    """Changes from a view to the next, in the first minute of a drive."""

    times_s: Array  # Times of both views, (2, n).
    changed: Array  # By how much the views differ, (n,).
    shifted: Array  # Columns by which the view moves to the right, as in a turn to the left, (n,).

    @classmethod
    def of(cls, drive: ImportedDrive) -> Self:
        """Compare the views of a drive; the result is empty if there are too few."""
        views = _views(drive, range(min(drive.times_s.size, _MOST_FRAMES)))
        # After a damaged frame a change is over two periods.
        pairs = [
            (frame, views[frame - 1], view)
            for frame, view in views.items()
            if frame - 1 in views and views[frame - 1].shape == view.shape
        ]
        pairs = pairs if len(pairs) >= _LEAST_FRAMES else []
        at = np.array([frame for frame, _, _ in pairs], dtype=np.intp)
        return cls(
            drive.times_s[np.stack([at - 1, at])],
            np.array([_change(earlier, later) for _, earlier, later in pairs]),
            np.array([_shift(earlier, later) for _, earlier, later in pairs]),
        )

    def lateness_s(self, track: Array) -> float:
        """Return by how many seconds the images are late, 0 if that is uncertain.

        A view changes as much as the robot turns and drives. The delay at which the odometry
        explains the changes is found by least squares; it is certain if other delays explain less
        than half.
        """
        if not self.changed.size:
            return 0.0
        explained = np.array(
            [_explained(self.changed, track, self.times_s - late_s) for late_s in _LATE_S]
        )
        best = int(explained.argmax())
        late_s = float(_LATE_S[best])
        others = explained[np.abs(_LATE_S - late_s) > 2.0 * _SHORT_S]
        certain = explained[best] >= _EXPLAINED and others.max() < explained[best] / 2.0
        return late_s if certain and abs(late_s) > _SHORT_S else 0.0

    def contradict(self, turned: Array) -> bool:
        """Return whether the views certainly turn to the other side than the robot, (n,)."""
        if not turned.size or not turned.std() or not self.shifted.std():
            return False
        return bool(np.corrcoef(self.shifted, turned)[0, 1] < _OPPOSITE)


def _explained(changes: Array, track: Array, times_s: Array) -> float:
    """Return the share of the variance of changes that the movement between times explains."""
    begin, known = tracked(track, times_s[0])
    end, _ = tracked(track, times_s[1])
    steps = seen_from(end, begin)
    turned = np.abs(steps[:, 2])
    gone = np.hypot(steps[:, 0], steps[:, 1])
    causes = np.column_stack([turned, gone, np.ones(len(turned))])[known]
    changes = changes[known]
    deviation = float(((changes - changes.mean()) ** 2).sum()) if known.any() else 0.0
    if deviation <= 0.0:
        return 0.0
    factors = np.linalg.lstsq(causes, changes, rcond=None)[0]
    return 1.0 - float(((changes - causes @ factors) ** 2).sum()) / deviation


def _change(earlier: Array, later: Array) -> float:
    return float(np.abs(later - earlier).mean())


def _shift(earlier: Array, later: Array) -> float:
    """Return by how many columns a view moved to the right, by least squares."""
    middle = (earlier + later) / 2.0
    slope = (middle[:, 2:] - middle[:, :-2]) / 2.0
    change = (later - earlier)[:, 1:-1]
    shift = -float((slope * change).sum()) / max(float((slope**2).sum()), 1e-9)
    return min(max(shift, -_MOST_SHIFT), _MOST_SHIFT)


def _views(drive: ImportedDrive, wanted: Collection[int]) -> dict[int, Array]:
    images = islice(drive.images(), max(wanted, default=-1) + 1)
    views = {frame: _view(image) for frame, image in enumerate(images) if frame in wanted}
    return {frame: view for frame, view in views.items() if view is not None}


def _changes(views: dict[int, Array], frames: Collection[int]) -> dict[int, float]:
    """Return by how much each view differs from the one before."""
    return {
        later: _change(views[earlier], views[later])
        for earlier, later in pairwise(frame for frame in frames if frame in views)
        if views[later].shape == views[earlier].shape
    }


def _goes_on(views: dict[int, Array], frames: range, at: int) -> bool:
    changes = _changes(views, frames)
    first = next((frame for frame in changes if frame >= at), None)
    if first is None:
        return True
    jump = changes.pop(first)
    return jump <= _JUMP * max(changes.values(), default=0.0) + _NOISE


def _view(image: Image) -> Array | None:
    """Return a small grey view without brightness and contrast; None if it is damaged."""
    try:
        pixels = decode_jpeg(image())
    except ValueError:
        return None
    grey = shrunk(pixels, _THUMBNAIL).mean(axis=2)
    deviation = float(grey.std())
    return np.asarray((grey - grey.mean()) / max(deviation, 1.0), dtype=np.float64)
