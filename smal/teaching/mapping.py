"""From drives to the visual map: the way, the camera, the correlation of views, keyframes and their virtual views.

Read `learn` from top to bottom.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar

import numpy as np
from scipy.linalg import eigh

from smal.arrays import Float32s, Floats, Indices, Int8s, Int32s, evenly
from smal.camera import TURNS_DEG, Camera, Image, Maps, Scene, remapped
from smal.features import Centering, FeatureSettings, extract
from smal.features.detectors import Detection
from smal.features.extraction import Parallel, detect, in_parallel, looked_at
from smal.features.resizing import fitted, small
from smal.files.packed import packed, unit
from smal.keyframes import MAP_CONFIG, MapConfig, shows_same, without_detours
from smal.map import VisualMap, beside, way_from
from smal.model import Model
from smal.movement import Atom
from smal.obstacles.ground import GROUND_CONFIG, Ground, colours_of, extreme, patches, swept
from smal.target.appearance import TargetAppearance
from smal.target.label import TargetLabel
from smal.target.learning import Box, Taught, learn_appearance, learn_label
from smal.teaching.calibration import (
    CALIBRATION_CONFIG,
    USUAL_CAMERAS,
    TaughtFrames,
    compared_frames,
    correlation_length,
    correlation_turn,
    fit_camera,
    fit_scene,
    likelihood_of_views,
    turn_of_views,
)
from smal.teaching.demonstration import (
    Demonstration,
    Drive,
    DriveUse,
    Task,
    chained,
    check_features,
    every,
    seen_by,
    tasks_of,
    whole_drives,
)
from smal.teaching.from_arrays import demonstrations_of
from smal.teaching.gaps import reckoned
from smal.teaching.movements import atom_movements
from smal.teaching.stitches import stitched

T = TypeVar("T")
Progress = Callable[[str, int, int], None]
Report = Callable[[DriveUse], None]


def warn_of_unused(use: DriveUse) -> None:
    """Warn of a drive that does not teach."""
    if not use.used:
        warnings.warn(f"drive {use.drive} does not teach: {use.note}", stacklevel=2)


def learn(
    demonstrations: Sequence[Demonstration],
    features: FeatureSettings | None = None,
    tick_s: float = 0.1,
    progress: Progress = lambda _stage, _done, _total: None,
    parallel: Parallel = in_parallel,
    report: Report = warn_of_unused,
    config: MapConfig = MAP_CONFIG,
) -> Model:
    """Build a map from the drives of one robot that reached the goal and have images.

    If a drive has no odometry, all drives use the usual movements of atoms. A forward atom then has the length 1, and
    the turn of a turning atom is measured on the views (`turn_of_views`). Gaps in a drive are bridged: by odometry, or
    by how much the views on both sides differ (`smal.teaching.gaps`).

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    features : FeatureSettings, optional
        Features of colour images.
    tick_s : float
        Time between two frames, seconds.
    progress : callable
        Called with the stage ("frames", "views" of keyframes), the finished number, and the total.
    parallel : callable
        Runs the slow computations on images; by default threads.
    report : callable
        Called with the `DriveUse` of each drive; by default it warns of drives that do not teach.
    config : MapConfig
        Parameters of the map; the model stores them.

    Raises
    ------
    ValueError
        If there is no suitable drive, the robot moves in none, or the features do not fit or need depth.
    """
    features = FeatureSettings() if features is None else features
    drives = _drives_to_map(demonstrations, features, tick_s, report)
    described = chained([drive.whole.features for drive in drives])
    rows = _told(progress, "frames", every(described, parallel), len(described))
    kept = _Kept(described, [drive.frames for drive in drives])
    centering = Centering.fit(map(kept.keep, rows), features)
    frames = _frames(drives, kept, centering, tick_s, config)
    camera = frames.camera or fit_camera(frames)
    length, unrelated = correlation_length(frames, camera)
    moving = _moving(frames, drives, length / config.views_a_length, report)
    frames = frames.of_drives(moving)
    drives = [drives[number] for number in moving.tolist()]
    for drive in drives:
        report(DriveUse(drive.name, drive.frames, drive.frames, _note(drive, frames, tick_s)))
    taught = [drive.whole for drive in drives]
    images = chained(list(_known(drive.images for drive in taught)))
    aside = config.aside * length
    scene = fit_scene(frames, camera, length)
    keyframes = _choose_keyframes(frames.poses, frames.drives, length, config)
    views_of = partial(_views_of, scene, aside, centering)
    views, basis = _make_views(frames, keyframes, views_of, progress, parallel, config)

    def view_of(image: Image) -> Float32s:
        return unit(frames.describe([image])[0] @ basis)

    likelihood, correlation = likelihood_of_views(frames, keyframes, views, view_of, length, config)
    grey = np.full_like(frames.images[0], 128)
    height, width = images[0].shape[:2]
    visual_map = VisualMap(
        poses=frames.poses,
        drives=frames.drives,
        keyframes=keyframes,
        basis=basis,
        views=views,
        blank=view_of(grey),
        correlation_length=length,
        correlation_rad=correlation_turn(frames, camera, unrelated),
        log_ratio=likelihood.log_ratio,
        gamma=likelihood.gamma,
        next_correlation=correlation,
        movements=frames.movements,
        tick_s=tick_s,
        odometry=frames.odometry,
        taught_scene=scene,
        goals=tuple(drive.goal for drive in taught),
        names=tuple(drive.names for drive in drives),
        size=(width, height),
        config=config,
    )
    boxes = [drive.box for drive in taught]
    visual_map = stitched(visual_map)
    appearances, labels, ground = _seen(images, visual_map, boxes, features)
    return Model(centering, visual_map, appearances, labels, ground)


def _drives_to_map(
    demonstrations: Sequence[Demonstration],
    features: FeatureSettings,
    tick_s: float,
    report: Report,
) -> list[Drive]:
    """Return the drives that are fit for the map, and report the others; errors are as in `learn`."""
    if not isinstance(features, FeatureSettings):
        raise TypeError(f"the features must be smal.FeatureSettings, got {features!r:.40}")
    check_features(demonstrations, features.size)
    if features.needs != {"color"}:
        raise ValueError(
            "views from where nobody drove have no depth: a map is of color images alone"
        )
    if not (math.isfinite(tick_s) and tick_s > 0.0):
        raise ValueError(f"tick_s must be finite and positive, got {tick_s}")
    drives = whole_drives(demonstrations)
    unfit = [drive for drive in drives if drive.unfit]
    for drive in unfit:
        report(DriveUse(drive.name, drive.frames, 0, drive.unfit))
    if len(unfit) == len(drives):
        reasons = ", ".join(f"{drive.name}: {drive.unfit}" for drive in unfit[:3])
        raise ValueError(f"no drive reached the goal and has images ({reasons})")
    return [drive for drive in drives if not drive.unfit]


def _moving(frames: TaughtFrames, drives: Sequence[Drive], least: float, report: Report) -> Indices:
    """Return the numbers of the drives in which the robot moves by `least`, and report the others."""
    moving = []
    for number, drive in enumerate(drives):
        extent = float(np.hypot(*np.ptp(frames.poses[frames.drives == number, :2], axis=0)))
        if extent < least:
            moved = f"the robot hardly moves: by {extent:.2g} of at least {least:.2g} {frames.unit}"
            report(DriveUse(drive.name, drive.frames, 0, moved))
        else:
            moving.append(number)
    if not moving:
        raise ValueError(
            f"the robot hardly moves in {frames.listed}: by less than {least:.2g} {frames.unit}, "
            "within which views are alike; record a longer drive"
        )
    return np.array(moving)


def _note(drive: Drive, frames: TaughtFrames, tick_s: float) -> str:
    """Return how the gaps of a drive were bridged, and which of its data are unused."""
    notes = []
    if drive.gaps:
        lost_s = tick_s * sum(drive.gaps.values())
        gaps = f"{len(drive.gaps)} gap{'s' * (len(drive.gaps) > 1)} ({lost_s:.1f} s)"
        notes.append(f"{gaps} bridged by {'odometry' if frames.odometry else 'views'}")
    if drive.whole.odometry is not None and not frames.odometry:
        notes.append("odometry unused, because another drive has none")
    if drive.whole.camera not in (None, frames.camera):
        notes.append("camera unused, because the first drive has another")
    return "; ".join(notes)


def fit(
    drives: Sequence[tuple[Any, ...]],
    features: FeatureSettings | None = None,
    goals: Sequence[str] | None = None,
    camera: Camera | None = None,
    tick_s: float = 0.1,
    progress: Progress = lambda _stage, _done, _total: None,
    parallel: Parallel = in_parallel,
) -> Model:
    """Learn a model from images and the movements at each of them.

    Parameters
    ----------
    drives : sequence of tuple
        (images, atoms) or (images, atoms, odometry) of drives that reached the goal: images (height, width, 3) uint8
        RGB, an `Atom` for each, and the odometry pose of each (x, y, heading in radians).
    features : FeatureSettings, optional
    goals : sequence of str, optional
        Goal of each drive; by default the same for all.
    camera : Camera, optional
        By default estimated from the images.
    tick_s : float
        Time between two images, seconds.
    progress : callable
        Called with the stage ("frames", "views" of keyframes), the finished number, and the total.
    parallel : callable
        `map` of an executor (`concurrent.futures`), for more cores or machines.

    Raises
    ------
    ValueError
        If a drive is invalid; the error names the drive, the frame and the remedy. As in `learn`.

    Examples
    --------
    >>> model = smal.fit([(images, atoms)])  # doctest: +SKIP
    >>> robot = smal.Robot(model)  # doctest: +SKIP
    >>> linear, angular = robot.step(image)  # doctest: +SKIP
    """
    features = FeatureSettings() if features is None else features
    demonstrations = demonstrations_of(drives, features, goals, camera)
    return learn(demonstrations, features, tick_s, progress, parallel)


class _Kept:
    """The raw features of frames, of which those that calibration compares are kept in memory."""

    def __init__(self, features: Sequence[Float32s], frames: Sequence[int]) -> None:
        self._features = features
        starts = np.cumsum([0, *frames[:-1]])
        compared = [compared_frames(count, CALIBRATION_CONFIG.most_frames) for count in frames]
        wanted = [start + some for start, some in zip(starts, compared, strict=True)]
        self._wanted = set(np.concatenate(wanted).tolist())
        self._rows: dict[int, Float32s] = {}
        self._next = 0

    def keep(self, row: Float32s) -> Float32s:
        """Take the row of the next frame, and return it as an array (1, m)."""
        if self._next in self._wanted:
            self._rows[self._next] = row
        self._next += 1
        return row[None]

    def __getitem__(self, frame: int) -> Float32s:
        """Return the row of a frame; a row that is not kept is computed again."""
        row = self._rows.get(frame)
        return self._features[frame] if row is None else row


def _described(centering: Centering, views: Iterable[Image]) -> Float32s:
    described = [extract(view, centering.settings) for view in views]
    return centering.apply(np.stack(described))


def _centred(centering: Centering, features: "_Kept", some: Iterable[int]) -> Float32s:
    rows = [features[frame] for frame in some]
    return centering.apply(np.stack(rows))


def _frames(
    drives: Sequence[Drive],
    features: "_Kept",
    centering: Centering,
    tick_s: float,
    config: MapConfig,
) -> TaughtFrames:
    """Concatenate drives, with poses by odometry or by the usual movements of atoms."""
    taught = [drive.whole for drive in drives]
    images = chained(list(_known(drive.images for drive in taught)))
    images = seen_by(images, centering.settings)
    pixels = centering.settings.pixels
    cameras = list(_known(drive.camera for drive in taught))
    camera = cameras[0] if cameras else None
    atoms = [drive.atoms for drive in taught]

    centred = partial(_centred, centering, features)
    describe = partial(_described, centering)
    poses = _known(drive.odometry for drive in taught)
    ways = [np.asarray(way, dtype=np.float64) for way in poses]
    odometry = len(ways) == len(taught)
    if odometry:
        movements = atom_movements(ways, atoms)
    else:
        tried = tuple(cameras[:1]) or USUAL_CAMERAS
        usual = tried[0], math.radians(config.usual_turn_deg_s) * tick_s
        turning = [_without_gaps(drive) for drive in drives]
        camera, turn_rad = turn_of_views(images, turning, tried, describe, pixels=pixels) or usual
        movements = _usual_movements(taught, turn_rad)
        ways = _reckoned(drives, movements, centred)
    numbers = np.arange(len(ways), dtype=np.int32)
    return TaughtFrames(
        images,
        centred,
        np.concatenate(ways),
        np.repeat(numbers, [drive.frames for drive in drives]),
        describe,
        movements,
        tuple(drive.name for drive in drives),
        odometry,
        camera,
        pixels=pixels,
    )


def _usual_movements(taught: Sequence[Demonstration], turn_rad: float) -> Floats:
    """Return the movement of each atom, (5, 2), in the length of a forward atom."""
    ahead = _ahead_in_turns(taught)
    return np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [ahead, turn_rad], [ahead, -turn_rad]])


def _without_gaps(drive: Drive) -> Int8s:
    """Return the atoms of a drive, with a stop where frames were lost."""
    atoms = drive.whole.atoms.copy()
    atoms[list(drive.gaps)] = Atom.STOP
    return atoms


def _reckoned(
    drives: Sequence[Drive], movements: Floats, centred: Callable[[Iterable[int]], Float32s]
) -> list[Floats]:
    """Return the poses of each drive by the usual movements of atoms."""

    def centred_from(first: int, frames: Iterable[int]) -> Float32s:
        return centred(first + frame for frame in frames)

    starts = np.cumsum([0, *(drive.frames for drive in drives[:-1])]).tolist()
    return [
        reckoned(drive.whole.atoms, movements, drive.gaps, partial(centred_from, start))
        for drive, start in zip(drives, starts, strict=True)
    ]


def _known(values: Iterable[T | None]) -> Iterator[T]:
    return (value for value in values if value is not None)


def _ahead_in_turns(taught: Sequence[Demonstration]) -> float:
    """Return the usual speed ahead in turns, as a share of the speed straight on.

    Without information it is 0, or 1 if only turns move the robot.
    """
    speeds = []
    for drive in taught:
        if drive.ahead is not None:
            turns = (drive.atoms == Atom.LEFT) | (drive.atoms == Atom.RIGHT)
            speeds.append(drive.ahead[turns])
    if any(map(len, speeds)):
        return float(np.median(np.concatenate(speeds)))
    forward = any((drive.atoms == Atom.FORWARD).any() for drive in taught)
    return 0.0 if forward else 1.0


def _seen(
    images: Sequence[Image],
    mapped: VisualMap,
    boxes: Sequence[Box | None],
    features: FeatureSettings,
) -> tuple[dict[str, TargetAppearance], dict[str, TargetLabel], Ground]:
    """Learn the target of each goal, its detections, and the ground.

    A goal has a target if something stands out there, or is drawn in the last view.
    """
    keys = mapped.keyframes
    _, ends = mapped.key_range

    def inspect(frame: int) -> tuple[Image, list[Detection]]:
        image = images[frame]
        return small(looked_at(image, features)), detect(image, features)

    pictures, detected = zip(*in_parallel(inspect, keys.tolist()), strict=True)
    left_s = (mapped.arc[keys[ends]] - mapped.arc[keys]) / max(mapped.speed, 1e-9)
    drives = [np.flatnonzero(mapped.key_drives == drive) for drive in range(len(mapped.goals))]
    appearances = {}
    labels = {}
    for goal in sorted(set(mapped.goals)):
        taught = [
            Taught(
                [pictures[k] for k in of_drive],
                left_s[of_drive],
                mapped.goals[drive] == goal,
                boxes[drive],
                [detected[k] for k in of_drive],
            )
            for drive, of_drive in enumerate(drives)
        ]
        if (appearance := learn_appearance(taught)) is not None:
            appearances[goal] = appearance
        if (label := learn_label(taught)) is not None:
            labels[goal] = label
    return appearances, labels, _ground(pictures, mapped)


def _ground(pictures: Sequence[Image], mapped: VisualMap) -> Ground:
    """Learn the ground, and the threshold of unexpected ground: each keyframe is compared with its neighbours."""
    colours = np.stack([colours_of(picture) for picture in pictures])

    def furthest(key: int) -> float:
        others = np.setdiff1d(beside(mapped, key, GROUND_CONFIG.keyframes), key)
        way = way_from(mapped, key, np.zeros(3), swept(mapped.speed))
        _, score = patches(pictures[key], colours[others], way, mapped)
        return float(score.max(initial=0.0))

    # A drive of one keyframe has no neighbours.
    first, last = mapped.key_range
    scores = list(in_parallel(furthest, np.flatnonzero(first != last).tolist()))
    return Ground(colours, max(extreme(scores), GROUND_CONFIG.least))


def _choose_keyframes(poses: Floats, drives: Int32s, length: float, config: MapConfig) -> Int32s:
    """Return the first and last frame of each drive, and all frames that are far or turned from the one before."""
    ends = np.diff(drives, prepend=-1, append=-1) != 0
    chosen: list[int] = []
    for frame in np.flatnonzero(without_detours(poses, drives, length, config)):
        is_end = ends[frame] or ends[frame + 1]
        if is_end or not shows_same(poses[frame, None], poses[chosen[-1]], length, config)[0]:
            chosen.append(int(frame))
    return np.array(chosen, dtype=np.int32)


def virtual_poses(aside: float) -> list[tuple[float, float, float]]:
    """Return the poses of virtual views relative to their keyframe: ahead, left, turned left in radians."""
    return [(0.0, left, math.radians(turn)) for left in (-aside, 0.0, aside) for turn in TURNS_DEG]


@lru_cache(maxsize=2)  # Drives may be of cameras of different sizes.
def _maps_of(
    scene: Scene, aside: float, shape: tuple[int, ...], pixels: tuple[int, int]
) -> list[Maps]:
    view = fitted(shape, pixels)
    return [scene.maps(shape, pose, view) for pose in virtual_poses(aside)]


def _views_of(scene: Scene, aside: float, centering: Centering, image: Task) -> Float32s:
    frame = image()
    maps = _maps_of(scene, aside, frame.shape[:2], centering.settings.pixels)
    return _described(centering, (remapped(frame, of_pose) for of_pose in maps))


def _in_components(basis: Float32s, rows_of: Callable[[Any], Float32s], source: object) -> Int8s:
    return packed(rows_of(source) @ basis)


def _told(
    progress: Progress, stage: str, items: Iterable[T], total: int, done: int = 0
) -> Iterator[T]:
    """Yield items, and report the progress."""
    for number, item in enumerate(items, done + 1):
        progress(stage, number, total)
        yield item


def _make_views(
    frames: TaughtFrames,
    keyframes: Int32s,
    views_of: Callable[[Task], Float32s],
    progress: Progress,
    parallel: Parallel,
    config: MapConfig,
) -> tuple[Int8s, Float32s]:
    """Compute the virtual views of keyframes, and the components of the views."""
    # All views at once take gigabytes for a long drive: components come first, from a sample of keyframes.
    each = len(virtual_poses(0.0))
    count = max(1, config.sampled_views // each)
    sample = keyframes[evenly(keyframes.size, count)].tolist()
    first = parallel(views_of, tasks_of(frames.images, sample))
    computed = dict(zip(sample, _told(progress, "views", first, keyframes.size), strict=True))
    basis = _components(np.concatenate(list(computed.values())), config)
    others = [frame for frame in keyframes.tolist() if frame not in computed]
    further = parallel(partial(_in_components, basis, views_of), tasks_of(frames.images, others))
    further = _told(progress, "views", further, keyframes.size, len(computed))
    shape = (keyframes.size, each // TURNS_DEG.size, TURNS_DEG.size, basis.shape[1])
    views = np.empty(shape, dtype=np.int8)
    for key, frame in enumerate(keyframes.tolist()):
        row = _in_components(basis, computed.pop, frame) if frame in computed else next(further)
        views[key] = row.reshape(views.shape[1:])
    return views, basis


def _components(sample: Float32s, config: MapConfig) -> Float32s:
    """Return the leading principal components (m, r) of rows (s, m), with large variances reduced."""
    products = sample @ sample.T
    # All components take three times as long.
    last = len(sample) - 1
    first = max(0, len(sample) - config.most_components)
    values, vectors = eigh(products, subset_by_index=[first, last])
    kept = values > 1e-6 * values[-1]
    values = values[kept][::-1]
    vectors = vectors[:, kept][:, ::-1]
    # The columns of sample.T @ vectors have the square root of their value as length.
    scaled = sample.T @ vectors / values ** (0.5 + config.whitened)
    return np.asarray(scaled, dtype=np.float32)
