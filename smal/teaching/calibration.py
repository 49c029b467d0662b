"""Measurements on drives for the map: the camera, the scene, and the correlation of views by way and turn.

Views are compared at poses with nearly the same heading, because a turned view is another view. A car possibly never
has the same heading twice. There a virtual view compensates the turn between two views, as in the filter.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression

from smal.arrays import AnyArray, Bools, Float32s, Floats, Indices, Int8s, Int32s, evenly
from smal.camera import STEP_DEG, STRAIGHT, TURNS_DEG, Camera, Image, Scene
from smal.features.extraction import in_parallel
from smal.features.resizing import PIXELS, fitted
from smal.files.packed import unpacked
from smal.keyframes import MapConfig
from smal.likelihood import Likelihood, standing_out
from smal.movement import Atom, seen_from, turns_ahead, wrapped
from smal.teaching.demonstration import selected

#: Returns the centred features (n, m) of n images.
Describe = Callable[[Iterable[Image]], Float32s]


@dataclass(frozen=True)
class CalibrationConfig:
    """Parameters of the calibration on drives."""

    #: Candidates for the field of view of rectilinear and of equidistant lenses, as of cameras on robots.
    fields_deg: tuple[float, ...] = tuple(range(40, 125, 5))
    wide_fields_deg: tuple[float, ...] = tuple(range(80, 225, 5))
    #: Candidates for the height of the camera, in correlation lengths, and for the distance of the scene, in heights.
    heights: tuple[float, ...] = tuple(0.1 * 1.5**k for k in range(7))
    distances: tuple[float, ...] = tuple(3.0 * 2.0**k for k in range(6))
    #: Pairs of views in a fit: more have no visible effect.
    pairs: int = 24
    #: Maximum frames between the two views of a pair.
    most_apart: int = 100
    #: Minimum turn of pairs for the camera.
    tells_camera_deg: float = 9.0
    #: Maximum turn of steps for the scene.
    tells_scene_deg: float = 25.0
    #: Total turn of atoms for measuring the turn of one.
    tells_turn_deg: float = 15.0
    #: Maximum turn of an equal view.
    same_deg: float = 3.0
    #: Share of the longest way within which views of one place are compared.
    reach: float = 0.2
    #: Frames of a drive that are compared: the time grows with the square, a millisecond each.
    most_frames: int = 1000


CALIBRATION_CONFIG: Final = CalibrationConfig()
#: Candidates for a camera of unknown field of view; the first is the default.
USUAL_CAMERAS: Final = (Camera.of_field(70.0), Camera.of_field(140.0, "equidistant"))
#: Candidates for the turn between views of a fit: the views must overlap.
_OVERLAP_DEG: Final = float(TURNS_DEG[-1])
_TURNS_RAD: Final = np.radians(np.geomspace(1.0, _OVERLAP_DEG, 23)).tolist()


class _Pair(NamedTuple):
    """A frame, another frame, and the step from the first pose to the second: ahead, left, turned."""

    frame: int
    other: int
    step: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class TaughtFrames:
    """All f frames of all drives in a row.

    Attributes
    ----------
    images : sequence (f,)
    centred : callable
        Returns the centred features (n, m), of unit length, of n frames.
    poses : array (f, 3)
        x, y and heading in radians, in axes of their own for each drive: by `odometry`, or by the usual movements.
    drives : array (f,)
        Drive of each frame, ascending.
    describe : callable
        Returns the centred features (n, m) of n images.
    movements : array (5, 2)
        Movement of each atom between two frames.
    names : tuple of str
        Name of each drive, for errors.
    odometry : bool
    camera : Camera, optional
        The given camera, or the camera of the turn measurement.
    pixels : (int, int)
        Rows and columns of an image at which `describe` looks.
    """

    images: Sequence[Image]
    centred: Callable[[Iterable[int]], Float32s]
    poses: Floats
    drives: Int32s
    describe: Describe
    movements: Floats
    names: tuple[str, ...] = ("",)
    odometry: bool = True
    camera: Camera | None = None
    config: CalibrationConfig = CALIBRATION_CONFIG
    pixels: tuple[int, int] = PIXELS

    @property
    def listed(self) -> str:
        """Names of the first drives, for errors."""
        more = len(self.names) - 3
        return ", ".join(self.names[:3]) + f" and {more} more" * (more > 0)

    @property
    def unit(self) -> str:
        """Unit of lengths, for errors."""
        return "m" if self.odometry else "forward actions"

    @cached_property
    def car(self) -> bool:
        """Whether the robot goes ahead during turns."""
        return turns_ahead(self.movements)

    def apart(self, frames: Indices) -> tuple[Floats, Floats]:
        """Return distances and angles between frames of one drive, (n, n) each.

        Whole turns of a car count: its estimated way does not lead back to the start of a lap.
        """
        poses = self.poses[frames]
        across = poses[:, None, :2] - poses[None, :, :2]
        distance = np.hypot(across[..., 0], across[..., 1])
        heading = np.unwrap(poses[:, 2]) if self.car else poses[:, 2]
        turned = heading[:, None] - heading[None, :]
        return distance, np.abs(turned if self.car else wrapped(turned))

    def pairs(self, wanted: Callable[[Floats, Floats], Bools]) -> list[_Pair]:
        """Find for each frame the next frame of its drive with a wanted way and turn."""
        found: list[_Pair] = []
        for frame in range(len(self.poses) - 1):
            start = frame + 1
            later = self.drives[start : start + self.config.most_apart]
            after = np.flatnonzero(later == self.drives[frame]) + start
            steps = seen_from(self.poses[after], self.poses[frame])
            way = np.hypot(*steps[:, :2].T)
            good = np.flatnonzero(wanted(way, np.abs(steps[:, 2])))
            if good.size:
                first = good[0]
                found.append(_Pair(frame, int(after[first]), tuple(steps[first].tolist())))
        return found

    def of_drives(self, drives: Indices) -> "TaughtFrames":
        """Return the frames of some drives."""
        some = np.flatnonzero(np.isin(self.drives, drives))
        _, numbers = np.unique(self.drives[some], return_inverse=True)
        return replace(
            self,
            images=selected(self.images, some.tolist()),
            centred=lambda frames: self.centred(some[list(frames)].tolist()),
            poses=self.poses[some],
            drives=numbers.astype(np.int32),
            names=tuple(self.names[drive] for drive in drives.tolist()),
        )

    def best(self, scenes: Sequence[Scene], pairs: Sequence[_Pair]) -> Scene:
        """Return the scene that predicts the second views of pairs best from the first."""
        guesses = [(scene, 1.0) for scene in scenes]
        scene, _ = _best(self.images, self.describe, guesses, pairs, self.config.pairs, self.pixels)
        return scene


def _best(
    images: Sequence[Image],
    describe: Describe,
    guesses: Sequence[tuple[Scene, float]],
    pairs: Sequence[_Pair],
    most: int,
    pixels: tuple[int, int],
) -> tuple[Scene, float]:
    """Return the scene and the unit of the steps that predict the second views of pairs best from the first."""
    some = [pairs[k] for k in evenly(len(pairs), most)]
    firsts = [images[pair.frame] for pair in some]
    seconds = [describe([images[pair.other]])[0] for pair in some]
    steps = [pair.step for pair in some]

    def score(guess: tuple[Scene, float]) -> float:
        scene, unit = guess
        warped = (
            scene.warp(image, [unit * part for part in step], fitted(image.shape, pixels))
            for image, step in zip(firsts, steps, strict=True)
        )
        predicted = describe(warped)
        return float(sum(y @ view for y, view in zip(seconds, predicted, strict=True)))

    # OpenCV releases the interpreter's lock.
    scores = list(in_parallel(score, guesses))
    return guesses[int(np.argmax(scores))]


def _far(camera: Camera) -> Scene:
    """Return a scene so far away that only turns change the view."""
    return Scene(camera, 1.0, 1e6)


def fit_camera(frames: TaughtFrames) -> Camera:
    """Fit the camera to the views at both ends of turns with the least way; without turns return the usual camera."""
    turns = frames.pairs(lambda _, turn: turn > math.radians(frames.config.tells_camera_deg))
    if not turns:
        return USUAL_CAMERAS[0]
    turns.sort(key=lambda pair: math.hypot(*pair.step[:2]))
    least = turns[: max(frames.config.pairs, len(turns) // 10)]
    cameras = [Camera.of_field(field) for field in frames.config.fields_deg]
    cameras += [Camera.of_field(field, "equidistant") for field in frames.config.wide_fields_deg]
    steps = [pair._replace(step=(0.0, 0.0, pair.step[2])) for pair in least]
    scenes = [_far(camera) for camera in cameras]
    return frames.best(scenes, steps).camera


def fit_scene(frames: TaughtFrames, camera: Camera, length: float) -> Scene:
    """Fit the height of the camera, and the distance of the scene, to the views at both ends of steps."""
    most_rad = math.radians(frames.config.tells_scene_deg)
    steps = frames.pairs(lambda way, turn: (way > 0.5 * length) & (turn < most_rad))
    if not steps:
        return Scene(camera, length / 3.0, length * 4.0)
    heights = [length * share for share in frames.config.heights]
    coarse = [Scene(camera, h, h * far) for h in heights for far in frames.config.distances]
    scene = frames.best(coarse, steps)
    factors = [1.5**k for k in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    fine = [replace(scene, height=scene.height * factor) for factor in factors]
    return frames.best(fine, steps)


def turn_of_views(
    images: Sequence[Image],
    atoms: Sequence[Int8s],
    cameras: Sequence[Camera],
    describe: Describe,
    config: CalibrationConfig = CALIBRATION_CONFIG,
    pixels: tuple[int, int] = PIXELS,
) -> tuple[Camera, float] | None:
    """Measure the turn of a turning atom, by the turn with which views predict each other best.

    The first measurement uses single atoms, the second several in a row, which is more exact. A wrong focal length
    makes the turn wrong by the same factor, so that virtual views of the two together fit all the same.

    Parameters
    ----------
    images : sequence (f,)
    atoms : sequence of array
        Atoms executed after the images, for each drive.
    cameras : sequence of Camera
        Candidates.
    describe : callable
        Returns the centred features (n, m) of n images.
    config : CalibrationConfig
    pixels : (int, int)
        Rows and columns of an image at which `describe` looks.

    Returns
    -------
    (Camera, float) or None
        The best camera, and radians; None if no drive turns.
    """
    executed = np.concatenate(atoms)
    # The next frame after the end of a drive belongs to another drive.
    ends = np.cumsum([len(drive) for drive in atoms]) - 1
    executed[ends] = Atom.STOP
    sign = (executed == Atom.LEFT).astype(int) - (executed == Atom.RIGHT).astype(int)
    guesses = [(_far(camera), turn_rad) for camera in cameras for turn_rad in _TURNS_RAD]
    found = None
    count = 1
    for _ in range(2):
        if found is not None:
            count = max(1, round(math.radians(config.tells_turn_deg) / found[1]))
        in_a_row = np.convolve(sign, np.ones(count, dtype=int), mode="valid")
        same = np.flatnonzero(np.abs(in_a_row) == count)
        if not same.size:
            break
        turns = [_Pair(k, k + count, (0.0, 0.0, float(sign[k]))) for k in same.tolist()]
        scene, turn_rad = _best(images, describe, guesses, turns, config.pairs, pixels)
        found = scene.camera, turn_rad / count
    return found


def correlation_length(frames: TaughtFrames, camera: Camera) -> tuple[float, float]:
    """Measure the correlation length of views.

    Returns
    -------
    length : float
        Way over which the mean cosine of two views falls half way to the mean cosine of unrelated views.
    unrelated : float
        Mean cosine of unrelated views.

    Raises
    ------
    ValueError
        If no drive goes anywhere, all images look the same, or frames are too far apart.
    """
    ways = []
    cosines = []
    distant = []
    curves = []
    blind = True
    for drive in np.unique(frames.drives):
        every = np.flatnonzero(frames.drives == drive)
        some = every[compared_frames(every.size, frames.config.most_frames)]
        apart, turned = frames.apart(some)
        if not apart.any():
            continue
        centred = frames.centred(some)
        alike = centred @ centred.T
        blind &= not centred.any()
        near = apart < frames.config.reach * apart.max()
        same = near & (turned < math.radians(frames.config.same_deg))
        ways.append(apart[same])
        cosines.append(alike[same])
        distant.append(alike[apart >= 0.1 * apart.max()])
        overlap = near & ~same & (turned < math.radians(_OVERLAP_DEG))
        curves.append(some[np.argwhere(np.triu(overlap))])
    if not ways:
        stays = "the odometry does not change" if frames.odometry else "no action goes ahead"
        raise ValueError(f"the robot does not move in {frames.listed}: {stays}")
    if blind:
        raise ValueError(
            f"all images of {frames.listed} look the same; check that they are images of the camera"
        )
    if frames.car:
        way, cosine = _turns_undone(frames, camera, np.concatenate(curves))
        ways = [way, *ways]
        cosines = [cosine, *cosines]
    unrelated = float(np.concatenate(distant).mean())
    length = _length_of(frames, np.concatenate(ways), np.concatenate(cosines), unrelated)
    return length, unrelated


def _too_far_apart(frames: TaughtFrames, length: float) -> str:
    """Return the error of frames between which views change entirely, for the worst drive."""
    apart = []
    for drive in range(len(frames.names)):
        steps = np.hypot(*np.diff(frames.poses[frames.drives == drive, :2], axis=0).T)
        apart.append(float(np.median(steps[steps > 0.0])) if steps.any() else 0.0)
    worst = int(np.argmax(apart))
    return (
        f"demonstration {frames.names[worst]}: successive images are {apart[worst]:.2g} "
        f"{frames.unit} apart, but nothing stays alike over {length:.2g} {frames.unit}; drive more "
        "slowly or record more images a second, and check that the images fit the movement"
    )


def _length_of(frames: TaughtFrames, way: Floats, cosine: AnyArray, unrelated: float) -> float:
    """Return the way over which the mean cosine falls half way to the cosine of unrelated views."""
    reach = float(way.max())
    least = float(way[way > 0.0].min(initial=math.inf))
    if reach == 0.0:
        raise ValueError(
            f"the robot turns all the time in {frames.listed}: no two places near each other have "
            "views of one heading; drive a straight stretch, or record more images a second"
        )
    length = 0.0
    while least <= reach:
        edges = np.linspace(0.0, reach, 100)
        within = way <= reach
        bins = np.digitize(way[within], edges[1:-1])
        count = np.bincount(bins, minlength=99)
        total = np.bincount(bins, cosine[within], minlength=99)
        full = count > 0
        mean = total[full] / count[full]
        middles = (edges[:-1] + edges[1:]) / 2.0
        length = _half_way(middles[full], mean, count[full], unrelated)
        # A short length lies within the first few bins: repeat with finer bins.
        if length > 0.1 * reach:
            return length
        reach = 4.0 * length
    raise ValueError(_too_far_apart(frames, length))


def compared_frames(count: int, most: int) -> Indices:
    """Return the frames of a drive that `correlation_length` compares, at most about `most`.

    They are evenly spread numbers, each followed by numbers at growing distances, so that some
    pairs are near and some far apart.
    """
    if count <= most:
        return np.arange(count)
    each = math.isqrt(most)
    after = np.geomspace(1.0, count / each, each).astype(np.intp) - 1
    numbers = evenly(count, each)[:, None] + after
    return np.unique(np.minimum(numbers, count - 1))


def _turns_undone(frames: TaughtFrames, camera: Camera, pairs: Indices) -> tuple[Floats, Floats]:
    """Return the distances and cosines of pairs of frames, with the first frame warped to the second's heading."""
    first, second = pairs[evenly(len(pairs), frames.config.most_frames // 2)].T
    steps = frames.poses[second] - frames.poses[first]

    def cosine(pair: tuple[int, int, float]) -> float:
        one, other, turn_rad = pair
        step = (0.0, 0.0, turn_rad)
        image = frames.images[one]
        turned = _far(camera).warp(image, step, fitted(image.shape, frames.pixels))
        (predicted,) = frames.describe([turned])
        (view,) = frames.centred([other])
        return float(predicted @ view)

    turns = wrapped(steps[:, 2]).tolist()
    each = zip(first.tolist(), second.tolist(), turns, strict=True)
    return np.hypot(*steps[:, :2].T), np.array(list(in_parallel(cosine, each)))


def correlation_turn(frames: TaughtFrames, camera: Camera, unrelated: float) -> float:
    """Measure the turn (radians) over which the mean cosine falls half way to the cosine of unrelated views."""
    some = evenly(len(frames.images), frames.config.pairs).tolist()
    own = frames.centred(some)
    images = [frames.images[k] for k in some]
    scene = _far(camera)

    def cosine(turn_rad: float) -> float:
        step = (0.0, 0.0, turn_rad)
        turned = frames.describe(
            scene.warp(image, step, fitted(image.shape, frames.pixels)) for image in images
        )
        return float((own * turned).sum(axis=1).mean())

    mean = np.array([1.0, *in_parallel(cosine, _TURNS_RAD)])
    turns = np.array([0.0, *_TURNS_RAD])
    return _half_way(turns, mean, np.ones_like(mean), unrelated)


def _half_way(
    far: Floats,
    cosines: AnyArray,
    counts: AnyArray,
    unrelated: float,
) -> float:
    """Return the distance at which falling cosines are half way from 1 to the unrelated cosine.

    Each cosine is the mean of `counts` pairs. Isotonic regression merges neighbours where the cosines rise.
    """
    falling = isotonic_regression(cosines, weights=counts, increasing=False)
    firsts = falling.blocks[:-1]
    middles = np.add.reduceat(far * counts, firsts) / falling.weights
    half = (1.0 + unrelated) / 2.0
    return float(np.interp(-half, -falling.x[firsts], middles))


@dataclass(frozen=True, eq=False)
class _KeyframeViews:
    """The views of k keyframes; the own view of each is treated as a robot's view."""

    #: (k, 3)
    poses: Floats
    #: (k,)
    drives: Int32s
    #: (k, 3, turns, r)
    views: Int8s
    #: Views of the sample of elsewhere.
    sample: Float32s

    def own(self, keys: Indices) -> Float32s:
        """Return the views straight ahead from keyframes themselves, (n, r)."""
        return unpacked(self.views[keys, 1, STRAIGHT])

    def neighbours(self, key: int) -> list[int]:
        """Return the keyframes before and after a keyframe on its drive."""
        near = range(max(key - 1, 0), min(key + 2, len(self.drives)))
        return [other for other in near if other != key and self.drives[other] == self.drives[key]]

    def beside(self, key: int, other: int) -> float | None:
        """Return the z value of a neighbour's view at the robot's heading; None beyond its virtual views."""
        _, _, turned_rad = seen_from(self.poses[other], self.poses[key])
        turn = STRAIGHT - round(math.degrees(turned_rad) / STEP_DEG)
        if not 0 <= turn < TURNS_DEG.size:
            return None
        (own,) = self.own(np.array([key]))
        cosine = unpacked(self.views[other, 1, turn]) @ own
        return float(standing_out(cosine, self.sample @ own))

    def wrong_ways(
        self, keys: Indices, own: Float32s, blocks: Indices, least: float
    ) -> Iterator[Floats]:
        """Compare a robot's way with the ways of equally many keyframes from each keyframe of each block.

        Parameters
        ----------
        keys : array (s,)
            The robot's way.
        own : array (s, r)
            The robot's views there.
        blocks : array (n,)
            First keyframes of blocks of s keyframes. Blocks near the robot's way, or not on its drive, are skipped.
        least : float
            Distance from which places are different.

        Yields
        ------
        array (s, s, 3 * turns)
            z by the start of the way in the block, the step on the way, and the view that is kept on it.
        """
        steps = np.arange(keys.size)
        samples = own @ self.sample.T
        for block in blocks:
            rows = np.arange(block, block + 2 * keys.size - 1)
            across = self.poses[rows, None, :2] - self.poses[keys, :2]
            others = np.hypot(across[..., 0], across[..., 1]) > least
            if not (others.all() and (self.drives[rows] == self.drives[keys[0]]).all()):
                continue
            views = unpacked(self.views[rows]).reshape(rows.size, -1, own.shape[1])
            pairs = zip(own, samples, strict=True)
            z = np.stack([standing_out(views @ view, sample) for view, sample in pairs])
            yield z[steps, steps[:, None] + steps]


def likelihood_of_views(
    frames: TaughtFrames,
    keyframes: Int32s,
    views: Int8s,
    view_of: Callable[[Image], Float32s],
    length: float,
    config: MapConfig,
) -> tuple[Likelihood, float]:
    """Measure the likelihood of views on keyframes, and the correlation of neighbouring views.

    The neighbours of a keyframe show the same place. Keyframes further away than `MapConfig.elsewhere` on the same
    drive show other places. Without such places (a short drive in one room) the distributions of elsewhere are normal.

    A robot elsewhere sees another taught place, or a view that no drive has shown, such as the way back. Views of the
    second kind are like the taught ones in light, texture and layout, so that they resemble some taught view more than
    taught views resemble each other. Mirrored taught views stand for them.

    Particles at a wrong place follow the start, the side and the turn that suit the views best. Elsewhere is measured
    so: over a correlation length of keyframes, on the way of a block whose mean z is largest.

    Parameters
    ----------
    frames : TaughtFrames
    keyframes : array (k,)
    views : array (k, 3, turns, r)
    view_of : callable
        Returns the components (r,) of an image.
    length : float
        Correlation length.
    config : MapConfig

    Returns
    -------
    likelihood : Likelihood
    correlation : float
        Correlation of the z values of a keyframe and the next at other places.

    Raises
    ------
    ValueError
        If no keyframe has a neighbour.
    """
    count = len(views)
    drives = frames.drives[keyframes]
    sample = unpacked(views[evenly(count, config.reference), 1, STRAIGHT])
    taught = _KeyframeViews(frames.poses[keyframes], drives, views, sample)
    neighbouring: list[float | None] = []
    alike = []
    for key in evenly(count, frames.config.most_frames // 4).tolist():
        neighbours = taught.neighbours(key)
        neighbouring += [taught.beside(key, other) for other in neighbours]
        if key + 1 in neighbours:
            first, second = frames.centred(keyframes[key : key + 2])
            alike.append(float(first @ second))
    here = [z for z in neighbouring if z is not None]
    if not here:
        raise ValueError(
            f"no two neighbouring views overlap in {frames.listed}: the robot turns by more than "
            f"{_OVERLAP_DEG:g} degrees from an image to the next; turn more slowly, or record more "
            "images a second"
        )

    @cache
    def mirrored_view(key: int) -> Float32s:
        return view_of(np.ascontiguousarray(frames.images[keyframes[key]][:, ::-1]))

    def mirrored(keys: Indices) -> Float32s:
        return np.stack(list(in_parallel(mirrored_view, keys.tolist())))

    fixed, followed, chains = _elsewhere(taught, taught.own, length, frames.config, config)
    correlation = _correlation(chains)
    gamma = gamma_of(float(np.mean(alike)), correlation)
    untaught, by_untaught, _ = _elsewhere(taught, mirrored, length, frames.config, config)
    fixed = np.concatenate([fixed, untaught])
    followed = np.concatenate([followed, by_untaught])
    if not followed.size:
        fixed = followed = np.random.default_rng(0).standard_normal(10_000)
    independent = 2.0 * _independent(taught.poses, drives, length)
    return Likelihood.fit(np.array(here), fixed, followed, independent, gamma, config), correlation


def _elsewhere(
    taught: _KeyframeViews,
    views: Callable[[Indices], Float32s],
    length: float,
    config: CalibrationConfig,
    map_config: MapConfig,
) -> tuple[Floats, Floats, Floats]:
    """Return z at fixed views of other places, z on the best of neighbouring wrong ways, and pairs of following z.

    The shapes are (n,), (m,) and (2, p). The function `views` returns the views of a robot at keyframes, (s, r).
    """
    steps = map_config.views_a_length
    count = len(taught.drives)
    blocks = np.arange(0, count - 2 * steps + 2, steps)
    blocks = blocks[evenly(blocks.size, config.most_frames // (2 * steps))]
    fixed = [np.empty(0)]
    followed = [np.empty(0)]
    chains = [np.empty((2, 0))]
    for first in evenly(count - steps + 1, config.most_frames // (4 * steps)):
        keys = np.arange(first, first + steps)
        if taught.drives[keys[0]] != taught.drives[keys[-1]]:
            continue
        least = map_config.elsewhere * length
        for z in taught.wrong_ways(keys, views(keys), blocks, least):
            fixed.append(z.ravel())
            start, view = np.unravel_index(z.mean(axis=1).argmax(), z[:, 0].shape)
            followed.append(z[start, :, view])
            chains.append(z[:, :2, z.shape[2] // 2].T)
    return np.concatenate(fixed), np.concatenate(followed), np.concatenate(chains, axis=1)


def _independent(poses: Floats, drives: Int32s, length: float) -> float:
    """Return the number of independent pairs of places: those a correlation length apart, of each drive."""
    total = 0.0
    for drive in np.unique(drives):
        steps = np.diff(poses[drives == drive, :2], axis=0)
        way = float(np.hypot(*steps.T).sum())
        total += (way / length) ** 2 / 2.0
    return total


def _correlation(pairs: AnyArray) -> float:
    """Return the correlation of pairs (2, n), 0.01 to 0.99; 0.5 for too few or constant pairs."""
    correlation = 0.5
    if pairs.shape[1] > 2 and bool((pairs.std(axis=1) > 0.0).all()):
        correlation = float(np.corrcoef(pairs)[0, 1])
    return min(max(correlation, 0.01), 0.99)


def gamma_of(cosine: float, correlation: float) -> float:
    """Return the exponent that maps a mean cosine of views to their correlation."""
    return math.log(correlation) / math.log(min(max(cosine, 0.01), 0.99))
