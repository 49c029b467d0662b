"""Draw the moving picture of the README: a drive teaches, then the robot repeats it by camera.

Example: .venv/bin/python deploy/picture.py
"""

from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from schemas.base import TICK_S
from schemas.rpc import ResetRequest
from services.experiments.evaluation.drives import drive, drive_of
from services.experiments.evaluation.search import search
from services.kit.jpeg import decode_jpeg
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.world.map_view import draw_map
from smal.evaluation.drivers import SmalDriver
from smal.features import FeatureSettings
from smal.teaching.mapping import learn

OUT: Final = Path(__file__).parent / "pictures" / "teach-and-repeat.webp"
WORLD: Final = "campus"
SEED: Final = 8  # The robot starts turned away, and passes a crate and a car.
SIZE: Final = (400, 300)  # Camera image, pixels.
CAPTION_PX: Final = 38
GAP_PX: Final = 8
MAP_PX: Final = 112
MAP_M: Final = 8.0  # Margin of the map around the ways, metres.
FRAMES_HZ: Final = 10
DRIVING: Final = 68  # Frames of the drives; the rest of eight seconds shows their end.
FRAMES: Final = 8 * FRAMES_HZ
DARK: Final = "#15181c"
BLUE: Final = "#2f81f7"
ORANGE: Final = "#e8590c"
GREEN: Final = "#2da44e"
_FONTS: Final = Path(mpl.get_data_path()) / "fonts" / "ttf"
_FONT: Final = ImageFont.truetype(_FONTS / "DejaVuSans.ttf", 15)
_BOLD: Final = ImageFont.truetype(_FONTS / "DejaVuSans-Bold.ttf", 15)

Points = NDArray[np.float64]


class Map:
    """A map of the world around two ways, as a picture with known axes."""

    def __init__(self, simulation: Simulation, ways: Points) -> None:
        middle = (ways.min(axis=0) + ways.max(axis=0)) / 2
        half_m = float(np.ptp(ways, axis=0).max()) / 2 + MAP_M
        self._corner = middle + np.array([-half_m, half_m])
        self._px_m = MAP_PX / (2 * half_m)
        figure = Figure((MAP_PX / 100, MAP_PX / 100), dpi=100)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        draw_map(simulation.world, axes, marks=False)
        axes.set_xlim(middle[0] - half_m, middle[0] + half_m)
        axes.set_ylim(middle[1] - half_m, middle[1] + half_m)
        axes.axis("off")
        figure.set_facecolor(axes.get_facecolor())
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        self.ground = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        self._goal = self.place(np.array([[simulation.world.victim.x, simulation.world.victim.y]]))

    def place(self, points: Points) -> list[tuple[float, float]]:
        """Return the pixels of places (n, 2) in metres."""
        return [tuple(one) for one in (points - self._corner) * (self._px_m, -self._px_m)]

    def drawn(self, taught: Points, way: Points, colour: str, boxes: list[Points]) -> Image.Image:
        """Draw the taught way, boxes, and the robot at the end of its way."""
        picture = self.ground.copy()
        pen = ImageDraw.Draw(picture)
        if len(taught):
            pen.line(self.place(taught), fill=BLUE, width=2)
        for box in boxes:
            pen.polygon(self.place(box), fill=ORANGE, outline=ORANGE, width=2)
        pen.line(self.place(way), fill=colour, width=2)
        ((x, y),) = self._goal
        pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill="#d62728", outline="white")
        x, y = self.place(way[-1:])[0]
        pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=colour, outline="white")
        pen.rectangle((0, 0, MAP_PX - 1, MAP_PX - 1), outline="white")
        return picture


def panel(number: str, caption: str, view: NDArray[np.uint8], inset: Image.Image,
          note: str, colour: str) -> Image.Image:  # fmt: skip
    """Draw a camera image below its caption, with the map in a corner and a note."""
    picture = Image.new("RGB", (SIZE[0], SIZE[1] + CAPTION_PX), DARK)
    picture.paste(Image.fromarray(view), (0, CAPTION_PX))
    picture.paste(inset, (SIZE[0] - MAP_PX - 8, CAPTION_PX + 8))
    pen = ImageDraw.Draw(picture)
    pen.ellipse((8, 8, 30, 30), fill=colour)
    pen.text((19, 19), number, fill="white", font=_BOLD, anchor="mm")
    pen.text((38, 19), caption, fill="white", font=_FONT, anchor="lm")
    left, top, right, bottom = pen.textbbox((16, SIZE[1] + CAPTION_PX - 20), note, _BOLD, "lm")
    pen.rounded_rectangle((left - 8, top - 6, right + 8, bottom + 6), 6, fill=colour)
    pen.text((16, SIZE[1] + CAPTION_PX - 20), note, fill="white", font=_BOLD, anchor="lm")
    return picture


def main() -> None:
    """Teach, repeat, and write the picture."""
    camera = CameraSettings(*SIZE)
    held = drive(open_simulation(WORLD, camera), FeatureSettings(), 1)
    taught = held["poses"][:, :2]
    jpegs = np.split(held["jpegs"], held["jpeg_ends"][:-1])
    simulation = open_simulation(WORLD, camera, depth=True)
    request = ResetRequest(
        seed=SEED, purpose="run", start="anywhere", obstacles=2, until_said=True, max_ticks=1500
    )
    driver = SmalDriver(learn([drive_of(held)]))
    run = search(simulation, driver, request, picture_ticks=1)
    repeated = run.poses[:, :2]
    print(f"seed {SEED}: {run.outcome} after {len(repeated) * TICK_S:.0f} s")  # noqa: T201
    boxes = [np.asarray(thing.footprint.exterior.coords) for thing in simulation.obstacles]
    there = Map(simulation, np.concatenate([taught, repeated]))
    pictures = []
    for k in range(FRAMES):
        share = min(k / (DRIVING - 1), 1.0)
        one = round(share * (len(taught) - 1))
        two = min(round(share * (len(repeated) - 1)), max(run.pictures))
        ended = share == 1.0
        left = panel(
            "1", "Drive it there once", decode_jpeg(jpegs[one].tobytes()),
            there.drawn(taught[:0], taught[: one + 1], BLUE, []),
            "Taught" if ended else f"{one * TICK_S:.0f} s", BLUE,
        )  # fmt: skip
        right = panel(
            "2", "It finds the way by camera, round new things", run.pictures[two],
            there.drawn(taught, repeated[: two + 1], GREEN, boxes),
            "Found" if ended else f"{two * TICK_S:.0f} s", GREEN,
        )  # fmt: skip
        picture = Image.new("RGB", (2 * SIZE[0] + GAP_PX, left.height), "white")
        picture.paste(left, (0, 0))
        picture.paste(right, (SIZE[0] + GAP_PX, 0))
        pictures.append(picture)
    pictures[0].save(OUT, save_all=True, append_images=pictures[1:], duration=1000 // FRAMES_HZ,
                     loop=0, quality=60, method=6)  # fmt: skip
    print(f"wrote {OUT} ({OUT.stat().st_size / 1e6:.1f} MB)")  # noqa: T201


if __name__ == "__main__":
    main()
