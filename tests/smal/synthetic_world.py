"""A room with painted walls and floor, and a camera that drives through it: images without a simulator."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, cached_property
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from smal.camera import Camera, Scene
from smal.features import Centering, FeatureSettings, extract
from smal.filter import Filter
from smal.keyframes import MapConfig
from smal.map import VisualMap
from smal.movement import STILL, Atom, Movement
from smal.planning import Planner
from smal.teaching.demonstration import Demonstration
from smal.teaching.mapping import learn

COLOR = FeatureSettings(("color",))  # What describes frames: HOG as well takes ten times as long.
FIELD_DEG = 75.0
CAMERA_HEIGHT = 0.35
SPEED = 0.5
TURN_RAD_S = math.radians(45.0)
TICK = 0.1  # Between two frames, seconds.
ROWS = 72
COLUMNS = 96
WAY = (
    (2.5, 90.0),
    (2.0, -90.0),
    (2.0, 0.0),
)  # A way through the room: metres ahead and degrees to the left, by turns.
START = (2.5, 4.0, 0.0)

CAMERA = Camera.of_field(
    FIELD_DEG
)  # What a fit should find, but for the distance, which no room has one of.
SCENE = Scene(CAMERA, CAMERA_HEIGHT, 6.0)

Image = NDArray[np.uint8]
Pose = NDArray[np.float64]


@cache
def paint(seed: int, part: int, rows: int, columns: int, texels: int) -> Image:
    """Make a texture of coloured spots, the largest of so many texels, that joins itself at its borders."""
    rng = np.random.default_rng([seed, part])
    picture = np.zeros((rows, columns, 3))
    for size, strength in ((texels, 1.0), (texels // 2, 0.7), (texels // 4, 0.4)):
        spots = rng.uniform(-1.0, 1.0, (rows // size, columns // size, 3))
        spots = np.pad(spots, ((1, 1), (1, 1), (0, 0)), mode="wrap")
        large = cv2.resize(spots, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)
        picture += strength * large[size : size + rows, size : size + columns]
    return np.clip(128.0 + 110.0 * picture, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Room:
    """A square room about (6, 6) with walls that have no top.

    Parameters
    ----------
    seed : int
        Seed of its paint.
    half : float
        Half of its side, metres.
    """

    seed: int = 0
    half: float = 6.0

    @cached_property
    def _floor(self) -> Image:
        return paint(self.seed, 0, 512, 512, 16)

    @cached_property
    def _walls(self) -> Image:
        return paint(self.seed, 1, 256, 2048, 64)

    def look(
        self,
        pose: Sequence[float] | Pose,
        rows: int = ROWS,
        columns: int = COLUMNS,
        camera: Camera = CAMERA,
    ) -> Image:
        """Render what a camera at x, y, heading sees: 20 texels a metre on the floor, 40 on the walls."""
        x, y, heading = pose
        down, right, ahead = _rays(camera, rows, columns)
        ray_x = math.cos(heading) * ahead + math.sin(heading) * right
        ray_y = math.sin(heading) * ahead - math.cos(heading) * right
        with np.errstate(divide="ignore"):
            to_floor = np.where(down > 0.0, CAMERA_HEIGHT / down, np.inf)
            to_x = (self.half - np.sign(ray_x) * (x - 6.0)) / np.abs(ray_x)
            to_y = (self.half - np.sign(ray_y) * (y - 6.0)) / np.abs(ray_y)
        reach = np.minimum(np.minimum(to_x, to_y), to_floor)
        at_x = x + reach * ray_x
        at_y = y + reach * ray_y
        height = CAMERA_HEIGHT - reach * down
        side = np.where(to_x < to_y, np.where(ray_x > 0, 0, 2), np.where(ray_y > 0, 1, 3))
        along = np.where(to_x < to_y, at_y, at_x) - 6.0 + self.half
        floor = _sampled(self._floor, at_x * 20.0, at_y * 20.0)
        walls = _sampled(self._walls, side * 512.0 + along * 40.0, height * 40.0)
        return np.where((to_floor <= np.minimum(to_x, to_y))[..., None], floor, walls)


@cache
def _rays(camera: Camera, rows: int, columns: int) -> tuple[NDArray[np.float64], ...]:
    focal = camera.focal * columns
    v, u = np.mgrid[0:rows, 0:columns]
    down = (v - (rows - 1) / 2.0) / focal
    right = (u - (columns - 1) / 2.0) / focal
    out = np.hypot(right, down)
    angle = camera.angle(out)
    return np.sin(angle) * down / out, np.sin(angle) * right / out, np.cos(angle)


def _sampled(texture: Image, u: NDArray[np.float64], v: NDArray[np.float64]) -> Image:
    rows, columns = texture.shape[:2]
    maps = (np.mod(u, columns).astype(np.float32), np.mod(v, rows).astype(np.float32))
    return np.asarray(
        cv2.remap(texture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.uint8
    )


@dataclass(frozen=True)
class Drive:
    """Poses (f, 3), the atoms (f,) made after them, and how many metres its wheels take for one."""

    poses: Pose
    atoms: NDArray[np.int8]
    wheels: float = 1.0

    def movements(self) -> list[Movement]:
        return [
            Movement.between(*pair) for pair in zip(self.poses[:-1], self.poses[1:], strict=True)
        ]


def drive(
    start: Sequence[float] = START,
    way: Sequence[tuple[float, float]] = WAY,
    rate_hz: float = 10.0,
    speed: float = 1.0,
) -> Drive:
    """Drive straight and turn on the spot, in turns, at a frame rate and a multiple of the usual speed."""
    x, y, heading = start
    poses = [(x, y, heading)]
    atoms = []
    for metres, degrees in way:
        steps = round(abs(metres) / SPEED / speed * rate_hz)
        for _ in range(steps):
            x += metres / steps * math.cos(heading)
            y += metres / steps * math.sin(heading)
            poses.append((x, y, heading))
        atoms += [Atom.FORWARD if metres > 0.0 else Atom.BACKWARD] * steps
        turns = round(abs(math.radians(degrees)) / TURN_RAD_S / speed * rate_hz)
        for _ in range(turns):
            heading += math.radians(degrees) / turns
            poses.append((x, y, heading))
        atoms += [Atom.LEFT if degrees > 0.0 else Atom.RIGHT] * turns
    return Drive(np.array(poses), np.array([*atoms, Atom.STOP], dtype=np.int8))


def from_beside(
    pose: Sequence[float], ahead: float, left: float, turn: float
) -> tuple[float, float, float]:
    """Return the pose that lies ahead and to the left of another one, turned left."""
    x, y, heading = pose
    cos = math.cos(heading)
    sin = math.sin(heading)
    return x + cos * ahead - sin * left, y + sin * ahead + cos * left, heading + turn


def driven(
    found: Filter, planner: Planner, room: Room, start: Sequence[float], frames: int
) -> Pose:
    """Drive by the filter and the planner at 10 Hz until they arrive; return the last pose."""
    pose = np.array(start)
    movement = STILL
    for _ in range(frames):
        linear, angular = planner.decide(
            found.observe(extract(room.look(pose), COLOR), movement).summary()
        ).motion
        if planner.said:
            break
        after = np.array(
            from_beside(tuple(pose), linear * SPEED * TICK, 0.0, angular * TURN_RAD_S * TICK)
        )
        movement = Movement.between(pose, after)
        pose = after
    return pose


def taught(
    room: Room,
    *drives: Drive,
    rate_hz: float = 10.0,
    odometry: bool = True,
    settings: FeatureSettings = COLOR,
    scene: Scene | None = None,
    ahead: NDArray[np.float32] | None = None,
) -> tuple[VisualMap, Centering]:
    """Learn the map of drives through a room; a scene that is given is not fitted, which takes most of the time.

    A car's drives say how fast it goes ahead in turning.
    """
    images = [[room.look(pose) for pose in one.poses] for one in drives]
    raw = [np.stack([extract(image, settings) for image in each]) for each in images]
    with ExitStack() as changed:
        if scene is not None:
            changed.enter_context(
                patch("smal.teaching.mapping.fit_camera", lambda *_: scene.camera)
            )
            changed.enter_context(patch("smal.teaching.mapping.fit_scene", lambda *_: scene))
        found = learn(
            [
                Demonstration(
                    f"drive-{k}",
                    raw[k],
                    one.atoms,
                    images=images[k],
                    odometry=one.poses * (one.wheels, one.wheels, 1.0) if odometry else None,
                    ahead=ahead,
                )
                for k, one in enumerate(drives)
            ],
            settings,
            1.0 / rate_hz,
            config=MapConfig(sampled_views=500),
        )
    return found.mapped, found.centering


@cache
def usual_map() -> tuple[VisualMap, Centering]:
    """Learn the usual way, once for all tests."""
    return taught(Room(), drive(), scene=SCENE)
