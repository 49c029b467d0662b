"""Rooms: SMAL and its peers in a textured MuJoCo scene, a foreign simulator behind the Gymnasium adapter.

Three ways through four rooms and a courtyard. On each way the scripted expert drives five times, and every drive
teaches alone. The searches are those of the comparison (services/experiments/PROTOCOL.md): from the start, from
anywhere beside the way, and kidnapped after 10 s, without a depth camera. The scene is rendered offscreen (EGL, or
MUJOCO_GL=osmesa). Requires pip install -e '.[mujoco]'.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas.rpc import ResetRequest
from services.experiments.evaluation.drivers import FEATURES, CheckedDriver
from services.experiments.evaluation.drives import drive_in, drive_of
from services.experiments.evaluation.plan import (
    CELLS,
    RUN_SEED,
    TAUGHT,
    TEACHING_SEED,
    Criterion,
    Trial,
)
from services.experiments.evaluation.report.summary import Success
from services.experiments.evaluation.search import finding, search_in
from services.experiments.words import remark
from services.expert.driver import DRIVE_TICKS
from services.kit.errors import UsageError
from services.robot.lockstep import SimulatorsTask, SteppedBody, SteppedEpisode, StepView
from tests.benchmarks.reporting import Parser, Record, say, table

if TYPE_CHECKING:
    from tests.benchmarks.rooms.body import RoomsBody

DRIVERS: Final = ("smal", "teach-and-repeat", "place-filter", "nearest-5")
ASKED: Final = ("start", "anywhere", "kidnapped")
PATIENCE: Final = 3.0  # Timeout of a search in taught drives, as in the protocol.
CRITERION: Final = Criterion(0.35, 25.0)
_VIEWS: Final = 6  # Pictures of each way.
Drive = dict[str, NDArray[Any]]


class _TaughtWay(NamedTuple):
    """A way with one of its drives, which teaches alone."""

    way: str
    number: int


class _Searched(NamedTuple):
    """Result of a search, and the wall times of its decisions."""

    driver: str
    cell: str
    way: str
    drive: int
    result: dict[str, Any]
    decision_ms: list[float]


def main(arguments: list[str]) -> None:
    """Run the benchmark with the arguments of the command line."""
    parser = Parser("rooms", __doc__)
    parser.add_argument(
        "--minutes", type=float, metavar="N", help="begin no further drive after this time"
    )
    flags = parser.parse(arguments)
    bodies = _bodies()
    sets = [_TaughtWay(way, k) for k, way in product(range(TAUGHT), bodies)]
    if flags.quick:
        sets = sets[:1]
    ends_s = np.inf if flags.minutes is None else time.monotonic() + 60.0 * flags.minutes
    searches: list[_Searched] = []
    taught = {way: list[int]() for way in bodies}
    for one in tqdm(sets, "drives", disable=None):
        if searches and time.monotonic() > ends_s:
            break
        made = _drive(bodies[one.way], one)
        taught[one.way].append(len(made["poses"]))
        if flags.out is not None and one.number == 0:
            _save_pictures(flags.out / f"{one.way}.png", made)
        searches += _searches(bodies[one.way], one, made)
    for body in bodies.values():
        body.close()
    rows = [
        _row([each for each in searches if (each.driver, each.cell) == (driver, cell)])
        for cell, driver in product(ASKED, DRIVERS)
    ]
    ways = [
        {"way": way, "drives": len(frames), "frames": float(np.mean(frames or 0))}
        for way, frames in taught.items()
    ]
    every = [each._asdict() | {"decision_ms": None} for each in searches]
    text = table("Taught", ways) + table("Searches, with Wilson's 95 % intervals", rows)
    say(flags, {"rows": rows, "taught": ways, "searches": every}, text)


def _bodies() -> "dict[str, RoomsBody]":
    try:
        from tests.benchmarks.rooms.body import RoomsBody  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise UsageError(
            f"MuJoCo cannot be used ({error}); pip install -e '.[mujoco]', and EGL or OSMesa of the system"
        ) from None
    from tests.benchmarks.rooms.scene import WAYS  # noqa: PLC0415

    return {way: RoomsBody(way) for way in WAYS}


class _TargetIsThere(SimulatorsTask):
    def gone(self, view: StepView, goal: str) -> bool:
        del view, goal
        return False


def _episode(body: SteppedBody, request: ResetRequest) -> SteppedEpisode[StepView]:
    return SteppedEpisode(body, _TargetIsThere(), request)


def _drive(body: SteppedBody, one: _TaughtWay) -> Drive:
    seed = TEACHING_SEED + one.number
    request = ResetRequest(seed=seed, purpose="drive", driver="expert", max_ticks=DRIVE_TICKS)
    return drive_in(_episode(body, request), f"rooms, {one.way}", FEATURES)


def _searches(body: SteppedBody, one: _TaughtWay, made: Drive) -> Iterator[_Searched]:
    """Yield the searches of every driver after a drive."""
    from tests.benchmarks.rooms.scene import RADIUS_M, clearance_m  # noqa: PLC0415

    def clearance() -> float:
        x, y, _ = body.observe().true_pose
        return max(clearance_m(x, y) - RADIUS_M, 0.0)

    most_ticks = round(PATIENCE * len(made["poses"]))
    seed = RUN_SEED + one.number
    for name in DRIVERS:
        with tempfile.TemporaryDirectory() as folder:
            driver = CheckedDriver(name, [drive_of(made)], Path(folder))
        for cell in ASKED:
            request = ResetRequest(
                seed=seed, purpose="run", max_ticks=most_ticks, until_said=True, **CELLS[cell]
            )
            run = search_in(_episode(body, request), driver, clearance)
            result = finding(run, made["poses"], CRITERION)
            result["taught_ticks"] = len(made["poses"]) - 1.0
            remark([f"{one.way}, drive {one.number + 1}: {name}, {cell}: {run.outcome}"])
            yield _Searched(name, cell, one.way, one.number, result, run.decision_ms.tolist())


def _row(searches: Sequence[_Searched]) -> Record:
    """Return the figures of a driver in a cell."""
    driver, cell, *_ = searches[0]
    trial = Trial(driver, 1, len(searches), **CELLS[cell])
    took_ms = [took for one in searches for took in one.decision_ms]
    success = Success(trial, [one.result for one in searches], took_ms)
    low, high = success.wilson_95
    others = [name for name in success.outcomes if name != "found"]
    failed = (f"{others.count(name)} {name.replace('_', ' ')}" for name in dict.fromkeys(others))
    return {
        "cell": cell,
        "driver": trial.title,
        "found": f"{success.succeeded} of {success.runs}",
        "95 %": f"{low:.2f} to {high:.2f}",
        "SPL": success.spl,
        "aside, m": success.aside_rms_m,
        "decision, ms": success.decision_ms[0],
        "other outcomes": ", ".join(failed) or "-",
    }


def _save_pictures(path: Path, made: Drive) -> None:
    """Save images of a drive side by side."""
    images = drive_of(made).images
    assert images is not None
    chosen = np.linspace(0, len(images) - 1, _VIEWS).astype(int)
    cv2.imwrite(str(path), np.hstack([images[int(k)] for k in chosen])[..., ::-1])
