"""What the map measures on its drives: the camera, the scene, how alike views of one place are, and over which way.

Views are compared from poses with about the same heading, since a view that is turned is another one. A car may never
have the same heading twice: the turn between two of its views is undone by a virtual view, as in the filter.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression

from smal.arrays import AnyArray, Bools, Float32s, Floats, Indices, Int8s, Int32s
from smal.camera import STEP_DEG, STRAIGHT, TURNS_DEG, Camera, Image, Scene
from smal.features.extraction import in_parallel
from smal.files.packed import unpacked
from smal.keyframes import MapConfig
from smal.likelihood import Likelihood, evenly, standing_out
from smal.movement import Atom, seen_from, turns_ahead, wrapped

Describe = Callable[[Iterable[Image]], Float32s]  # Centred features (n, m) of n images.


@dataclass(frozen=True)
class CalibrationConfig:
    """Numbers by which views of drives measure the camera, the scene and how alike views are."""

    #: Fields of view that are tried, of rectilinear and of equidistant lenses: those of cameras on robots.
    fields_deg: tuple[float, ...] = tuple(range(40, 125, 5))
    wide_fields_deg: tuple[float, ...] = tuple(range(80, 205, 5))
    #: Heights of the camera that are tried, in correlation lengths, and distances of the scene in heights.
    heights: tuple[float, ...] = tuple(0.1 * 1.5**k for k in range(7))
    distances: tuple[float, ...] = tuple(3.0 * 2.0**k for k in range(6))
    pairs: int = 24  # Pairs of views that a fit looks at: more change nothing that is seen.
    most_apart: int = 100  # Frames between the two views of a pair.
    tells_camera_deg: float = 9.0  # A larger turn shows the camera.
    tells_scene_deg: float = 25.0  # A step with a smaller turn shows the scene.
    tells_turn_deg: float = 15.0  # Atoms that turn by so much together show how far one turns.
    same_deg: float = 3.0  # Turned by less, a view is the same.
    reach: float = 0.2  # Views of one place are looked for over this share of the longest way.
    most_frames: int = (
        1000  # Frames of a drive that are compared: time grows with the square; a millisecond each.
    )


CALIBRATION: Final = CalibrationConfig()
#: Cameras that are tried where nothing tells how far it sees; the first one is assumed where nothing tells it apart.
USUAL_CAMERAS: Final = (Camera.of_field(70.0), Camera.of_field(140.0, "equidistant"))
#: Turns from one view to another that a fit tries: those over which views overlap.
_OVERLAP_DEG: Final = float(TURNS_DEG[-1])
_TURNS_RAD: Final = np.radians(np.geomspace(1.0, _OVERLAP_DEG, 23)).tolist()


class _Pair(NamedTuple):
    """A frame, another one, and the step from the pose of the first to that of the second: ahead, left, turned."""

    frame: int
    other: int
    step: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class TaughtFrames:
    """All f frames of all drives, one drive after the other.

    Of each there are its image, its pose (f, 3), x, y and heading in radians, in axes of their own for each drive, and
    its drive (f,), ascending. `centred` gives the centred features (n, m), of unit length, of n of them, `describe`
    those of n images. Poses are by the wheels if there is `odometry`, else by what atoms usually do; `movements` (5, 2)
    are what each atom does between two frames. The camera is the one that was told, or that by which turns were
    measured.
    """

    images: Sequence[Image]
    centred: Callable[[Iterable[int]], Float32s]
    poses: Floats
    drives: Int32s
    describe: Describe
    movements: Floats
    odometry: bool = True
    camera: Camera | None = None
    config: CalibrationConfig = CALIBRATION

    @cached_property
    def car(self) -> bool:
        """Whether the robot goes ahead while it turns."""
        return turns_ahead(self.movements)

    def apart(self, frames: Indices) -> tuple[Floats, Floats]:
        """Return distances and angles between frames of one drive, (n, n) each.

        Whole turns of a car count: what is reckoned of its way does not lead back to where a lap began.
        """
        poses = self.poses[frames]
        across = poses[:, None, :2] - poses[None, :, :2]
        heading = np.unwrap(poses[:, 2]) if self.car else poses[:, 2]
        turned = heading[:, None] - heading[None, :]
        return np.hypot(across[..., 0], across[..., 1]), np.abs(
            turned if self.car else wrapped(turned)
        )

    def pairs(self, wanted: Callable[[Floats, Floats], Bools]) -> list[_Pair]:
        """Find for each frame the next one of its drive whose way and turn from it are wanted."""
        found: list[_Pair] = []
        for frame in range(len(self.poses) - 1):
            last = frame + 1 + self.config.most_apart
            after = np.flatnonzero(self.drives[frame + 1 : last] == self.drives[frame]) + frame + 1
            steps = seen_from(self.poses[after], self.poses[frame])
            good = np.flatnonzero(wanted(np.hypot(*steps[:, :2].T), np.abs(steps[:, 2])))
            if good.size:
                found.append(_Pair(frame, int(after[good[0]]), tuple(steps[good[0]].tolist())))
        return found

    def best(self, scenes: Sequence[Scene], pairs: Sequence[_Pair]) -> Scene:
        """Return the scene under which the first views of pairs predict the second ones best."""
        return _best(
            self.images, self.describe, [(scene, 1.0) for scene in scenes], pairs, self.config
        )[0]


def _best(
    images: Sequence[Image],
    describe: Describe,
    guesses: Sequence[tuple[Scene, float]],
    pairs: Sequence[_Pair],
    config: CalibrationConfig,
) -> tuple[Scene, float]:
    """Return the scene and the length of the steps' unit by which first views of pairs predict the second ones best."""
    some = [pairs[k] for k in evenly(len(pairs), config.pairs)]
    seen = [(images[pair.frame], describe([images[pair.other]])[0], pair.step) for pair in some]

    def score(guess: tuple[Scene, float]) -> float:
        scene, unit = guess
        views = describe(
            scene.warp(image, *(unit * part for part in step)) for image, _, step in seen
        )
        return float(sum(y @ view for (_, y, _), view in zip(seen, views, strict=True)))

    # OpenCV lets go of the interpreter's lock.
    return guesses[int(np.argmax(list(in_parallel(score, guesses))))]


def _far(camera: Camera) -> Scene:
    """Return a scene in which only turns change the view."""
    return Scene(camera, 1.0, 1e6)


def fit_camera(frames: TaughtFrames) -> Camera:
    """Find the camera by how turns, those with the least way, move what it sees; without any it is a usual one."""
    turns = frames.pairs(lambda _, turn: turn > math.radians(frames.config.tells_camera_deg))
    if not turns:
        return USUAL_CAMERAS[0]
    turns.sort(key=lambda pair: math.hypot(*pair.step[:2]))
    least = turns[: max(frames.config.pairs, len(turns) // 10)]
    cameras = [Camera.of_field(field) for field in frames.config.fields_deg]
    cameras += [Camera.of_field(field, "equidistant") for field in frames.config.wide_fields_deg]
    steps = [pair._replace(step=(0.0, 0.0, pair.step[2])) for pair in least]
    return frames.best([_far(one) for one in cameras], steps).camera


def fit_scene(frames: TaughtFrames, camera: Camera, length: float) -> Scene:
    """Find the height of the camera, and the distance of what it sees, by which views of the drives fit best."""
    steps = frames.pairs(
        lambda way, turn: (
            (way > 0.5 * length) & (turn < math.radians(frames.config.tells_scene_deg))
        )
    )
    if not steps:
        return Scene(camera, length / 3.0, length * 4.0)
    heights = [length * share for share in frames.config.heights]
    scene = frames.best(
        [Scene(camera, h, h * far) for h in heights for far in frames.config.distances], steps
    )
    return frames.best(
        [replace(scene, height=scene.height * 1.5**k) for k in (-0.5, -0.25, 0.0, 0.25, 0.5)], steps
    )


def turn_of_views(
    images: Sequence[Image],
    atoms: Sequence[Int8s],
    cameras: Sequence[Camera],
    describe: Describe,
    config: CalibrationConfig = CALIBRATION,
) -> tuple[Camera, float] | None:
    """Measure how far an atom of turning turns, by the turn under which views predict each other best.

    First over single atoms, then, more exactly, over several. With a wrong focal length the turn is wrong by as much,
    so that virtual views of the two together fit all the same. `atoms` (f,) were made after the images, of each drive;
    `describe` gives the centred features of images, (n, m). Returned are the one of the cameras that fits best, and
    radians; None where no drive turns.
    """
    made = np.concatenate(atoms)
    # After the last frame of a drive comes another one's first.
    made[np.cumsum([len(one) for one in atoms]) - 1] = Atom.STOP
    sign = (made == Atom.LEFT).astype(int) - (made == Atom.RIGHT).astype(int)
    guesses = [(_far(camera), turn_rad) for camera in cameras for turn_rad in _TURNS_RAD]
    found = None
    for _ in range(2):
        count = (
            1 if found is None else max(1, round(math.radians(config.tells_turn_deg) / found[1]))
        )
        same = np.flatnonzero(
            np.abs(np.convolve(sign, np.ones(count, dtype=int), mode="valid")) == count
        )
        if not same.size:
            break
        turns = [_Pair(k, k + count, (0.0, 0.0, float(sign[k]))) for k in same.tolist()]
        scene, turn_rad = _best(images, describe, guesses, turns, config)
        found = scene.camera, turn_rad / count
    return found


def correlation_length(frames: TaughtFrames, camera: Camera) -> tuple[float, float]:
    """Measure the way over which the mean cosine of two views falls half way to that of unrelated ones; and the latter.

    ValueError where no drive goes anywhere, or all images look the same.
    """
    ways = []
    cosines = []
    distant = []
    curves = []
    blind = True
    for drive in np.unique(frames.drives):
        every = np.flatnonzero(frames.drives == drive)
        some = every[_near_and_far(every.size, frames.config.most_frames)]
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
        curves.append(
            some[np.argwhere(np.triu(near & ~same & (turned < math.radians(_OVERLAP_DEG))))]
        )
    if not ways:
        raise ValueError("the robot does not move in any demonstration")
    if blind:
        raise ValueError("all images of the demonstrations look the same")
    if frames.car:
        way, cosine = _turns_undone(frames, camera, np.concatenate(curves))
        ways = [way, *ways]
        cosines = [cosine, *cosines]
    unrelated = float(np.concatenate(distant).mean())
    way = np.concatenate(ways)
    cosine = np.concatenate(cosines)
    reach = float(way.max())
    while True:
        if not (way[way <= reach] > 0.0).any():
            raise ValueError(
                "between two images of the demonstrations nothing stays alike: frames are too far apart"
            )
        edges = np.linspace(0.0, reach, 100)
        within = way <= reach
        where = np.digitize(way[within], edges[1:-1])
        count = np.bincount(where, minlength=99)
        full = count > 0
        mean = np.bincount(where, cosine[within], minlength=99)[full] / count[full]
        length = _half_way(
            ((edges[:-1] + edges[1:]) / 2.0)[full], mean, count[full], 1.0, unrelated
        )
        # On a long way it is within the first few steps: look closer.
        if length > 0.1 * reach:
            return length, unrelated
        reach = 4.0 * length


def _near_and_far(count: int, most: int) -> Indices:
    """Return all numbers below a count, or about so many, with pairs near each other and far apart.

    Those are evenly spread numbers, and after each of them some that are ever further away.
    """
    if count <= most:
        return np.arange(count)
    each = math.isqrt(most)
    after = np.geomspace(1.0, count / each, each).astype(np.intp) - 1
    return np.unique(np.minimum(evenly(count, each)[:, None] + after, count - 1))


def _turns_undone(frames: TaughtFrames, camera: Camera, pairs: Indices) -> tuple[Floats, Floats]:
    """Compare frames, the first as it would have been seen with the second's heading: distances, cosines."""
    first, second = pairs[evenly(len(pairs), frames.config.most_frames // 2)].T
    steps = frames.poses[second] - frames.poses[first]

    def cosine(pair: tuple[int, int, float]) -> float:
        one, other, turn_rad = pair
        turned = _far(camera).warp(frames.images[one], turn_rad=turn_rad)
        return float(frames.describe([turned])[0] @ frames.centred([other])[0])

    each = zip(first.tolist(), second.tolist(), wrapped(steps[:, 2]).tolist(), strict=True)
    return np.hypot(*steps[:, :2].T), np.array(list(in_parallel(cosine, each)))


def correlation_turn(frames: TaughtFrames, camera: Camera, unrelated: float) -> float:
    """Measure the turn (radians) after which a view is half way from itself to the mean cosine of unrelated views."""
    some = evenly(len(frames.images), frames.config.pairs).tolist()
    own = frames.centred(some)
    images = [frames.images[k] for k in some]

    def turned_by(turn_rad: float) -> Float32s:
        return frames.describe(_far(camera).warp(image, turn_rad=turn_rad) for image in images)

    turned = list(in_parallel(turned_by, _TURNS_RAD))
    mean = np.array([1.0, *(float((own * views).sum(axis=1).mean()) for views in turned)])
    return _half_way(np.array([0.0, *_TURNS_RAD]), mean, np.ones_like(mean), 1.0, unrelated)


def _half_way(
    far: Floats,
    cosines: AnyArray,
    counts: AnyArray,
    best: float,
    unrelated: float,
) -> float:
    """Return how far it is to where cosines are half way from the best one to that of unrelated views.

    They fall. Each is the mean of so many pairs; where few are less alike than what is further away, they are taken
    together with that.
    """
    falling = isotonic_regression(cosines, weights=counts, increasing=False)
    firsts = falling.blocks[:-1]
    middles = np.add.reduceat(far * counts, firsts) / falling.weights
    return float(np.interp(-(best + unrelated) / 2.0, -falling.x[firsts], middles))


@dataclass(frozen=True, eq=False)
class _Looks:
    """The views of k keyframes as a robot at each of them sees them."""

    poses: Floats  # (k, 3)
    drives: Int32s  # (k,)
    views: Int8s  # (k, 3, turns, r)
    own: Float32s  # (k, r) straight ahead from the keyframe itself.
    sample: Float32s  # Views that are the sample of elsewhere.

    def stands_out(self, cosines: AnyArray, key: int) -> AnyArray:
        """Return by how much cosines with the view of a keyframe stand out."""
        return standing_out(cosines, self.sample @ self.own[key])

    def neighbours(self, key: int) -> list[int]:
        """Return the keyframes before and after one on its drive."""
        near = range(max(key - 1, 0), min(key + 2, len(self.drives)))
        return [other for other in near if other != key and self.drives[other] == self.drives[key]]

    def far(self, key: int, least: float) -> Bools:
        """Return which keyframes of the same drive are further away than this."""
        apart = np.hypot(*(self.poses - self.poses[key])[:, :2].T)
        return np.asarray((self.drives == self.drives[key]) & (apart > least))

    def beside(self, key: int, other: int) -> float | None:
        """Return by how much a neighbour's view, turned as the robot is, stands out; None beyond all its views."""
        turned = math.degrees(seen_from(self.poses[other], self.poses[key])[2])
        turn = STRAIGHT - round(turned / STEP_DEG)
        if not 0 <= turn < TURNS_DEG.size:
            return None
        cosine = unpacked(self.views[other, 1, turn]) @ self.own[key]
        return float(self.stands_out(cosine, key))

    def both(self, key: int, far: Bools) -> Floats:
        """Return what a keyframe and the next say of places far away and of the next ones there, (2, n)."""
        on = np.flatnonzero(far[:-1] & far[1:] & (np.diff(self.drives) == 0))
        here, after = (self.stands_out(self.own @ self.own[k], k) for k in (key, key + 1))
        return np.stack([here[on], after[on + 1]])


def likelihood_of_views(
    frames: TaughtFrames,
    keyframes: Int32s,
    views: Int8s,
    length: float,
    config: MapConfig,
) -> tuple[Likelihood, float]:
    """Measure on keyframes (k,) and their views (k, 3, turns, r) what views say, and how far neighbours say the same.

    Each keyframe's own view is looked at as if it were a robot's: its neighbours show the same place, what is
    `MapConfig.elsewhere` away on the same drive another one. Without such places (a short drive in one room)
    elsewhere is what a normal distribution says. What a keyframe and the next say of such places correlates by the
    second value. ValueError if no keyframe has a neighbour.
    """
    poses = frames.poses[keyframes]
    drives = frames.drives[keyframes]
    count = len(views)
    own = unpacked(views[:, 1, STRAIGHT])
    looks = _Looks(poses, drives, views, own, own[evenly(count, config.reference)])
    some = evenly(count, frames.config.most_frames)
    places = unpacked(views[some])
    here: list[float | None] = []
    elsewhere = []
    alike = []
    chains: list[AnyArray] = [np.empty((2, 0))]
    for key in evenly(count, frames.config.most_frames // 4).tolist():
        far = looks.far(key, config.elsewhere * length)
        elsewhere.append(looks.stands_out(places[far[some]] @ own[key], key).ravel())
        neighbours = looks.neighbours(key)
        here += [looks.beside(key, other) for other in neighbours]
        if key + 1 in neighbours:
            first, second = frames.centred(keyframes[key : key + 2])
            alike.append(float(first @ second))
            chains.append(looks.both(key, far))
    shown = [z for z in here if z is not None]
    if not shown:
        raise ValueError(
            "the demonstrations are too short, or their frames too far apart, to tell how alike views of one place are"
        )
    ways = [
        float(np.hypot(*np.diff(poses[drives == one, :2], axis=0).T).sum())
        for one in np.unique(drives)
    ]
    independent = sum((way / length) ** 2 / 2.0 for way in ways)
    apart = np.concatenate(elsewhere)
    if not apart.size:
        apart = np.random.default_rng(0).standard_normal(10_000)
    pairs = np.concatenate(chains, axis=1)
    told = pairs.shape[1] > 2 and bool((pairs.std(axis=1) > 0.0).all())
    correlation = min(max(float(np.corrcoef(pairs)[0, 1]) if told else 0.5, 0.01), 0.99)
    gamma = gamma_of(float(np.mean(alike)), correlation)
    return Likelihood.fit(np.array(shown), apart, independent, gamma, config), correlation


def gamma_of(cosine: float, correlation: float) -> float:
    """Return the exponent by which views of this mean cosine correlate so."""
    return math.log(correlation) / math.log(min(max(cosine, 0.01), 0.99))
