"""Demonstrations from arrays of images, actions and poses, checked before anything is computed."""

import warnings
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from smal.arrays import Floats, Int8s
from smal.camera import Camera, Image
from smal.features.extraction import check_image
from smal.features.resizing import same_aspect
from smal.features.settings import FeatureSettings
from smal.movement import Atom, in_degrees, is_pose
from smal.teaching.demonstration import USUAL_GOAL, Demonstration, described

#: Quantile of the steps that is the usual step: it includes steps after lost frames.
_USUAL: Final = 0.9
_JUMP: Final = 20.0  # Usual steps that are a jump: two seconds of lost frames at 10 Hz.


def demonstrations_of(
    drives: Sequence[tuple[Any, ...]],
    features: FeatureSettings,
    goals: Sequence[str] | None = None,
    camera: Camera | None = None,
) -> list[Demonstration]:
    """Return drives as demonstrations whose features are computed on access; see `fit`.

    Raises
    ------
    ValueError
        If images, actions, poses or goals are invalid. The error names the drive and the frame.
    """
    count = _count(drives, "drives")
    goals = [USUAL_GOAL] * count if goals is None else goals
    if isinstance(goals, str) or not all(isinstance(goal, str) for goal in goals):
        raise TypeError(f"the goals must be a list of names, got {goals!r:.40}")
    if len(goals) != count:
        raise ValueError(f"{len(goals)} goals for {count} drives; give one goal for each")
    if camera is not None and not isinstance(camera, Camera):
        raise TypeError(
            f"the camera must be a smal.camera.Camera, got {camera!r:.40}; "
            "Camera.of_field(70) has a field of view of 70 degrees"
        )
    pairs = zip(drives, goals, strict=True)
    return [
        _demonstration(f"drive-{number}", drive, features, goal, camera)
        for number, (drive, goal) in enumerate(pairs)
    ]


def _demonstration(
    name: str,
    drive: Any,  # noqa: ANN401 - given by a user
    features: FeatureSettings,
    goal: str,
    camera: Camera | None,
) -> Demonstration:
    if not isinstance(drive, tuple | list) or len(drive) not in (2, 3):
        raise ValueError(
            f"{name} must be (images, atoms) or (images, atoms, odometry), got "
            f"{type(drive).__name__}; a single drive is a list of one: [(images, atoms)]"
        )
    images, atoms, *poses = drive
    _count(images, f"{name}: the images")
    _check_images(name, images)
    executed = _atoms(name, atoms, len(images))
    return Demonstration(
        name,
        described(images, features, name),
        executed,
        images=images,
        odometry=_odometry(name, poses[0], executed) if poses and poses[0] is not None else None,
        goal=goal,
        camera=camera,
    )


def _count(values: Any, what: str) -> int:  # noqa: ANN401 - given by a user
    try:
        return len(values)
    except TypeError:
        raise TypeError(f"{what} must be a list or an array, got {type(values).__name__}") from None


def _check_images(name: str, images: Sequence[Image]) -> None:
    """Check images in memory; of a lazy sequence, only the first image, because each takes time."""
    if not len(images):
        raise ValueError(f"{name} has no images")
    in_memory = isinstance(images, np.ndarray | list | tuple)
    first = images[0]
    for frame, image in enumerate(images if in_memory else [first]):
        try:
            check_image(image)
        except ValueError as error:
            raise ValueError(f"{name}, frame {frame}: {error}") from None
        if not same_aspect(image.shape, first.shape):
            raise ValueError(
                f"{name}, frame {frame}: an image of {image.shape[1]}x{image.shape[0]} shows "
                f"another view than the first, of {first.shape[1]}x{first.shape[0]}; use images of "
                "one camera and one size"
            )


def _atoms(name: str, atoms: Any, frames: int) -> Int8s:  # noqa: ANN401 - given by a user
    count = _count(atoms, f"{name}: the actions")
    if count != frames:
        raise ValueError(
            f"{name}: {frames} images, but {count} actions; give the action after each image, "
            "smal.Atom.STOP after the last"
        )
    for frame, atom in enumerate(atoms):
        if np.ndim(atom) or atom not in list(Atom):
            raise ValueError(
                f"{name}, frame {frame}: the action {atom!r:.40} is invalid; use smal.Atom, "
                f"{', '.join(f'{one.name} = {one.value}' for one in Atom)}"
            )
    return np.asarray(atoms, dtype=np.int8)


def _odometry(name: str, poses: Any, atoms: Int8s) -> Floats:  # noqa: ANN401 - given by a user
    count = _count(poses, f"{name}: the poses")
    if count != atoms.size:
        raise ValueError(
            f"{name}: {atoms.size} images, but {count} poses; give the pose of each image"
        )
    for frame, pose in enumerate(poses):
        if not is_pose(pose):
            raise ValueError(
                f"{name}, frame {frame}: the pose must be three finite numbers, x, y and heading "
                f"in radians, got {pose!r:.60}; leave out frames without a pose"
            )
    odometry = np.asarray(poses, dtype=np.float64)
    if in_degrees(odometry):
        headings = odometry[:, 2]
        raise ValueError(
            f"{name}: the headings, {headings.min():.3g} to {headings.max():.3g}, fit the motion in "
            "degrees; convert them with numpy.radians"
        )
    _check_steps(name, odometry)
    return odometry


def _check_steps(name: str, odometry: Floats) -> None:
    """Warn if the odometry jumps between two poses, as it does after a reset."""
    steps = np.hypot(*np.diff(odometry[:, :2], axis=0).T)
    usual = float(np.quantile(steps[steps > 0.0], _USUAL)) if steps.any() else 0.0
    jumps = np.flatnonzero(steps > _JUMP * usual) + 1
    if usual and jumps.size:
        warnings.warn(
            f"{name}, frame {jumps[0]}: the odometry jumps by {steps[jumps[0] - 1]:.3g} m, usually "
            f"it goes {usual:.3g} m a frame; split the drive there if the odometry was reset",
            stacklevel=2,
        )
