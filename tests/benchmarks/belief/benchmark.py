"""Belief: what each part of the filter is for, and whether its probabilities hold.

Open loop: drives that were not taught are cut into pieces and played to the filter. A run begins anywhere on one of
them; after eight seconds the robot is carried, without its wheels' knowing, to anywhere on another one; after eight
more, in every fourth run, into another world. Half of the drives were made on another day. All variants of the filter
have the same runs. Right is a belief within the world's criterion of the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm import tqdm

from schemas.episode import Purpose
from services.cli import options
from services.experiments.drawing import draw_reliability, styled
from services.experiments.evaluation.drives import drive, drive_of
from services.experiments.evaluation.plan import (
    CLOUDS_SEED,
    FULL,
    QUERY_SEED,
    TAUGHT,
    TEACHING_SEED,
    in_world,
)
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.variation import clouded
from smal.camera import STRAIGHT
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import wilson_interval
from smal.evaluation.reliability import Reliability
from smal.features import FeatureSettings
from smal.filter import Belief, Filter, Newness
from smal.model import Model
from smal.movement import Atom, placed, seen_from
from smal.particles import FILTER_CONFIG, FilterConfig, ViewEvidence
from smal.planning.config import PLANNER_CONFIG
from smal.robot import Localizer
from smal.teaching.mapping import learn
from tests.benchmarks.reporting import Parser, Record, say, table, verdict

_FEATURES: Final = FeatureSettings()
#: Frames of a piece, at ten a second; those within which a belief is to be right, and for how long it is to stay so.
PIECE = 80
SOON = 30
STAYS = 10
_AWAY_EVERY: Final = 4  # A run in so many ends in another world.
ERROR: Final = 0.05


@dataclass(frozen=True)
class Variant:
    """A filter with a part left out: of its settings, of its map's views, of its code, or of what it is told."""

    config: FilterConfig = FILTER_CONFIG
    views: Callable[[NDArray[np.int8]], NDArray[np.int8]] = lambda views: views
    scouts: bool = True
    tempered: bool = True
    odometry: bool = True

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Have the filter use it."""
        with ExitStack() as stack:
            if not self.scouts:
                stack.enter_context(patch.object(Filter, "_weigh", _without_scouts))
            if not self.tempered:
                stack.enter_context(patch.object(Newness, "of", lambda _self, _components: 1.0))
            yield


def _without_scouts(self: Filter, seen: ViewEvidence) -> None:
    """Weigh as `Filter` does, but let nobody look elsewhere: who is not lost is where the wheels lead."""
    odds = self._odds
    tracked = (odds.tracked + odds.sent + odds.turned_in) * self._tracked.update(seen, self._rng)
    total = tracked + odds.unknown
    self._odds = odds._replace(
        tracked=tracked / total, sent=0.0, turned_in=0.0, away=0.0, lost=odds.unknown / total
    )


def _middle(views: NDArray[np.int8]) -> NDArray[np.int8]:
    return np.ascontiguousarray(np.broadcast_to(views[:, 1:2], views.shape))


def _straight(views: NDArray[np.int8]) -> NDArray[np.int8]:
    return np.ascontiguousarray(np.broadcast_to(views[:, :, STRAIGHT : STRAIGHT + 1], views.shape))


_AT_START, _ANYWHERE, _LOST = FILTER_CONFIG.first
VARIANTS: Final = {
    "as it is": Variant(),
    "without views from aside": Variant(views=_middle),
    "without turned views": Variant(views=_straight),
    "without scouts": Variant(scouts=False),
    "every view counts in full": Variant(tempered=False),
    "lost only far from every way": Variant(
        FilterConfig(first=(_AT_START, _ANYWHERE + _LOST, 0.0))
    ),
    "atoms for odometry": Variant(odometry=False),
}


@dataclass(frozen=True, eq=False)
class Asked:
    """A drive that is asked: of its frames features (f, m), wheels' and true poses (f, 3), and what was done."""

    features: NDArray[np.float32]
    wheels: NDArray[np.float64]
    poses: NDArray[np.float64]
    atoms: NDArray[np.int8]

    @classmethod
    def of(cls, made: dict[str, NDArray[Any]]) -> Asked:
        """Take what `drive` made."""
        return cls(made["features"], made["odometry"], made["poses"], made["atoms"])


@dataclass(frozen=True, eq=False)
class Said:
    """Arrays (f,) over the frames of a run: near a taught way or not, the filter's estimate, and the truth.

    ``near``: the probability of the belief to be as near to the likeliest place as ``right`` wants it;  ``goal``: of
    being at the goal; ``arrived``: whether it is there.
    """

    known: NDArray[np.bool_]
    right: NDArray[np.bool_]
    near: NDArray[np.float64]
    lost: NDArray[np.float64]
    goal: NDArray[np.float64]
    arrived: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Judge:
    """Holds beliefs over one map against the truth: the taught frames' true poses (n, 3), and the criterion."""

    model: Model
    taught: NDArray[np.float64]
    distance_m: float
    angle_rad: float

    def of(
        self, belief: Belief, true: NDArray[np.float64] | None
    ) -> tuple[bool, bool, float, float, float, bool]:
        """Judge one belief; the true pose is None in another world."""
        mapped = self.model.mapped
        best = belief.summary(1)
        there = mapped.keyframes[best.keyframes[0]]
        # All particles in the axes of the drive, which the wheels drew; the truth by the taught frame's true pose.
        poses = placed(belief.offsets, mapped.key_poses[belief.keyframes])
        said = best.offsets[0]
        centre = placed(said, mapped.poses[there])
        near = float(belief.weights[self._within(poses, centre)].sum()) * (1.0 - belief.lost)
        goal_m = PLANNER_CONFIG.goal_s * mapped.speed
        at_goal = np.hypot(*(poses - mapped.poses[-1])[:, :2].T) < goal_m
        goal = float(belief.weights[at_goal].sum()) * (1.0 - belief.lost)
        if true is None:
            return False, False, near, belief.lost, goal, False
        right = bool(self._within(true[None], placed(said, self.taught[there]))[0])
        return (
            True,
            right,
            near,
            belief.lost,
            goal,
            bool(math.dist(true[:2], self.taught[-1, :2]) < goal_m),
        )

    def _within(self, poses: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.bool_]:
        x, y, turned = seen_from(poses, centre).T
        return np.asarray((np.hypot(x, y) <= self.distance_m) & (np.abs(turned) <= self.angle_rad))


def run(judge: Judge, variant: Variant, drives: list[Asked], away: Asked, number: int) -> Said:
    """Play one run to a variant of the filter."""
    rng = np.random.default_rng(number)
    pieces = [drives[k] for k in rng.choice(len(drives), 2, replace=False)]
    pieces += [away] if number % _AWAY_EVERY == 0 else []
    pose = np.zeros(3)
    found = []
    with variant.in_place():
        robot = Localizer(judge.model, seed=number, config=variant.config)
        for piece, frame, moved in _frames(pieces, rng):
            # Carried: the wheels stand, and nothing was done.
            atoms = [Atom(int(piece.atoms[frame - 1]))] if moved else []
            if moved:
                pose = placed(seen_from(piece.wheels[frame], piece.wheels[frame - 1]), pose)
            wheels = pose.tolist() if variant.odometry else None
            belief = robot.observe(piece.features[frame], wheels, atoms)
            found.append(judge.of(belief, None if piece is away else piece.poses[frame]))
    return Said(*(np.array(column) for column in zip(*found, strict=True)))


def _frames(pieces: list[Asked], rng: np.random.Generator) -> Iterator[tuple[Asked, int, bool]]:
    """Yield the frames of a random part of each piece, and whether the robot drove there."""
    for piece in pieces:
        first = int(rng.integers(max(1, len(piece.poses) - PIECE)))
        for frame in range(first, min(first + PIECE, len(piece.poses))):
            yield piece, frame, frame > first


def soon(said: Said, start: int) -> bool:
    """Whether the belief is right, and stays so, soon after a frame."""
    right = said.right[start : start + SOON + STAYS]
    return any(right[k : k + STAYS].all() for k in range(SOON + 1))


def figures(name: str, runs: list[Said]) -> Record:
    """Say of a variant how often it is right soon after a begin and after being carried, and what it is else."""
    begun, carried = (sum(soon(one, start) for one in runs) for start in (0, PIECE))
    known = np.concatenate([one.known for one in runs])
    right, lost = (np.concatenate([getattr(one, of) for one in runs]) for of in ("right", "lost"))
    return {
        "filter": name, "right in 3 s": _of(begun, len(runs)), "carried, right in 3 s": _of(carried, len(runs)),
        "right": float(right[known].mean()), "lost": float((lost[known] > 0.5).mean()),
        "wrong and sure": float((~right & (lost < 0.1))[known].mean()),
        "elsewhere, lost": float((lost[~known] > 0.5).mean()),
    }  # fmt: skip


def _of(count: int, runs: int) -> str:
    low, high = wilson_interval(count, runs)
    return f"{count} of {runs} ({low:.2f} to {high:.2f})"


def reliabilities(runs: list[Said]) -> dict[str, Reliability]:
    """Hold three probabilities against what is true: of the place, of being lost, of the goal."""
    known, right, near, lost, goal, arrived = (
        np.concatenate([getattr(one, of) for one in runs]) for of in Said.__dataclass_fields__
    )
    every = np.ones(len(known), dtype=np.bool_)
    said = {"the place": (near, right), "lost": (lost, ~known), "the goal": (goal, arrived)}
    return {
        name: Reliability.of(Judgement(np.clip(likely, 0.0, 1.0), every, true, every, every))
        for name, (likely, true) in said.items()
    }


@styled
def draw(found: dict[str, Reliability]) -> Figure:
    """Draw the diagrams."""
    figure = Figure(figsize=(4 * len(found), 4.5))
    for axes, (name, one) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
        draw_reliability(axes, one)
        axes.set_title(f"{name}: calibration error {one.error:.3f}")
    return figure


def benchmark(
    world: str, elsewhere: str, size: tuple[int, int], runs: int, taught: int, drives: int
) -> dict[str, Any]:
    """Teach so many drives, each alone, and ask all variants by so many drives on each of two days."""
    camera = CameraSettings(*size)
    known = [one for one in FULL.worlds if one.world == world]
    (plan,) = known or in_world(world, options.read_world(world).scale.aside_m).worlds
    within = plan.criterion.distance_m, math.radians(plan.criterion.angle_deg)
    simulation = open_simulation(world, camera)
    judges = []
    for seed in tqdm(
        range(TEACHING_SEED, TEACHING_SEED + taught), desc="teaching", dynamic_ncols=True
    ):
        made = drive(simulation, _FEATURES, seed)
        judges.append(Judge(learn([drive_of(made)], _FEATURES), made["poses"], *within))
    asked = []
    purposes: list[Purpose] = ["drive", "recovery"]
    days = [
        open_simulation(world, camera, variation=clouded(day, CLOUDS_SEED))
        for day in ("day", "other-day")
    ]
    for there, number in tqdm(
        list(product(days, range(drives))), desc="driving", dynamic_ncols=True
    ):
        asked.append(
            Asked.of(drive(there, _FEATURES, QUERY_SEED + number, purpose=purposes[number % 2]))
        )
    away = Asked.of(drive(open_simulation(elsewhere, camera), _FEATURES, QUERY_SEED))
    said: dict[str, list[Said]] = {}
    for name, number in tqdm(
        list(product(VARIANTS, range(runs))), desc="asking", dynamic_ncols=True
    ):
        judge = judges[number % len(judges)]
        variant = VARIANTS[name]
        mapped = judge.model.mapped
        model = replace(judge.model, mapped=replace(mapped, views=variant.views(mapped.views)))
        said.setdefault(name, []).append(
            run(replace(judge, model=model), variant, asked, away, number)
        )
    found = reliabilities(next(iter(said.values())))
    return {
        "benchmark": "belief", "world": plan.title, "right": plan.criterion.meaning,
        "variants": [figures(name, runs_) for name, runs_ in said.items()],
        "reliability": {name: {"said": one.said.tolist(), "right": one.right.tolist(), "frames": one.count.tolist()}
                        for name, one in found.items()},
        "targets": [verdict(f"calibration error of {name}", one.error, ERROR) for name, one in found.items()],
        "found": found,
    }  # fmt: skip


def main(arguments: list[str]) -> None:
    """Read the flags, ask, print and write."""
    parser = Parser("belief", __doc__)
    parser.add_argument(
        "--world", default="indoor", metavar="NAME|FILE", help="where it drives (default: indoor)"
    )
    parser.add_argument(
        "--elsewhere", default="yard", metavar="NAME|FILE", help="the other world (default: yard)"
    )
    parser.add_argument(
        "--runs", type=int, default=100, metavar="N", help="of each variant (default: 100)"
    )
    flags = parser.parse(arguments)
    extent = ((160, 120), 10, 1, 2) if flags.quick else (FULL.camera, flags.runs, TAUGHT, 10)
    results = benchmark(flags.world, flags.elsewhere, *extent)
    found = results.pop("found")
    if flags.out is not None:
        draw(found).savefig(flags.out / "reliability.png", dpi=110)
    say(flags, results, table(f"Filters: right is {results['right']}", results["variants"])
        + table("Reliability", results["targets"]))  # fmt: skip
