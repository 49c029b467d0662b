"""From drives to the visual map: the way, the camera, how alike views are, keyframes and their virtual views.

Read `learn` from top to bottom.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from smal.camera import TURNS_DEG, Camera, Image, Maps, Scene, remapped
from smal.features import Centering, FeatureSettings, extract
from smal.features.detectors import Detection
from smal.features.extraction import Parallel, detect, in_parallel
from smal.features.resizing import small
from smal.files.packed import packed, unit
from smal.keyframes import MAP_CONFIG, MapConfig, leads_on, shows_same
from smal.likelihood import evenly
from smal.map import VisualMap, beside, way_from
from smal.model import Model
from smal.movement import Atom, dead_reckoning
from smal.obstacles.strange import GROUND_CONFIG, Ground, colours_of, extreme, patches, swept
from smal.sought.learning import Box, Taught, learn_sight, learn_word
from smal.sought.sight import Sight
from smal.sought.word import Word
from smal.teaching.calibration import (
    USUAL_CAMERAS,
    TaughtFrames,
    correlation_length,
    correlation_turn,
    fit_camera,
    fit_scene,
    likelihood_of_views,
    turn_of_views,
)
from smal.teaching.demonstration import (
    USUAL_GOAL,
    Demonstration,
    Task,
    chained,
    check_features,
    described,
    drives_to_goals,
    every,
    tasks_of,
)
from smal.teaching.movements import atom_movements
from smal.teaching.stitches import stitched

T = TypeVar("T")
Progress = Callable[[str, int, int], None]


def learn(
    demonstrations: Sequence[Demonstration],
    features: FeatureSettings | None = None,
    tick_s: float = 0.1,
    progress: Progress = lambda _stage, _done, _total: None,
    parallel: Parallel = in_parallel,
    config: MapConfig = MAP_CONFIG,
) -> Model:
    """Make a map of those drives of one robot that reached the goal and have images.

    If one is without odometry, all go by the usual movements of atoms: a forward atom is one unit long, and an atom of
    turning turns as far as the views say (`turn_of_views`), on the spot or ahead as well.

    `features` are of colour images alone, `tick_s` is the time between two frames, and `progress` is called with the
    stage ("frames", "views" of keyframes), done and total. What takes long of each image is done by `parallel`, by
    threads if not given. The model keeps the `config`.
    ValueError where there is no such drive, or none that goes anywhere, or features do not fit, or need depth.
    """
    features = FeatureSettings() if features is None else features
    whole = _drives_to_map(demonstrations, features, tick_s)
    taught = [drive for _, drive in whole]
    rows = (row[None] for one in taught for row in every(one.features, parallel))
    centering = Centering.fit(
        _told(progress, "frames", rows, sum(len(one.atoms) for one in taught)), features
    )
    frames = _frames(taught, centering, tick_s, config)
    camera = frames.camera or fit_camera(frames)
    length, unrelated = correlation_length(frames, camera)
    _check_extent(frames, [names[0] for names, _ in whole], length / config.views_a_length)
    aside = config.aside * length
    scene = fit_scene(frames, camera, length)
    keyframes = _choose_keyframes(frames.poses, frames.drives, length, config)
    views, basis = _make_views(
        frames, keyframes, partial(_views_of, scene, aside, centering), progress, parallel, config
    )
    likelihood, correlation = likelihood_of_views(frames, keyframes, views, length, config)
    visual_map = VisualMap(
        poses=frames.poses,
        drives=frames.drives,
        keyframes=keyframes,
        basis=basis,
        views=views,
        blank=unit(frames.describe([np.full_like(frames.images[0], 128)])[0] @ basis),
        aside=aside,
        correlation_length=length,
        correlation_rad=correlation_turn(frames, camera, unrelated),
        log_ratio=likelihood.log_ratio,
        gamma=likelihood.gamma,
        next_correlation=correlation,
        movements=frames.movements,
        tick_s=tick_s,
        odometry=frames.odometry,
        scene=np.array([camera.field_deg, scene.height, scene.distance]),
        goals=tuple(one.goal for one in taught),
        names=tuple(names for names, _ in whole),
        size=(frames.images[0].shape[1], frames.images[0].shape[0]),
        config=config,
    )
    boxes = [one.box for one in taught]
    visual_map = stitched(visual_map)
    return Model(centering, visual_map, *_seen(frames.images, visual_map, boxes, features))


def _drives_to_map(
    demonstrations: Sequence[Demonstration], features: FeatureSettings, tick_s: float
) -> list[tuple[tuple[str, ...], Demonstration]]:
    """Return the drives that a map is made of, each with its names; ValueError as `learn`."""
    check_features(demonstrations, features.size)
    if features.needs != {"color"}:
        raise ValueError(
            "views from where nobody drove have no depth: a map is of color images alone"
        )
    if not (math.isfinite(tick_s) and tick_s > 0.0):
        raise ValueError(f"tick_s must be finite and positive, got {tick_s}")
    whole = drives_to_goals(demonstrations)
    if not whole:
        raise ValueError("no drive reached the goal and has images")
    return whole


def _check_extent(frames: TaughtFrames, names: Sequence[str], least: float) -> None:
    """ValueError for a drive in which the robot moves less far."""
    for drive, name in enumerate(names):
        extent = np.ptp(frames.poses[frames.drives == drive, :2], axis=0)
        if np.hypot(*extent) < least:
            raise ValueError(f"demonstration {name}: the robot hardly moves in it; leave it out")


def fit(
    drives: Sequence[tuple[Any, ...]],
    features: FeatureSettings | None = None,
    goals: Sequence[str] | None = None,
    camera: Camera | None = None,
    tick_s: float = 0.1,
    parallel: Parallel = in_parallel,
) -> Model:
    """Learn from images and what was done at each of them.

    `drives` reached the goal: (images, atoms) or (images, atoms, odometry) of each, images (height, width, 3) uint8
    RGB, an `Atom` for each, and the pose of each by the wheels (x, y, heading in radians). `goals` is where each leads,
    all to one goal if not given, `tick_s` the time between two images; the camera is estimated from them if not given.
    `parallel` is `map` of an executor of yours (`concurrent.futures`), for more cores than threads use, or machines.

    >>> model = smal.fit([(images, atoms)])  # doctest: +SKIP
    >>> robot = smal.Robot(model)  # doctest: +SKIP
    >>> linear, angular = robot.step(image)  # doctest: +SKIP
    """
    features = FeatureSettings() if features is None else features
    return learn(
        demonstrations_of(drives, features, goals, camera), features, tick_s, parallel=parallel
    )


def demonstrations_of(
    drives: Sequence[tuple[Any, ...]],
    features: FeatureSettings,
    goals: Sequence[str] | None = None,
    camera: Camera | None = None,
) -> list[Demonstration]:
    """Return drives with what describes their images, made when it is wanted; see `fit`."""
    goals = [USUAL_GOAL] * len(drives) if goals is None else goals
    return [
        Demonstration(
            f"drive-{number}",
            described(images, features),
            np.asarray(atoms, dtype=np.int8),
            images=images,
            odometry=np.asarray(odometry[0], dtype=np.float64) if odometry else None,
            goal=goal,
            camera=camera,
        )
        for number, ((images, atoms, *odometry), goal) in enumerate(zip(drives, goals, strict=True))
    ]


def _described(centering: Centering, views: Iterable[Image]) -> NDArray[np.float32]:
    return centering.apply(np.stack([extract(view, centering.settings) for view in views]))


def _centred(
    centering: Centering, features: Sequence[NDArray[np.float32]], some: Iterable[int]
) -> NDArray[np.float32]:
    return centering.apply(np.stack([features[frame] for frame in some]))


def _frames(
    taught: Sequence[Demonstration], centering: Centering, tick_s: float, config: MapConfig
) -> TaughtFrames:
    """Put drives one after the other: along the wheels' poses, or by what atoms usually do."""
    images = chained(list(_known(one.images for one in taught)))
    features = chained([one.features for one in taught])
    cameras = list(_known(one.camera for one in taught))
    camera = cameras[0] if cameras else None
    atoms = [one.atoms for one in taught]

    centred = partial(_centred, centering, features)
    describe = partial(_described, centering)
    ways = [np.asarray(way, dtype=np.float64) for way in _known(one.odometry for one in taught)]
    odometry = len(ways) == len(taught)
    if odometry:
        movements = atom_movements(ways, atoms)
    else:
        tried = tuple(cameras[:1]) or USUAL_CAMERAS
        usual = tried[0], math.radians(config.usual_turn_deg_s) * tick_s
        camera, turn_rad = turn_of_views(images, atoms, tried, describe) or usual
        ahead = _ahead_in_turns(taught)
        movements = np.array(
            [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [ahead, turn_rad], [ahead, -turn_rad]]
        )
        ways = [dead_reckoning(one, movements) for one in atoms]
    drives = np.repeat(np.arange(len(ways), dtype=np.int32), [len(way) for way in ways])
    return TaughtFrames(
        images, centred, np.concatenate(ways), drives, describe, movements, odometry, camera
    )


def _known(each: Iterable[T | None]) -> Iterator[T]:
    return (one for one in each if one is not None)


def _ahead_in_turns(taught: Sequence[Demonstration]) -> float:
    """Return how fast the robot usually goes ahead in turning, as a share of its speed straight on.

    What is not told is none, but where nothing else would move the robot.
    """
    told = [
        one.ahead[(one.atoms == Atom.LEFT) | (one.atoms == Atom.RIGHT)]
        for one in taught
        if one.ahead is not None
    ]
    if any(map(len, told)):
        return float(np.median(np.concatenate(told)))
    return 0.0 if any((one.atoms == Atom.FORWARD).any() for one in taught) else 1.0


def _seen(
    images: Sequence[Image],
    mapped: VisualMap,
    boxes: Sequence[Box | None],
    features: FeatureSettings,
) -> tuple[dict[str, Sight], dict[str, Word], Ground]:
    """Learn what is sought at each goal, of the goals where anything stands out, or is drawn in the last view.

    And what detectors find there, if any are among the features; and how the ground looks.
    """
    keys = mapped.keyframes
    of = mapped.key_drives

    def looked(frame: int) -> tuple[Image, list[Detection]]:
        image = images[frame]
        return small(image), detect(image, features)

    pictures, detected = zip(*in_parallel(looked, keys.tolist()), strict=True)
    ends = np.searchsorted(of, of, side="right") - 1
    left_s = (mapped.arc[keys[ends]] - mapped.arc[keys]) / max(mapped.speed, 1e-9)
    drives = [np.flatnonzero(of == drive).tolist() for drive in range(len(mapped.goals))]
    sights = {}
    words = {}
    for goal in sorted(set(mapped.goals)):
        taught = [
            Taught(
                [pictures[k] for k in one],
                left_s[one],
                mapped.goals[drive] == goal,
                boxes[drive],
                [detected[k] for k in one],
            )
            for drive, one in enumerate(drives)
        ]
        if (sight := learn_sight(taught)) is not None:
            sights[goal] = sight
        if (word := learn_word(taught)) is not None:
            words[goal] = word
    return sights, words, _ground(pictures, mapped)


def _ground(pictures: Sequence[Image], mapped: VisualMap) -> Ground:
    """Learn how the ground looks, and from where on it is strange: each keyframe is left out of what explains it."""
    colours = np.stack([colours_of(one) for one in pictures])

    def strangest(key: int) -> float:
        others = np.setdiff1d(beside(mapped, key, GROUND_CONFIG.keyframes), key)
        way = way_from(mapped, key, np.zeros(3), swept(mapped.speed))
        return float(patches(pictures[key], colours[others], way, mapped.scene)[1].max(initial=0.0))

    # Of a drive of one keyframe nothing is left.
    alone = mapped.key_range[0] == mapped.key_range[1]
    scores = list(in_parallel(strangest, np.flatnonzero(~alone).tolist()))
    return Ground(colours, max(extreme(scores), GROUND_CONFIG.least))


def _choose_keyframes(
    poses: NDArray[np.float64], drives: NDArray[np.int32], length: float, config: MapConfig
) -> NDArray[np.int32]:
    """Take the first and last frame of each drive, and all that are far or turned from the one before."""
    ends = np.diff(drives, prepend=-1, append=-1) != 0
    chosen: list[int] = []
    for frame in np.flatnonzero(leads_on(poses, drives, length, config)):
        if (
            ends[frame]
            or ends[frame + 1]
            or not shows_same(poses[frame, None], poses[chosen[-1]], length, config)[0]
        ):
            chosen.append(int(frame))
    return np.array(chosen, dtype=np.int32)


def virtual_poses(aside: float) -> list[tuple[float, float, float]]:
    """Return from where a keyframe's virtual views are seen: ahead, left, turned left in radians."""
    return [(0.0, left, math.radians(turn)) for left in (-aside, 0.0, aside) for turn in TURNS_DEG]


@lru_cache(maxsize=2)  # Drives may be of cameras of different sizes.
def _maps_of(scene: Scene, aside: float, shape: tuple[int, ...]) -> list[Maps]:
    return [scene.maps(shape, *pose) for pose in virtual_poses(aside)]


def _views_of(scene: Scene, aside: float, centering: Centering, image: Task) -> NDArray[np.float32]:
    seen = image()
    return _described(
        centering, (remapped(seen, one) for one in _maps_of(scene, aside, seen.shape[:2]))
    )


def _in_components(
    basis: NDArray[np.float32], rows_of: Callable[[Any], NDArray[np.float32]], of: object
) -> NDArray[np.int8]:
    return packed(rows_of(of) @ basis)


def _told(
    progress: Progress, stage: str, made: Iterable[T], total: int, done: int = 0
) -> Iterator[T]:
    """Yield what is made, and tell how much of it is there."""
    for number, one in enumerate(made, done + 1):
        progress(stage, number, total)
        yield one


def _make_views(
    frames: TaughtFrames,
    keyframes: NDArray[np.int32],
    views_of: Callable[[Task], NDArray[np.float32]],
    progress: Progress,
    parallel: Parallel,
    config: MapConfig,
) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Make the virtual views of keyframes, and the components in which they are kept."""
    # All views at once would take gigabytes for a long drive: components first, from a sample of keyframes.
    each = len(virtual_poses(0.0))
    sample = keyframes[evenly(keyframes.size, max(1, config.sampled_views // each))].tolist()
    first = parallel(views_of, tasks_of(frames.images, sample))
    made = dict(zip(sample, _told(progress, "views", first, keyframes.size), strict=True))
    basis = _components(np.concatenate(list(made.values())), config)
    others = [frame for frame in keyframes.tolist() if frame not in made]
    further = parallel(partial(_in_components, basis, views_of), tasks_of(frames.images, others))
    further = _told(progress, "views", further, keyframes.size, len(made))
    views = np.empty(
        (keyframes.size, each // TURNS_DEG.size, TURNS_DEG.size, basis.shape[1]), dtype=np.int8
    )
    for key, frame in enumerate(keyframes.tolist()):
        row = _in_components(basis, made.pop, frame) if frame in made else next(further)
        views[key] = row.reshape(views.shape[1:])
    return views, basis


def _components(sample: NDArray[np.float32], config: MapConfig) -> NDArray[np.float32]:
    """Return the leading principal components of rows (s, m), (m, r), those of much variance made smaller."""
    products = sample @ sample.T
    # All components take three times as long.
    values, vectors = eigh(
        products, subset_by_index=[max(0, len(sample) - config.most_components), len(sample) - 1]
    )
    kept = values > 1e-6 * values[-1]
    values = values[kept][::-1]
    vectors = vectors[:, kept][:, ::-1]
    # Of length 1 are the columns of sample.T @ vectors over the square root of their value.
    basis: NDArray[np.float32] = (sample.T @ vectors / values ** (0.5 + config.whitened)).astype(
        np.float32
    )
    return basis
