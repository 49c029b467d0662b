"""The engine: what it answers is the same in threads, in processes of this machine, and at a scheduler elsewhere."""

import multiprocessing
import os
import signal
from collections.abc import Iterator
from functools import partial
from itertools import chain
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest

import smal
from services.experiments import engine as engines
from services.experiments.engine import Engine
from services.experiments.evaluation.results import Results
from services.kit.errors import JobError, UsageError
from smal.features import FeatureSettings, extract
from tests import corridor
from tests.services.experiments.cluster import scheduler_and_worker
from tests.services.experiments.evaluation.test_units import SITE, After
from tests.services.secured import make_keys
from tests.services.waiting import eventually

IMAGES = list(np.random.default_rng(0).integers(0, 255, (70, 24, 32, 3), dtype=np.uint8))
WAY = np.cumsum(np.random.default_rng(0).normal(size=(100, 16)), axis=0)
LONG = np.tile(WAY, (21, 1))  # The method makes two parts of it.
describe = partial(extract, settings=FeatureSettings())


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="module")
def address(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with scheduler_and_worker(keys, tmp_path_factory.mktemp("cluster")) as address:
        yield address


def same(some: Iterator[np.ndarray]) -> bool:
    return [one.tobytes() for one in some] == [describe(image).tobytes() for image in IMAGES]


def test_workers_match_threads_when_workers_are_killed(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with Engine(None) as engine:
        assert same(engine.map(describe, IMAGES))
        assert multiprocessing.active_children() == []  # Threads, where no workers are asked for.
    # Dask gives up a worker that is away for longer.
    dask.config.set({"distributed.deploy.lost-worker-timeout": "10ms"})
    with Engine(2) as engine:
        answers = engine.map(describe, IMAGES)
        first = next(answers)
        for worker in multiprocessing.active_children():
            worker.kill()
        assert same(chain([first], answers))
        me = psutil.Process()
        listening = [
            one
            for process in (me, *me.children())
            for one in process.net_connections()
            if one.status == "LISTEN"
        ]
        assert {one.laddr.ip for one in listening} == {"127.0.0.1"}
        assert engine.client.scheduler_info()["address"].startswith("tls://")
        ((_, answer),) = engine.graph(["one"], len, lambda _: ())
        monkeypatch.setattr(engines, "_WORKER_S", 1.0)
        # A killed worker that starts again after the others have ended would answer.
        eventually(lambda: len(engine.client.nthreads()) == 2)
        engine.client.cluster.scale(0)
        eventually(lambda: not engine.client.nthreads())
        with pytest.raises(JobError, match=r"^all workers ended, and none started within 1 s$"):
            answer()  # It was at a worker that is there no more.
        with pytest.raises(JobError, match=r"^all workers ended, and none started within 1 s$"):
            list(engine.map(describe, IMAGES))
    assert multiprocessing.active_children() == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.long
def test_remote_scheduler_matches_threads_when_authenticated(
    address: str, keys: Path, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="use tls://"):
        Engine(1, "tcp://192.0.2.1:8786")
    with (
        pytest.raises(JobError, match="cannot connect"),
        Engine(1, address, make_keys(tmp_path / "others")) as one,
    ):
        list(one.map(describe, IMAGES))
    with Engine(1, address, keys) as engine:
        assert same(engine.map(describe, IMAGES))
        smal.fit([corridor.drive()], corridor.FEATURES, parallel=engine.map).save(
            tmp_path / "there"
        )
        there = smal.match(WAY, LONG, tolerance=2, parallel=engine.map)
        results = Results(tmp_path, [])
        results.complete([After(SITE, (), 0)], engine, lambda _done, _of: None)
        port = int(address.rpartition(":")[2])
        found = (
            one.pid
            for one in psutil.net_connections()
            if one.status == "LISTEN" and one.laddr.port == port
        )
        os.kill(next(pid for pid in found if pid is not None), signal.SIGKILL)
        with pytest.raises(
            JobError, match=f"^--scheduler {address}: connection to the scheduler lost"
        ):
            list(engine.map(describe, IMAGES * 100))
    assert [found["threads"] for found in results.findings.values()] == ["1"]
    corridor.save_model(tmp_path / "here")
    here = smal.match(WAY, LONG, tolerance=2)
    np.testing.assert_array_equal(there.reference, here.reference)
    np.testing.assert_array_equal(there.score, here.score)
    assert (tmp_path / "there").read_bytes() == (tmp_path / "here").read_bytes()
