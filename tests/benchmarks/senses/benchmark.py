"""Senses that lie: whether the robot stands, and whether it touches anything.

Every lying depth camera, and every wrong mount, drives from places by chance: a person holds the key for full speed
ahead, and the robot searches by itself, half of the time from the start among three obstacles. Half of the lies begin
with the episode, the others a second after the robot set off. A failing camera, or odometry, begins to lie on the
taught way, without a depth camera. The last rows are honest: searches from the start of the way, with the same checks.
"""

import math
from collections.abc import Callable, Iterator
from typing import Final

from tqdm import tqdm

from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from smal.evaluation.precision_recall import wilson_interval
from smal.model import Model
from smal.obstacles.clearance import Mount
from tests.benchmarks.reporting import Parser, Record, say, table, verdict
from tests.benchmarks.senses.lies import CAMERA_LIES, DEPTH_LIES, MOUNT_LIES, WHEEL_LIES, Lie
from tests.benchmarks.senses.trials import Trial, by_hand, by_itself, teach

PLACES = 50
SEARCHES = 20
QUICK = 2
SEED: Final = 5000
# Frames from the beginning to the lies that do not begin with the episode: 1 s.
SETS_OFF_TICKS: Final = 10
#: Frame at which a camera or odometry fails: the robot drives at full speed by then; runs differ by seven frames.
FAILS_AT_TICKS = 40
APART_TICKS = 7
WATCHED_TICKS: Final = 60  # Frames of a run after that.
MOST_S: Final = 1.0  # Driving at full speed after which a robot stands whose camera or odometry failed, seconds.


def main(arguments: list[str]) -> None:
    """Measure, print the tables, and write the results."""
    parser = Parser("senses", __doc__)
    parser.add_argument(
        "--world",
        nargs="+",
        default=["indoor", "campus"],
        metavar="WORLD",
        help="worlds to drive in",
    )
    parser.add_argument(
        "--places", type=int, metavar="N", help=f"places of each lying depth camera ({PLACES})"
    )
    parser.add_argument(
        "--searches", type=int, metavar="N", help=f"runs of each failing sense ({SEARCHES})"
    )
    parser.add_argument(
        "--only", nargs="+", metavar="TEXT", help="lies whose name contains one of these texts"
    )
    flags = parser.parse(arguments)
    places = flags.places or (QUICK if flags.quick else PLACES)
    searches = flags.searches or (QUICK if flags.quick else SEARCHES)
    rows: list[Record] = []
    for world in flags.world:
        for row in _of_world(world, places, searches, flags.only):
            rows.append(row)
            tqdm.write("; ".join(f"{name}: {value}" for name, value in row.items()))
    depth = [row for row in rows if "touched" in row]
    fails = [row for row in rows if "stood" in row]
    found = [row for row in rows if "found" in row]
    touches = "touches behind a lying depth camera"
    moves = "failed senses with which it did not stand"
    targets = [
        verdict(touches, _sum(depth, "touched"), 0),
        verdict(moves, _sum(fails, "drove on"), 0),
    ]
    text = table("Lying depth cameras", depth) + table(
        "Failing cameras and wheels, without depth", fails
    )
    text += table("Honest senses, from the start", found) + table("Targets", targets)
    say(flags, {"depth": depth, "failures": fails, "honest": found, "targets": targets}, text)


def _sum(rows: list[Record], name: str) -> float:
    return sum(int(str(row[name])) for row in rows)


def _of_world(world: str, places: int, searches: int, only: list[str] | None) -> Iterator[Record]:
    simulation = open_simulation(world, CameraSettings(320, 240), depth=True)
    own = simulation.mount
    assert own is not None
    model = teach(simulation)

    def wanted(name: str) -> bool:
        return only is None or any(text in name for text in only)

    lies: list[tuple[str, Lie | None, Mount]] = [(lie.name, lie, own) for lie in DEPTH_LIES]
    lies += [(name, None, change(own)) for name, change in MOUNT_LIES.items()]
    for name, lie, mount in lies:
        if wanted(name):
            yield _depth_row(simulation, model, (name, lie, mount), places)
    for failure in (*CAMERA_LIES, *WHEEL_LIES):
        if wanted(failure.name):
            yield _failure_row(simulation, model, failure, searches)
    for depth in (True, False):
        name = f"honest, {'with' if depth else 'without'} depth"
        if wanted(name):
            yield _honest_row(simulation, model, name, own if depth else None, searches)


def _each(count: int, name: str, make: Callable[[int], Trial]) -> list[Trial]:
    return [
        make(number) for number in tqdm(range(count), desc=name, unit="run", dynamic_ncols=True)
    ]


def _depth_row(
    simulation: Simulation, model: Model, what: tuple[str, Lie | None, Mount], places: int
) -> Record:
    name, lie, mount = what
    world = simulation.name

    def since(number: int) -> int:
        return SETS_OFF_TICKS * (number % 2)

    hand = _each(places, f"{world}, {name}, by hand",
                 lambda k: by_hand(simulation, lie, mount, SEED + k, since(k)))  # fmt: skip

    def search(number: int) -> Trial:
        anywhere = (
            number // 2 % 2 == 0
        )  # Half of the searches begin at the start, with things in their way.
        return by_itself(
            simulation, lie, mount, SEED + number, since(number), model,
            obstacles=0 if anywhere else 3, anywhere=anywhere, most=80,
        )  # fmt: skip

    itself = _each(places, f"{world}, {name}, by itself", search)
    both = [*hand, *itself]
    return {
        "world": world,
        "lie": name,
        "runs": len(both),
        "touched": sum(one.touched for one in both),
        "by hand": sum(one.touched for one in hand),
        "by itself": sum(one.touched for one in itself),
        "driven, mean (m)": sum(one.driven_m for one in both) / len(both),
    }


def _failure_row(simulation: Simulation, model: Model, lie: Lie, searches: int) -> Record:
    def run(number: int) -> Trial:
        since = FAILS_AT_TICKS + APART_TICKS * (number % 5)
        return by_itself(
            simulation, lie, None, SEED + number, since, model, most=since + WATCHED_TICKS
        )

    runs = _each(searches, f"{simulation.name}, {lie.name}", run)
    limit_m = MOST_S * simulation.speed_m_s
    before_m = [one.driven_m - one.moved_later_m for one in runs]
    stood = [
        one for one, way_m in zip(runs, before_m, strict=True)
        if way_m <= limit_m and math.isfinite(one.stood_s) and not one.touched
    ]  # fmt: skip
    return {
        "world": simulation.name,
        "failure": lie.name,
        "stood": len(stood),
        "drove on": len(runs) - len(stood),
        "driven until it stood, at most (m)": max(before_m),
        "allowed (m)": limit_m,
        "later, at most (m)": max(one.moved_later_m for one in runs),
    }


def _honest_row(
    simulation: Simulation, model: Model, name: str, mount: Mount | None, searches: int
) -> Record:
    runs = _each(searches, f"{simulation.name}, {name}",
                 lambda k: by_itself(simulation, None, mount, SEED + k, 0, model, most=1500))  # fmt: skip
    found = sum(one.outcome == "found" for one in runs)
    low, high = wilson_interval(found, len(runs))
    outcomes = ", ".join(sorted({str(one.outcome) for one in runs}))
    return {"world": simulation.name, "senses": name, "found": found, "of": len(runs), "low": low, "high": high,
            "ended": outcomes, "contradictions": sum(one.contradicted for one in runs)}  # fmt: skip
