"""Route: how long a decision takes on ways of one and of ten kilometres, the filter and the planner alone.

The maps are made up: as many keyframes a metre as drives in streets have, each with all its virtual views in 400
components, that change smoothly along the way. A robot follows each by its wheels and by noisy views; features of an
image and transport are apart.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from smal.camera import STRAIGHT
from smal.features import Centering, FeatureSettings
from smal.likelihood import GRID, SHARES
from smal.model import Model, VisualMap, packed, unpacked
from smal.planning import Planner
from smal.robot import Localizer
from smal.settings import SETTINGS
from tests.benchmarks.reporting import Parser, say, table, verdict

#: 1.35 keyframes a metre, as in drives through streets; a correlation length is five of them.
SPACING_M, FRAME_M, LIMIT_MS, MOST_TIMES = 0.75, 0.25, 20.0, 2.0
_FEATURES: Final = FeatureSettings()


def map_of(metres: float, components: int) -> Model:
    """Make up a straight way."""
    rng = np.random.default_rng(1)
    count, turns = round(metres / SPACING_M) + 1, len(SETTINGS.turns_deg)
    scene, views = rng.standard_normal(components), np.empty((count, 3, turns, components), np.int8)
    # Few patterns of noise for many places: a hundred kilometres would take minutes else.
    noise = rng.standard_normal((64, 3, turns, components), dtype=np.float32)
    for place in range(count):
        scene = 0.9 * scene + np.sqrt(1.0 - 0.9**2) * rng.standard_normal(components)
        views[place] = packed(scene.astype(np.float32) + 0.5 * noise[place % len(noise)])
    frames = (count - 1) * round(SPACING_M / FRAME_M) + 1
    step, turn = FRAME_M, 0.08
    mapped = VisualMap(
        poses=np.column_stack([FRAME_M * np.arange(frames), np.zeros((frames, 2))]),
        drives=np.zeros(frames, np.int32),
        keyframes=(np.arange(count) * round(SPACING_M / FRAME_M)).astype(np.int32),
        basis=np.linalg.qr(rng.standard_normal((_FEATURES.size, components)))[0].astype(np.float32),
        views=views,
        blank=np.zeros(components, np.float32),
        aside=1.5,
        correlation_length=5.0 * SPACING_M,
        correlation_rad=0.2,
        log_ratio=np.tile(np.linspace(-3.0, 10.0, GRID.size), (SHARES.size, 1)),
        gamma=1.0,
        movements=np.array([(0.0, 0.0), (step, 0.0), (-step, 0.0), (0.0, turn), (0.0, -turn)]),
        tick_s=0.1,
        odometry=True,
        scene=np.ones(3),
        goals=("victim",),
        names=(("made up",),),
    )
    return Model(Centering(np.zeros(_FEATURES.size, np.float32), _FEATURES), mapped)


def case(metres: float, components: int, frames: int) -> dict[str, Any]:
    """Follow the way from its beginning; return what the JSON file holds of it."""
    model, rng, times = map_of(metres, components), np.random.default_rng(2), []
    localizer, planner, lost = Localizer(model), Planner(model.mapped), 0.0
    for frame in range(frames):
        view = unpacked(model.mapped.views[round(frame * FRAME_M / SPACING_M), 1, STRAIGHT])
        raw = model.mapped.basis @ view + 0.01 * rng.standard_normal(_FEATURES.size).astype(np.float32)
        began_s = time.perf_counter()
        belief = localizer.observe(raw, (frame * FRAME_M, 0.0, 0.0))
        planner.decide(belief.summary())
        times.append(1e3 * (time.perf_counter() - began_s))
        lost = max(lost, belief.lost) if frame > frames // 10 else 0.0
    p50, p95 = np.percentile(times[frames // 10 :], [50, 95])
    return {"metres": metres, "keyframes": len(model.mapped.keyframes), "map_mb": model.mapped.views.nbytes / 1e6,
            "p50_ms": float(p50), "p95_ms": float(p95), "most_lost": lost}  # fmt: skip


def benchmark(metres: Sequence[float], components: int, frames: int) -> dict[str, Any]:
    """Follow ways of these lengths."""
    cases = [case(one, components, frames) for one in metres]
    targets = [
        verdict("a decision on the shortest way, ms", cases[0]["p50_ms"], LIMIT_MS),
        verdict("p95 on the longest over that on the shortest", cases[-1]["p95_ms"] / cases[0]["p95_ms"], MOST_TIMES),
    ]
    return {"benchmark": "route", "cases": cases, "targets": targets}


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    parser = Parser("route", __doc__)
    parser.add_argument("--metres", type=float, nargs="+", default=[1e3, 1e4], metavar="M",
                        help="how long the ways are; 100 km take 3 GB")  # fmt: skip
    flags = parser.parse(arguments)
    results = benchmark(flags.metres, SETTINGS.most_components, 60 if flags.quick else 300)
    say(flags, results, table("A decision", results["cases"]) + table("Targets", results["targets"]))
