"""Harm a stack while the robot drives, and judge it as the benchmark ``faults`` does, in a minute.

Times to recover are bounds that hold on a busy machine too; the benchmark has the real ones.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.rpc import Nothing, Status
from schemas.topics import SNAPSHOTS
from services.simulator.base import STEP_S
from services.table import SERVICES, stack_services
from tests.benchmarks.faults.cells import MATRIX, Limits
from tests.benchmarks.faults.rig import Rig, RigPlan, rig_for
from tests.benchmarks.faults.run import run_cell
from tests.services.waiting import Lost

pytestmark = [pytest.mark.rendering, pytest.mark.system]

BUSY = {"recovery", "pause", "rate"}  # What a machine that does other things as well may miss.
STANDS = {"stand still", "stand", "stale"}  # What it is late with, by what it held up.


@pytest.fixture(scope="module")
def rig(near: Path, taught: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with rig_for(
        RigPlan(taught / "model.smal", tmp_path_factory.mktemp("faults"), str(near))
    ) as rig:
        yield rig


@pytest.mark.parametrize(
    "name",
    ["kill -9 policy", "freeze robot 1 s", "restart router", "kill -9 recorder", "kill -9 robot"],
)
def test_stack_recovers_and_the_recording_is_whole(rig: Rig, lost_s: Lost, name: str) -> None:
    costs_no_more(rig, lost_s, name)


def costs_no_more(rig: Rig, lost_s: Lost, name: str) -> None:
    """Do a harm to a stack that drives; it costs no more than a busy machine adds."""
    began_s = time.monotonic()
    outcome = run_cell(MATRIX[name], rig)
    assert outcome.recovery_s is not None, outcome
    assert (outcome.restart_s is not None) == (MATRIX[name].watched is not None), outcome
    stood_s = max(outcome.still_s, outcome.stood_s or 0.0)
    limit_s = Limits().still_s + STEP_S
    missed = BUSY | (STANDS if limit_s < stood_s <= limit_s + lost_s(began_s) else set())
    assert set(outcome.not_met) <= missed, str(
        outcome.record()
    )  # pytest would shorten anything else
    assert outcome.recorded > 100


def test_services_take_and_give_the_topics_of_the_table(rig: Rig) -> None:
    rig.start_moving()  # whatever ran in this process before: who drives has heard from everyone
    for name in stack_services():
        status = rig.bus.call(name, "status", Nothing(), Status)
        row = SERVICES[name]
        # The features take depth images where their modalities need them; what the robot takes at once waits nowhere,
        # and what is handed on waits for who serves the robot next.
        may_take = {topic.name for topic in row.takes}
        at_once = (
            may_take
            if name == "robot"
            else {"camera/depth", *(topic.name for topic in SNAPSHOTS.values())}
        )
        waiting = {one for one in status.waiting if not one.startswith("rpc/")}
        assert may_take - at_once <= waiting <= may_take, name
        assert {one for one in status.received if not one.startswith("rpc/")} <= may_take, name
        assert set(status.published) <= {topic.name for topic in row.gives}, name
        # The yard has no camera above it, and nobody sits at the page.
        gives = row.gives and name not in ("tracker", "console")
        assert bool(status.published) == bool(gives), name
