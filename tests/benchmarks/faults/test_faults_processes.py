"""The processes of the fault benchmark: base, link that can go down, peers; and its command line."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from schemas.base import STANDING, Velocity
from schemas.topics import COMMANDS, TOPICS, rpc_key
from services.cli.stack import Stack, StackPlan, free_endpoint
from services.simulator.base import STEP_S
from services.simulator.body import WATCHDOG_S
from services.simulator.robots import RESCUEBOT
from services.simulator.world import load_world
from services.table import roles
from tests.benchmarks.faults.floods import Stop, floods, read_notes
from tests.benchmarks.faults.noting import NotingGate
from tests.benchmarks.faults.rig import ROBOT
from tests.benchmarks.faults.wheels import FarBase, read_steps, rolling
from tests.schemas.messages import EXAMPLES
from tests.services.waiting import eventually

system = pytest.mark.system


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    endpoint = free_endpoint()
    with Stack(StackPlan(("router",), ROBOT, endpoint, logs=tmp_path / "logs")):
        yield endpoint


def test_a_base_in_another_process_stands_by_its_own_watchdog_and_tells_what_it_did(
    tmp_path: Path,
) -> None:
    log = tmp_path / "steps.jsonl"

    def speeds() -> list[float]:
        return [step.speed_m_s for step in read_steps(log, 0.0)]

    with rolling("yard", log) as address:
        base = FarBase(address)
        rng = np.random.default_rng(1)
        start = load_world("yard").start
        base.put(start, rng)
        base.order(Velocity(0.5, 0.0))
        eventually(lambda: any(speeds()) and speeds()[-1] == 0.0)
        moving = [step for step in read_steps(log, 0.0) if step.speed_m_s]
        told = [base.step(STANDING, STEP_S) for _ in range(base.fetch())]
        base.put(start, rng)
        assert base.fetch() <= 1 / STEP_S  # of what was before, nothing is told
    assert WATCHDOG_S - STEP_S <= STEP_S * len(moving) <= WATCHDOG_S
    assert {step.atom for step in moving} == {"forward"}
    rolled_m = sum(sum(motion.rolled_m) / 2 for motion in told)
    assert rolled_m == pytest.approx(
        0.5 * RESCUEBOT.drive.speed_m_s * STEP_S * len(moving), rel=0.2
    )
    assert math.dist((told[-1].pose.x, told[-1].pose.y), (start.x, start.y)) == pytest.approx(
        rolled_m, rel=0.01
    )


@pytest.mark.parametrize("secure", [False, True])
def test_every_key_and_call_of_every_role_is_flooded_but_a_stop_s(secure: bool) -> None:
    of_all = floods(secure)
    flooded = {(one.kind, one.key) for of_it in of_all.values() for one in of_it}
    assert {key for kind, key in flooded if kind == "put"} == {
        topic.key(ROBOT) for topic in TOPICS.values() if topic.name != "command/emergency_stop"
    }
    called = {name for role in roles().values() for name in role.calls}
    assert {("call", rpc_key(ROBOT, *name.split("/", 1))) for name in called} <= flooded
    assert not secure or {"robot", "policy", "operator", "watcher"} <= of_all.keys()


def test_a_robot_that_notes_its_stops_stands_for_each_and_drives_on(tmp_path: Path) -> None:
    notes = tmp_path / "stops"
    gate = NotingGate(notes, attended=False)
    assert gate.arm(gate.latched_stop, "") is None
    gate.begin("e", "policy")
    stop = EXAMPLES[COMMANDS["emergency_stop"].message].model_copy(
        update={"source": "emergency_stop", "sequence": 7}
    )
    gate.offer(stop, 1.0)
    assert read_notes(notes)[7].keys() == {"latched_s"}
    assert gate.applied(1.02).reason == "latched_stop"
    assert read_notes(notes)[7].keys() == {"latched_s", "stood_s"}
    assert gate.applied(1.1).reason == "latched_stop"
    gate.applied(1.2)
    assert not gate.latched_stop
    assert not gate.taken_over
    assert [Stop("", 1e5, late_s).in_time for late_s in (None, 0.51, 0.5)] == [False, False, True]
