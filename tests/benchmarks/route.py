"""Route: how long learning takes, and a decision on ways of one and ten kilometres, the filter and the planner alone.

The maps are made up: as many keyframes a metre as drives in streets have, each with all its virtual views in 400
components, that change smoothly along the way. A robot follows each by its wheels and by noisy views; features of an
image and transport are apart.

What is learned is a drive round a painted room, 320x240 at 0.4 m/s and 10 Hz, so that about every third frame is a
keyframe, as in streets; in processor time, which other programs change little. More than half of it is the histograms
of gradients of 51 views a keyframe.
"""

import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from smal.camera import STRAIGHT, TURNS_DEG, Camera, Scene
from smal.features import Centering, FeatureSettings
from smal.files.packed import packed, unpacked
from smal.keyframes import MAP_CONFIG
from smal.likelihood import GRID, SHARES
from smal.map import VisualMap
from smal.model import Model
from smal.planning import Planner
from smal.robot import Localizer
from smal.teaching.from_arrays import demonstrations_of
from smal.teaching.mapping import learn
from tests.benchmarks.reporting import Parser, say, table, verdict
from tests.smal.synthetic_world import Room, drive

#: 1.35 keyframes a metre, as in drives through streets; a correlation length is five of them.
SPACING_M = 0.75
FRAME_M = 0.25
LIMIT_MS = 20.0
MOST_TIMES = 2.0
#: Sides of the way round the room; frames of a long drive, and the seconds in which two cores are to learn it.
SIDE_M = 5.0
MANY_FRAMES = 5_000
LIMIT_S = 120.0
CORES = 2
IMAGE: Final = 240, 320
_FEATURES: Final = FeatureSettings()


def map_of(metres: float, components: int) -> Model:
    """Make up a straight way."""
    rng = np.random.default_rng(1)
    count = round(metres / SPACING_M) + 1
    turns = TURNS_DEG.size
    scene = rng.standard_normal(components)
    views = np.empty((count, 3, turns, components), np.int8)
    # Few patterns of noise for many places: a hundred kilometres would take minutes else.
    noise = rng.standard_normal((64, 3, turns, components), dtype=np.float32)
    for place in range(count):
        scene = 0.9 * scene + np.sqrt(1.0 - 0.9**2) * rng.standard_normal(components)
        views[place] = packed(scene.astype(np.float32) + 0.5 * noise[place % len(noise)])
    frames = (count - 1) * round(SPACING_M / FRAME_M) + 1
    step = FRAME_M
    turn = 0.08
    mapped = VisualMap(
        poses=np.column_stack([FRAME_M * np.arange(frames), np.zeros((frames, 2))]),
        drives=np.zeros(frames, np.int32),
        keyframes=(np.arange(count) * round(SPACING_M / FRAME_M)).astype(np.int32),
        basis=np.linalg.qr(rng.standard_normal((_FEATURES.size, components)))[0].astype(np.float32),
        views=views,
        blank=np.zeros(components, np.float32),
        correlation_length=5.0 * SPACING_M,
        correlation_rad=0.2,
        log_ratio=np.tile(np.linspace(-3.0, 10.0, GRID.size), (SHARES.size, 1)),
        gamma=1.0,
        next_correlation=0.5,
        movements=np.array([(0.0, 0.0), (step, 0.0), (-step, 0.0), (0.0, turn), (0.0, -turn)]),
        tick_s=0.1,
        odometry=True,
        scene=Scene(Camera(0.7), 1.0, 1.0),
        goals=("victim",),
        names=(("made up",),),
        size=(64, 48),
    )
    return Model(Centering(np.zeros(_FEATURES.size, np.float32), _FEATURES), mapped)


def case(metres: float, components: int, frames: int) -> dict[str, Any]:
    """Follow the way from its beginning; return what the JSON file holds of it."""
    model = map_of(metres, components)
    rng = np.random.default_rng(2)
    times = []
    localizer = Localizer(model)
    planner = Planner(model.mapped)
    lost = 0.0
    for frame in range(frames):
        view = unpacked(model.mapped.views[round(frame * FRAME_M / SPACING_M), 1, STRAIGHT])
        raw = model.mapped.basis @ view + 0.01 * rng.standard_normal(_FEATURES.size).astype(
            np.float32
        )
        began_s = time.perf_counter()
        belief = localizer.observe(raw, (frame * FRAME_M, 0.0, 0.0))
        planner.decide(belief.summary())
        times.append(1e3 * (time.perf_counter() - began_s))
        lost = max(lost, belief.lost) if frame > frames // 10 else 0.0
    p50, p95 = np.percentile(times[frames // 10 :], [50, 95])
    return {"metres": metres, "keyframes": len(model.mapped.keyframes), "map_mb": model.mapped.views.nbytes / 1e6,
            "p50_ms": float(p50), "p95_ms": float(p95), "most_lost": lost}  # fmt: skip


def learned(frames: int) -> dict[str, Any]:
    """Learn a drive of so many frames; return what the JSON file holds of it."""
    room = Room()
    way = drive((3.5, 3.5, 0.0), [(SIDE_M, 90.0)] * (frames // 30 + 1), speed=0.75)
    images = [room.look(pose, *IMAGE) for pose in way.poses[:frames]]
    atoms = way.atoms[:frames]
    (one,) = demonstrations_of([(images, atoms, way.poses[:frames])], _FEATURES)
    drives = [replace(one, features=one.rows)]  # As recordings have them.
    began_s = time.process_time()
    mapped = learn(drives, _FEATURES).mapped
    cpu_s = time.process_time() - began_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"frames": frames, "keyframes": len(mapped.keyframes), "cpu_s": cpu_s,
            "cpu_ms_a_frame": 1e3 * cpu_s / frames, "peak_mb": peak_mb}  # fmt: skip


def benchmark(
    metres: Sequence[float], components: int, frames: int, learn_frames: Sequence[int]
) -> dict[str, Any]:
    """Learn drives of so many frames, ascending, and follow ways of these lengths."""
    drives = [learned(one) for one in learn_frames]
    less = drives[0]
    more = drives[-1]
    growth = (more["cpu_s"] - less["cpu_s"]) / (more["frames"] - less["frames"])
    many_s = (more["cpu_s"] + growth * (MANY_FRAMES - more["frames"])) / CORES
    cases = [case(one, components, frames) for one in metres]
    targets = [
        verdict(
            f"learning {MANY_FRAMES:,} frames, s on {CORES} quiet cores, as it grows",
            many_s,
            LIMIT_S,
        ),
        verdict("a decision on the shortest way, ms", cases[0]["p50_ms"], LIMIT_MS),
        verdict(
            "p95 on the longest over that on the shortest",
            cases[-1]["p95_ms"] / cases[0]["p95_ms"],
            MOST_TIMES,
        ),
    ]
    return {"benchmark": "route", "learned": drives, "cases": cases, "targets": targets}


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("route", __doc__)
    parser.add_argument("--metres", type=float, nargs="+", default=[1e3, 1e4], metavar="M",
                        help="how long the ways are; 100 km take 3 GB")  # fmt: skip
    flags = parser.parse(arguments)
    frames, learn_frames = (60, (80, 120)) if flags.quick else (300, (500, 1000))
    results = benchmark(flags.metres, MAP_CONFIG.most_components, frames, learn_frames)
    text = table("Learning", results["learned"]) + table("A decision", results["cases"])
    say(flags, results, text + table("Targets", results["targets"]))
