"""What the filter knows of the taught ways: keyframes, their virtual views, and how alike views are.

A keyframe is a taught frame together with how its place looks from beside and turned (`smal.virtual_views`). Keyframes
are a fifth of the correlation length apart, the way over which views become half as alike as they can be, so that
between two of them a view hardly changes. No length here is in ticks: a robot that drives faster, or a camera with
another rate, has the same map.

Views are kept as their principal components, which is what makes thousands of them fit a decision's time.
`smal.mapping` makes the map of drives.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smal.files.map_file import check_map
from smal.movement import Atom, Movement
from smal.settings import SETTINGS
from smal.virtual_views import TURNS_DEG


@dataclass(frozen=True, eq=False)
class VisualMap:
    """Taught ways, and how they look.

    Poses are x, y and heading in radians in axes of their own for each drive, by its odometry; lengths are in metres,
    or in units of one forward atom where a drive has no odometry.

    Parameters
    ----------
    poses : float64 array (f, 3)
        Of every taught frame.
    drives : int32 array (f,)
        Which demonstration it is of, ascending.
    keyframes : int32 array (k,)
        Taught frames that are keyframes, ascending; the first and last frame of every drive are among them.
    basis : float32 array (m, r)
        Principal components of centred features.
    views : float32 array (k, 3, turns, r)
        Components of each keyframe's views: from `aside` to the right, from there, from the left; each turned by
        `TURNS_DEG`.
    aside : float
        How far the views from aside are from the keyframe, in the map's unit.
    correlation_length, correlation_rad : float
        Way ahead, and turn, after which the expected cosine of two views is half way down to that of unrelated ones.
    kappa : float
        Concentration of the cosines of views that show one place: 1 over their standard deviation. A view is e times
        less likely where its cosine is that much smaller.
    outlier_cosine : float
        Cosine that views of one place and of unrelated places are equally likely to have.
    alike_cosine : float
        Cosine that most views of one place exceed: their mean less one standard deviation.
    movements : float64 array (5, 2)
        What each atom does between two frames (`smal.movement.atom_movements`).
    tick_s : float
        Time between two taught frames.
    odometry : bool
        Whether poses are of odometry, or the usual movements of atoms added up.
    scene : float64 array (3,)
        `smal.virtual_views.Scene`, for people.
    goals : tuple of str
        Where each drive leads.
    names : tuple of tuples of str
        Demonstrations that each drive is made of, in order: several where frames between them were lost.
    stitched : int32 array (s, 2)
        Pairs of keyframes of different drives that show one place (`smal.stitches`), ascending.
    stitch_offsets : float64 array (s, 3)
        Of the first one as seen from the second one: ahead, left, turned left in radians.
    """

    poses: NDArray[np.float64]
    drives: NDArray[np.int32]
    keyframes: NDArray[np.int32]
    basis: NDArray[np.float32]
    views: NDArray[np.float32]
    aside: float
    correlation_length: float
    correlation_rad: float
    kappa: float
    outlier_cosine: float
    alike_cosine: float
    movements: NDArray[np.float64]
    tick_s: float
    odometry: bool
    scene: NDArray[np.float64]
    goals: tuple[str, ...]
    names: tuple[tuple[str, ...], ...]
    stitched: NDArray[np.int32] = field(default_factory=lambda: np.empty((0, 2), dtype=np.int32))
    stitch_offsets: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        check_map(self)

    @cached_property
    def flat_views(self) -> NDArray[np.float32]:
        """Every view as a row, (k * 3 * turns, r)."""
        return np.ascontiguousarray(self.views.reshape(-1, self.views.shape[-1]))

    @cached_property
    def neighbour_cosines(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Cosines of views that lie beside each other: by turn (k, 3, turns - 1), and by place (k, 2, turns)."""
        unit = self.views / np.maximum(np.linalg.norm(self.views, axis=-1, keepdims=True), 1e-12)
        return (unit[:, :, 1:] * unit[:, :, :-1]).sum(axis=-1), (unit[:, 1:] * unit[:, :-1]).sum(axis=-1)

    @cached_property
    def unlike(self) -> NDArray[np.bool_]:
        """Which keyframes look unlike each other, however turned, (k, k)."""
        count, middle = len(self.keyframes), TURNS_DEG.size // 2
        turned = np.ascontiguousarray(self.views[:, 1]).reshape(-1, self.views.shape[-1])
        alike = np.zeros((count, count), dtype=bool)
        for first in range(0, count, SETTINGS.compared_at_once):
            some = slice(first, first + SETTINGS.compared_at_once)
            views = self.views[some, 1, middle]
            best = (turned @ views.T).reshape(count, -1, len(views)).max(axis=1) >= self.outlier_cosine
            alike[:, some] |= best
            alike[some] |= best.T
        np.fill_diagonal(alike, True)
        return np.logical_not(alike, out=alike)

    def outlier_of(self, cosines: NDArray[np.float32]) -> float:
        """Return the cosine from which on a frame shows a place rather than none of the map.

        That is how alike it is to the places that look unlike the one that it is most alike to. So it adapts to what
        makes all cosines small: noise, darkness, another season; and a view that shows nothing says nothing. Where all
        places look alike it is `outlier_cosine`. It is at most `alike_cosine`: in a street of houses that look the
        same, fine details alone tell places apart, and other houses must not make a robot lost that is on the way.

        Parameters
        ----------
        cosines : float32 array (k, 3, turns)
            Of the frame with every view.
        """
        best = cosines.reshape(len(cosines), -1).max(axis=1)
        others = best[self.unlike[best.argmax()]]
        return min(float(others.max()), self.alike_cosine) if others.size else self.outlier_cosine

    @cached_property
    def key_poses(self) -> NDArray[np.float64]:
        """Poses of the keyframes, (k, 3)."""
        return self.poses[self.keyframes]

    @cached_property
    def key_range(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First and last keyframe of the drive of each keyframe, (k,) and (k,)."""
        of = self.drives[self.keyframes]
        return np.searchsorted(of, of, side="left"), np.searchsorted(of, of, side="right") - 1

    @cached_property
    def arc(self) -> NDArray[np.float64]:
        """Way driven until each frame, all drives one after the other, (f,)."""
        steps = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        return np.concatenate([[0.0], np.cumsum(np.where(np.diff(self.drives) == 0, steps, 0.0))])

    @cached_property
    def key_goals(self) -> NDArray[np.str_]:
        """Where the drive of each keyframe leads, (k,)."""
        return np.array(self.goals)[self.drives[self.keyframes]]

    @cached_property
    def frames(self) -> NDArray[np.intp]:
        """Frames of each drive, (d,)."""
        return np.bincount(self.drives)

    @property
    def speed(self) -> float:
        """Nominal speed, in the map's unit a second; 0 if nobody drove ahead."""
        return float(self.movements[Atom.FORWARD, 0]) / self.tick_s

    def lengths(self, movement: Movement) -> float:
        """How much a movement changes the view, in correlation lengths."""
        return math.hypot(movement.ahead / self.correlation_length, movement.turn_rad / (2.0 * self.correlation_rad))

    def cosines(self, centred: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the cosine of a frame (m,) with every view, (k, 3, turns)."""
        found: NDArray[np.float32] = self.flat_views @ (centred @ self.basis)
        return found.reshape(self.views.shape[:3])
