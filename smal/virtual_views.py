"""Views from where nobody drove: a taught image as a camera a little aside, or turned, would have seen it.

One drive shows every place from one pose. A robot that drifts sees it from others, and the paper needs a demonstration
for each. We warp the taught image instead. A pure turn is a homography, exact whatever the scene is. For a step aside
or ahead we need distances, and take the simplest scene that has any: flat ground under the camera, and everything above
it at one distance. Focal length, height of the camera and that distance are those by which views that were taught
predict other views of the same drive best (`fit_scene`), so nobody has to measure them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.demonstration import Image
from smal.movement import Atom, seen_from
from smal.settings import SETTINGS

#: Turns of the virtual views, degrees.
TURNS_DEG = np.array(SETTINGS.turns_deg)
#: Turns from one view to another that a fit tries, degrees: those over which views overlap.
_TURNS_DEG = tuple(np.geomspace(1.0, 40.0, 23).tolist())


def _focal_of(field_deg: float) -> float:
    return 0.5 / math.tan(math.radians(field_deg) / 2.0)


#: Focal length over the image's width that is assumed where no drive turns.
USUAL_FOCAL = _focal_of(SETTINGS.usual_field_deg)
Maps = tuple[NDArray[Any], NDArray[Any]]


@dataclass(frozen=True)
class Scene:
    """A pinhole camera over flat ground, before a wall all round.

    Parameters
    ----------
    focal : float
        Focal length over the image's width, above 0; the optical axis meets the image in its middle, and is level.
    height : float
        Of the camera above the ground, above 0.
    distance : float
        Of everything above the ground, above 0; in the same unit as the height.
    """

    focal: float
    height: float
    distance: float

    def warp(self, image: Image, ahead: float = 0.0, left: float = 0.0, turn_rad: float = 0.0) -> Image:
        """Return what is seen from a pose beside the one at which an image was taken.

        Parameters
        ----------
        image : uint8 array (height, width, 3)
        ahead, left : float
            Where the other pose is, in the unit of the scene.
        turn_rad : float
            How far it is turned left.

        Returns
        -------
        uint8 array (height, width, 3)
            What the image does not show repeats its border.
        """
        return remapped(image, self.maps(image.shape[:2], ahead, left, turn_rad))

    def maps(self, shape: tuple[int, ...], ahead: float, left: float, turn_rad: float) -> Maps:
        """Return where each pixel of the other view lies in an image of this shape, for `remapped`."""
        import cv2  # noqa: PLC0415 - processes that only read models have no OpenCV

        rows, columns = shape
        focal = self.focal * columns
        middle_u, middle_v = (columns - 1) / 2.0, (rows - 1) / 2.0
        v, u = np.mgrid[0:rows, 0:columns].astype(np.float32)
        across, down = (u - middle_u) / focal, (v - middle_v) / focal
        # The ray of each pixel, in axes of the camera that took the image: right, down, ahead.
        right = math.cos(turn_rad) * across - math.sin(turn_rad)
        deep = math.sin(turn_rad) * across + math.cos(turn_rad)
        # How far along the ray the ground or the wall is, whichever comes first.
        reach = 1.0 / np.maximum(down / self.height, np.hypot(right, deep) / self.distance)
        # A point behind the image has no pixel; far outside it, the border is repeated.
        z = np.maximum(reach * deep + ahead, 1e-3 * self.height)
        x, y = reach * right - left, reach * down
        return cv2.convertMaps(
            (focal * x / z + middle_u).astype(np.float32), (focal * y / z + middle_v).astype(np.float32), cv2.CV_16SC2
        )


def remapped(image: Image, maps: Maps) -> Image:
    """Return another view of an image (height, width, 3); maps are made once for many images (`Scene.maps`)."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(
        cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8
    )


def fit_scene(
    images: Sequence[Image],
    poses: NDArray[np.float64],
    drives: NDArray[np.int32],
    correlation_length: float,
    describe: Callable[[Image], NDArray[np.float32]],
    focal: float | None = None,
) -> Scene:
    """Find the camera and the scene by which views of the drives predict each other best.

    Parameters
    ----------
    images : sequence of uint8 arrays (height, width, 3)
    poses : float64 array (f, 3)
        Of every image: x, y, heading in radians.
    drives : int array (f,)
        Which drive each is of.
    correlation_length : float
        Way ahead over which views become unlike, in the unit of the poses.
    describe : callable
        Centred features of an image, of unit length.
    focal : float, optional
        Focal length over the image's width, where it is known.

    Returns
    -------
    Scene
    """
    scene = Scene(focal or USUAL_FOCAL, correlation_length / 3.0, correlation_length * 4.0)
    if focal is None:
        turns = _pairs(
            poses, drives, lambda ahead, turn: (ahead < 0.02 * correlation_length) & (turn > math.radians(9))
        )
        scene = _best(
            scene, [replace(scene, focal=_focal_of(field)) for field in SETTINGS.fields_deg], images, turns, describe
        )
    steps = _pairs(poses, drives, lambda ahead, turn: (ahead > 0.5 * correlation_length) & (turn < math.radians(25)))
    heights = [correlation_length * share for share in SETTINGS.heights]
    scenes = [replace(scene, height=h, distance=h * far) for h in heights for far in SETTINGS.distances]
    scene = _best(scene, scenes, images, steps, describe)
    near = [replace(scene, height=scene.height * 1.5**k) for k in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    return _best(scene, near, images, steps, describe)


def focal_of_curves(
    images: Sequence[Image],
    poses: NDArray[np.float64],
    drives: NDArray[np.int32],
    describe: Callable[[Image], NDArray[np.float32]],
) -> float:
    """Find the focal length of a car's camera, by how far a curve moves what it sees; parameters as of `fit_scene`.

    A robot that turns on the spot tells it more exactly (`fit_scene`); this one goes ahead as well.
    """
    curves = _pairs(poses, drives, lambda _, turn: turn > math.radians(9))
    turns = [(frame, other, 0.0, 0.0, turn) for frame, other, _, _, turn in curves]
    scenes = [Scene(_focal_of(field), 1.0, 1e6) for field in SETTINGS.fields_deg]
    return _best(Scene(USUAL_FOCAL, 1.0, 1e6), scenes, images, turns, describe).focal


def turn_of_views(
    images: Sequence[Image],
    atoms: Sequence[NDArray[np.int8]],
    focal: float,
    describe: Callable[[Image], NDArray[np.float32]],
) -> float | None:
    """Measure how far an atom of turning turns, by the turn under which views predict each other best.

    First over single atoms, then, more exactly, over as many as turn about 15 degrees. With a wrong focal length the
    turn is wrong by as much, so that virtual views of the two together fit all the same.

    Parameters
    ----------
    images : sequence of uint8 arrays (height, width, 3)
    atoms : sequence of int8 arrays
        Made after the images, of each drive.
    focal : float
        Focal length over the image's width.
    describe : callable
        Centred features of an image, of unit length.

    Returns
    -------
    float or None
        Radians; None where no drive turns.
    """
    made = np.concatenate(atoms)
    # After the last frame of a drive comes another one's first.
    made[np.cumsum([len(one) for one in atoms]) - 1] = Atom.STOP
    sign = (made == Atom.LEFT).astype(int) - (made == Atom.RIGHT).astype(int)
    scene = Scene(focal, 1.0, 1e6)
    found = None
    for _ in range(2):
        count = 1 if found is None else max(1, round(math.radians(15.0) / found))
        same = np.abs(np.convolve(sign, np.ones(count, dtype=int), mode="valid")) == count
        frames = np.flatnonzero(same)
        frames = (
            frames[np.unique(np.linspace(0, frames.size - 1, SETTINGS.pairs).astype(int))] if frames.size else frames
        )
        if not frames.size:
            break
        seen = [(images[k], describe(images[k + count]), sign[k]) for k in frames.tolist()]
        scores = [
            sum(float(y @ describe(scene.warp(image, turn_rad=side * math.radians(turn)))) for image, y, side in seen)
            for turn in _TURNS_DEG
        ]
        found = math.radians(_TURNS_DEG[int(np.argmax(scores))]) / count
    return found


Pair = tuple[int, int, float, float, float]


def _pairs(
    poses: NDArray[np.float64],
    drives: NDArray[np.int32],
    wanted: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]],
) -> list[Pair]:
    """Choose pairs of frames of one drive, the second the first after the first one that is as wanted.

    Each is (frame, other, ahead, left, turn) of the other as seen from the frame.
    """
    found: list[Pair] = []
    for frame in range(len(poses) - 1):
        ahead_of = np.flatnonzero(drives[frame + 1 : frame + 101] == drives[frame]) + frame + 1
        steps = seen_from(poses[ahead_of], poses[frame])
        good = np.flatnonzero(wanted(np.hypot(*steps[:, :2].T), np.abs(steps[:, 2])))
        if good.size:
            ahead, left, turn = steps[good[0]].tolist()
            found.append((frame, int(ahead_of[good[0]]), ahead, left, turn))
    return [found[k] for k in np.unique(np.linspace(0, len(found) - 1, SETTINGS.pairs).astype(int))] if found else []


def _best(
    scene: Scene,
    scenes: Sequence[Scene],
    images: Sequence[Image],
    pairs: Sequence[Pair],
    describe: Callable[[Image], NDArray[np.float32]],
) -> Scene:
    """Return the scene under which the first views of pairs predict the second ones best; the given one without any."""
    if not pairs:
        return scene
    seen = [(images[frame], describe(images[other]), step) for frame, other, *step in pairs]

    def score(one: Scene) -> float:
        return sum(float(y @ describe(one.warp(image, *step))) for image, y, step in seen)

    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415 - only learning needs it

    # OpenCV lets go of the interpreter's lock.
    with ThreadPoolExecutor() as pool:
        scores = list(pool.map(score, scenes))
    return scenes[int(np.argmax(scores))]
