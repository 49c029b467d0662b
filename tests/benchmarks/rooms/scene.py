"""The scene: four rooms around a courtyard, with textures from random numbers, a robot and its ways.

Lengths are metres. The scene depends on no file and is the same in every process.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from services.simulator.sensors.camera import FIELD_OF_VIEW_DEG

WIDTH_M: Final = 18.0
DEPTH_M: Final = 12.0
_WALL_M: Final = 2.6  # Height of the walls.
_THICK_M: Final = 0.14
_PIECE_M: Final = 3.0  # Longest piece of a wall with one picture.
_PIXELS: Final = 64  # Pixels of a texture a metre: a pixel of the camera at 3 m shows 1.4 cm.
RADIUS_M: Final = 0.22  # Radius of the robot.
TRACK_M: Final = 0.36  # Distance of its wheels.
FIELD_DEG: Final = FIELD_OF_VIEW_DEG  # Horizontal field of view, as drivers assume.
#: Walls by their ends; the doors between the pieces are 1.4 m wide.
_WALLS: Final = (
    (0.0, 0.0, 18.0, 0.0), (18.0, 0.0, 18.0, 12.0), (18.0, 12.0, 0.0, 12.0), (0.0, 12.0, 0.0, 0.0),
    (6.0, 0.0, 6.0, 2.3), (6.0, 3.7, 6.0, 8.3), (6.0, 9.7, 6.0, 12.0),
    (12.0, 0.0, 12.0, 1.8), (12.0, 3.2, 12.0, 8.0), (12.0, 9.4, 12.0, 12.0),
    (0.0, 6.0, 2.3, 6.0), (3.7, 6.0, 6.0, 6.0), (12.0, 5.0, 18.0, 5.0),
)  # fmt: skip
#: Boxes: centre, half lengths and height.
_BOXES: Final = (
    (0.5, 3.6, 0.35, 0.9, 1.9), (4.6, 0.5, 0.8, 0.35, 0.8), (4.9, 5.3, 0.5, 0.4, 1.2),
    (0.6, 7.4, 0.4, 0.8, 1.0), (3.4, 11.5, 1.2, 0.35, 2.0), (5.4, 6.6, 0.35, 0.35, 1.5),
    (6.6, 6.2, 0.3, 0.8, 0.5), (11.4, 5.6, 0.3, 0.9, 0.5), (9.0, 11.5, 1.4, 0.3, 1.1), (9.2, 0.5, 1.0, 0.3, 1.3),
    (14.0, 0.5, 0.9, 0.3, 1.9), (17.5, 1.2, 0.3, 0.7, 1.0), (13.6, 4.5, 0.6, 0.3, 0.9),
    (17.4, 9.2, 0.4, 0.5, 1.6), (14.4, 11.5, 1.0, 0.35, 1.4), (13.2, 5.5, 0.7, 0.3, 2.0),
)  # fmt: skip
#: Columns, trees and the fountain: centre, radius and height.
_CYLINDERS: Final = (
    (9.0, 6.0, 0.9, 0.6), (9.0, 6.0, 0.2, 1.5), (7.3, 11.0, 0.18, 2.4), (10.9, 11.0, 0.15, 2.2),
    (7.2, 1.0, 0.16, 2.6), (11.2, 0.9, 0.2, 2.3), (2.9, 3.4, 0.16, 2.4), (12.8, 11.3, 0.18, 2.4),
)  # fmt: skip
_CROWNS: Final = ((7.3, 11.0, 0.8), (10.9, 11.0, 0.7), (7.2, 1.0, 0.7), (11.2, 0.9, 0.65))
Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class RoomsWay:
    """A way to teach: way points from the start to the target, and the target's colours."""

    points: tuple[tuple[float, float], ...]
    colours: tuple[Rgb, Rgb]


#: Ways by name; the last point is the target.
WAYS: Final = {
    "workshop": RoomsWay(
        ((1.4, 1.4), (4.6, 3.0), (6.0, 3.0), (7.4, 3.2), (10.6, 3.1), (12.0, 2.5), (14.2, 2.5), (16.4, 3.6)),
        ((225, 40, 35), (250, 230, 60)),
    ),
    "library": RoomsWay(
        (
            (16.6, 10.8), (15.2, 9.6), (13.2, 8.7), (12.0, 8.7), (9.4, 8.4), (7.2, 9.0), (6.0, 9.0), (4.2, 8.8),
            (3.0, 7.6), (3.0, 6.0), (2.2, 4.6), (1.8, 2.6), (2.4, 1.2),
        ),
        ((35, 90, 230), (240, 240, 240)),
    ),
    "garden": RoomsWay(
        (
            (1.5, 9.4), (4.4, 9.0), (6.0, 9.0), (7.2, 8.4), (7.5, 6.2), (7.6, 4.2), (9.0, 3.4), (10.4, 4.2),
            (10.6, 6.0), (10.8, 8.0), (12.0, 8.7), (13.6, 8.9), (16.0, 7.2),
        ),
        ((240, 130, 20), (30, 160, 70)),
    ),
}  # fmt: skip


def clearance_m(x: float, y: float) -> float:
    """Return the distance of a point from the nearest wall or object."""
    return min(_distances_m(x, y))


def _distances_m(x: float, y: float) -> Iterator[float]:
    point = np.array([x, y])
    for x0, y0, x1, y1 in _WALLS:
        start = np.array([x0, y0])
        along = np.array([x1, y1]) - start
        nearest = start + np.clip((point - start) @ along / (along @ along), 0.0, 1.0) * along
        yield float(np.hypot(*(point - nearest))) - _THICK_M / 2
    for x0, y0, half_x, half_y, _ in _BOXES:
        yield float(np.hypot(max(abs(x - x0) - half_x, 0.0), max(abs(y - y0) - half_y, 0.0)))
    for x0, y0, radius, _ in _CYLINDERS:
        yield float(np.hypot(x - x0, y - y0)) - radius


def _noise(rng: np.random.Generator, rows: int, columns: int) -> NDArray[np.float32]:
    """Return smooth random numbers of about -1 to 1, (rows, columns), of several sizes."""
    total = np.zeros((rows, columns), dtype=np.float32)
    for cell in (64, 24, 8, 3):
        size = (max(columns // cell, 2), max(rows // cell, 2))
        coarse = rng.uniform(-1, 1, size[::-1]).astype(np.float32)
        total += cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC) * 0.4
    return total


def _shaded(
    colour: NDArray[np.float64], noise: NDArray[np.float32], depth: float
) -> NDArray[np.float32]:
    return (colour * (1.0 + depth * noise[..., None])).astype(np.float32)


def _colour(rng: np.random.Generator, strong: float) -> NDArray[np.float64]:
    """Return a colour of a brightness; `strong` is its saturation, 0 to 1."""
    grey = rng.uniform(120, 210)
    return np.clip(grey + strong * rng.uniform(-110, 110, 3), 25, 240)


def _wall_picture(rng: np.random.Generator, length_m: float, height_m: float) -> NDArray[np.uint8]:
    """Draw plaster, bricks or planks with a skirting, windows and posters, (rows, columns, 3)."""
    rows = round(height_m * _PIXELS)
    columns = max(round(length_m * _PIXELS), 8)
    image = _shaded(_colour(rng, 0.35), _noise(rng, rows, columns), 0.18)
    _draw_joints(image, rng, rng.choice(["plaster", "bricks", "planks"]))
    for _ in range(round(length_m * rng.uniform(0.5, 1.4))):
        _draw_poster(image, rng)
    image[-round(0.25 * _PIXELS) :] *= rng.uniform(0.35, 0.7)
    return np.clip(image, 0, 255).astype(np.uint8)


def _draw_joints(image: NDArray[np.float32], rng: np.random.Generator, kind: str) -> None:
    rows, columns, _ = image.shape
    if kind == "bricks":
        for course, top in enumerate(range(0, rows, 16)):
            image[top : top + 2] *= 0.62
            image[top : top + 16, 20 * (course % 2) :: 40] *= 0.62
            for left in range(20 * (course % 2), columns, 40):
                image[top : top + 16, left : left + 40] *= rng.uniform(0.82, 1.15)
    elif kind == "planks":
        for left in range(0, columns, 14):
            image[:, left : left + 14] *= rng.uniform(0.78, 1.18)
            image[:, left] *= 0.6


def _draw_poster(image: NDArray[np.float32], rng: np.random.Generator) -> None:
    rows, columns, _ = image.shape
    wide = min(int(rng.integers(24, 72)), columns - 2)
    high = int(rng.integers(24, 80))
    left = int(rng.integers(0, columns - wide))
    top = int(rng.integers(8, rows - high - 24))
    poster = _shaded(_colour(rng, 1.0), _noise(rng, high, wide), 0.25)
    for _ in range(4):
        end = rng.integers(0, [wide, high]).tolist()
        start = rng.integers(0, [wide, high]).tolist()
        cv2.rectangle(poster, start, end, _colour(rng, 1.0).tolist(), -1)
    poster[:3] = poster[-3:] = rng.uniform(20, 235)
    poster[:, :3] = poster[:, -3:] = poster[0, 0]
    image[top : top + high, left : left + wide] = poster


def _floor_picture(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw the floors of the rooms and of the courtyard, seen from above with north at the top."""
    pixels = 48
    rows = round(DEPTH_M * pixels)
    columns = round(WIDTH_M * pixels)
    image = np.zeros((rows, columns, 3), dtype=np.float32)
    for x0, y0, x1, y1, tile in (
        (0, 0, 6, 6, 24), (0, 6, 6, 12, 12), (6, 0, 12, 12, 40), (12, 0, 18, 5, 20), (12, 5, 18, 12, 32),
    ):  # fmt: skip
        part = image[rows - y1 * pixels : rows - y0 * pixels, x0 * pixels : x1 * pixels]
        part[:] = _shaded(_colour(rng, 0.3) * 0.8, _noise(rng, *part.shape[:2]), 0.25)
        for top in range(0, part.shape[0], tile):
            part[top] *= 0.7
            for left in range(0, part.shape[1], tile):
                part[top : top + tile, left : left + tile] *= rng.uniform(0.88, 1.1)
        part[:, ::tile] *= 0.7
    return np.clip(image, 0, 255).astype(np.uint8)


def _object_picture(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw boards of two colours, (96, 96, 3)."""
    image = _shaded(_colour(rng, 0.8), _noise(rng, 96, 96), 0.25)
    step = int(rng.integers(12, 40))
    image[::step] *= 0.5
    image[:, :: int(rng.integers(16, 60))] *= 0.6
    band = int(rng.integers(0, 64))
    image[band : band + 16] = 0.5 * image[band : band + 16] + 0.5 * _colour(rng, 1.0)
    return np.clip(image, 0, 255).astype(np.uint8)


def _target_picture(rng: np.random.Generator, colours: tuple[Rgb, Rgb]) -> NDArray[np.uint8]:
    """Draw checks of two colours, (64, 64, 3)."""
    rows, columns = np.indices((64, 64)) // 16
    image = np.array(colours, dtype=np.float32)[(rows + columns) % 2]
    return np.clip(image * (1.0 + 0.1 * _noise(rng, 64, 64)[..., None]), 0, 255).astype(np.uint8)


class _Builder:
    """Collects textures, materials and geometries of the model."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.assets: list[str] = []
        self.geoms: list[str] = []

    def material(self, picture: NDArray[np.uint8], kind: str = "2d") -> str:
        """Add a picture (RGB), and return the name of its material."""
        name = f"m{len(self.files)}"
        done, png = cv2.imencode(".png", picture[..., ::-1])
        assert done
        self.files[f"{name}.png"] = png.tobytes()
        self.assets.append(
            f'<texture name="{name}" type="{kind}" file="{name}.png"/>'
            f'<material name="{name}" texture="{name}" specular="0.05" shininess="0.1"/>'
        )
        return name

    def geom(self, **attributes: object) -> None:
        """Add a geometry."""
        text = " ".join(f'{name}="{_text(value)}"' for name, value in attributes.items())
        self.geoms.append(f"<geom {text}/>")

    def slab(
        self, rng: np.random.Generator, start: NDArray[np.float64], end: NDArray[np.float64]
    ) -> None:
        """Add the right face of a wall.

        MuJoCo projects a plain texture along the local z axis, so the slab lies in its local x-y
        plane: x along the wall, y up, z to the right of its direction.
        """
        length_m = float(np.hypot(*(end - start)))
        ahead = (end - start) / length_m
        right = np.array([ahead[1], -ahead[0]])
        middle = (start + end) / 2 + right * _THICK_M / 4
        self.geom(
            type="box", pos=(*middle, _WALL_M / 2), xyaxes=(*ahead, 0, 0, 0, 1),
            size=(length_m / 2, _WALL_M / 2, _THICK_M / 4),
            material=self.material(_wall_picture(rng, length_m, _WALL_M)),
        )  # fmt: skip


def _text(value: object) -> str:
    return " ".join(f"{one:.5g}" for one in value) if isinstance(value, tuple) else str(value)


def scene_of(way: str, size: tuple[int, int]) -> tuple[str, dict[str, bytes]]:
    """Return the model (MJCF) and its files, with the target of a way, for images of a size.

    Parameters
    ----------
    way : str
        A name of `WAYS`.
    size : (int, int)
        Width and height of the images, pixels.
    """
    rng = np.random.default_rng(2026)
    made = _Builder()
    made.geom(
        name="floor", type="plane", pos=(WIDTH_M / 2, DEPTH_M / 2, 0), size=(WIDTH_M / 2, DEPTH_M / 2, 0.1),
        material=made.material(_floor_picture(rng)),
    )  # fmt: skip
    for x0, y0, x1, y1 in _WALLS:
        ends = np.array([[x0, y0], [x1, y1]])
        for start, end in (ends, ends[::-1]):
            pieces = max(round(float(np.hypot(*(end - start))) / _PIECE_M), 1)
            corners = np.linspace(start, end, pieces + 1)
            for one, other in itertools.pairwise(corners):
                made.slab(rng, one, other)
    for x, y, half_x, half_y, height in _BOXES:
        made.geom(
            type="box", pos=(x, y, height / 2), size=(half_x, half_y, height / 2),
            material=made.material(_object_picture(rng), "cube"),
        )  # fmt: skip
    for x, y, radius, height in _CYLINDERS:
        made.geom(
            type="cylinder", pos=(x, y, height / 2), size=(radius, height / 2),
            material=made.material(_object_picture(rng), "cube"),
        )  # fmt: skip
    leaves = made.material(_shaded_leaves(rng), "cube")
    for x, y, radius in _CROWNS:
        made.geom(type="ellipsoid", pos=(x, y, 2.7), size=(radius, radius, 0.6), material=leaves)
    x, y = WAYS[way].points[-1]
    made.geom(
        type="cylinder", pos=(x, y, 0.3), size=(0.14, 0.3),
        material=made.material(_target_picture(rng, WAYS[way].colours), "cube"),
    )  # fmt: skip
    return _MODEL.format(
        assets="".join(made.assets), geoms="".join(made.geoms), width=size[0], height=size[1],
        robot=_robot(size),
    ), made.files  # fmt: skip


def _shaded_leaves(rng: np.random.Generator) -> NDArray[np.uint8]:
    return np.clip(_shaded(np.array([60.0, 125.0, 45.0]), _noise(rng, 96, 96), 0.6), 0, 255).astype(
        np.uint8
    )


def _robot(size: tuple[int, int]) -> str:
    field = 2 * np.degrees(np.arctan(np.tan(np.radians(FIELD_DEG / 2)) * size[1] / size[0]))
    return f"""
    <body name="robot" pos="0 0 0.1">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>
      <geom name="chassis" type="cylinder" size="{RADIUS_M} 0.08" mass="6" rgba=".2 .2 .2 1"/>
      <camera name="camera" pos="0.12 0 0.38" xyaxes="0 -1 0 0 0 1" fovy="{field:.4f}"/>
    </body>"""


_MODEL: Final = """<mujoco>
  <visual>
    <global offwidth="{width}" offheight="{height}"/>
    <quality shadowsize="0" offsamples="0"/>
    <headlight ambient="0.42 0.42 0.42" diffuse="0.12 0.12 0.12" specular="0 0 0"/>
    <map znear="0.002" zfar="4"/>
  </visual>
  <statistic extent="14" center="9 6 0"/>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1=".45 .62 .85" rgb2=".85 .88 .9" width="256" height="1536"/>
    {assets}
  </asset>
  <worldbody>
    <light type="directional" pos="9 6 12" dir="0.45 0.3 -1" diffuse="0.55 0.53 0.48"/>
    <light pos="3 3 2.5" diffuse="0.25 0.22 0.18" attenuation="1 0 0.05"/>
    <light pos="15 8 2.5" diffuse="0.18 0.22 0.25" attenuation="1 0 0.05"/>
    {geoms}
    {robot}
  </worldbody>
</mujoco>"""
