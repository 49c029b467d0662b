"""The processes of the fault benchmark: observer, link that can go down, slow consumer; and its command line."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from schemas.rpc import Nothing, Status
from schemas.topics import POSE
from services.cli.stack.processes import Stack, StackPlan, free_endpoint
from services.kit.bus import Bus, RpcError
from services.kit.errors import UsageError
from tests.benchmarks.faults import benchmark as faults
from tests.benchmarks.faults.log import read_log
from tests.benchmarks.faults.observer import observing
from tests.benchmarks.faults.proxy import link
from tests.benchmarks.faults.slow import slow_consumer
from tests.schemas.messages import EXAMPLES
from tests.services.waiting import eventually

ROBOT = "rescuebot"
system = pytest.mark.system


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    endpoint = free_endpoint()
    with Stack(StackPlan(("router",), ROBOT, endpoint, logs=tmp_path / "logs")):
        yield endpoint


@system
def test_the_observer_notes_what_is_published(endpoint: str, tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    with closing(Bus(ROBOT, endpoint)) as bus, observing(ROBOT, endpoint, log) as pid:

        def noted() -> set[str]:
            for message in EXAMPLES.values():
                bus.publish(message)
            return {one.topic for one in read_log(log)} & {POSE.name, "camera/rgb"}

        assert len(eventually(lambda: noted() if len(noted()) == 2 else set())) == 2
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@system
def test_a_link_goes_down_and_comes_back(endpoint: str) -> None:
    with link(endpoint) as (address, pid), closing(Bus(ROBOT, address)) as bus:
        bus.wait_connected(10.0)

        def answers() -> bool:
            try:
                return bus.call("router", "status", Nothing(), Status, timeout_s=0.5).service == "router"
            except RpcError:
                return False

        assert eventually(answers)
        os.kill(pid, signal.SIGSTOP)
        assert not answers()
        os.kill(pid, signal.SIGCONT)
        assert eventually(answers)


@system
def test_a_slow_consumer_leaves_nothing_behind(endpoint: str) -> None:
    with slow_consumer(ROBOT, endpoint) as pid, closing(Bus(ROBOT, endpoint)) as bus:
        bus.publish(EXAMPLES[POSE.message])
        os.kill(pid, 0)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_cell_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="kill -9 policy"):
        faults.main(["--cell", "earthquake", "--out", str(tmp_path)])


def test_a_model_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.smal"):
        faults.main(["--model", str(tmp_path / "none.smal"), "--quick"])
