"""The main job once, as a user does it: demonstrate, learn, run, with real processes and real pixels."""

import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import pytest

from schemas import topics
from schemas.rpc import Nothing, Status
from services.cli.stack import Stack, StackPlan, flags, free_endpoint
from smal.model import Model
from tests.command import run_smal
from tests.services.waiting import collected, eventually

pytestmark = [pytest.mark.rendering, pytest.mark.system, pytest.mark.timeout(1500)]


def run_json(world: Path, model: Path, out: Path, *more: object) -> dict[str, Any]:
    shared = ("--model", model, "--world", world, "--episodes", 1, "--max-ticks", 400)
    result = run_smal("run", *shared, "--json", out, *more)
    assert result.returncode == 0, result.stderr
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def outcomes(found: dict[str, Any]) -> list[str]:
    return [episode["outcome"] for episode in found["episodes"]]


def test_drive_is_recorded_drawn_and_learned(taught: Path) -> None:
    assert len(list((taught / "drives").glob("*.mcap"))) == 1
    assert not list((taught / "drives").glob("*.partial"))
    picture = cv2.imread(str(taught / "drives" / "drives.png"))
    assert picture.std() > 10
    report = json.loads((taught / "learned.json").read_text())
    assert (report["recordings"], report["episodes"], report["remarks"]) == (1, 1, [])
    assert report["keyframes"] >= 10
    model = Model.load(taught / "model.smal")
    assert model.mapped.odometry
    assert len(model.mapped.keyframes) == report["keyframes"]


@pytest.mark.long
def test_run_finds_the_victim_from_anywhere_after_a_kidnap(
    near: Path, taught: Path, tmp_path: Path
) -> None:
    report = tmp_path / "report"
    more = ("--start", "anywhere", "--kidnap", 30, "--camera", "160x120", "--report", report)
    found = run_json(near, taught / "model.smal", tmp_path / "run.json", *more)
    assert outcomes(found) == ["found"]
    page = (report / "index.html").read_text()
    assert page.count("<img") >= 3
    # "http" alone is among the letters of a picture now and then.
    assert "://" not in page.split("</style>")[1]


@pytest.mark.long
def test_paper_scheme_runs_in_real_time(near: Path, taught_paper: Path, tmp_path: Path) -> None:
    more = ("--scheme", "paper", "--realtime", "--camera", "160x120", "--max-ticks", 60)
    found = run_json(near, taught_paper, tmp_path / "paper.json", *more)
    assert set(outcomes(found)) <= {"found", "collision", "timeout"}


@pytest.mark.long
def test_two_robots_find_victims_while_an_instance_is_killed(
    near: Path, taught: Path, tmp_path: Path
) -> None:
    own = {
        "robot": flags(world=near, camera_width=160, camera_height=120),
        **dict.fromkeys(("recognition", "policy"), flags(root=taught)),
    }
    services = ("router", "robot", "features", "recognition", "policy")
    scale = {"recognition": 2, "policy": 2}
    plan = StackPlan(
        services, "rescuebot", free_endpoint(), own, logs=tmp_path, robots=2, scale=scale
    )
    with (
        Stack(plan) as stack,
        closing(stack.settings.open_bus("watcher")) as bus,
        ThreadPoolExecutor(2) as pool,
    ):

        def run(robot: str) -> list[str]:
            out = tmp_path / f"{robot}.json"
            return outcomes(
                run_json(
                    near, taught / "model.smal", out, "--connect", plan.endpoint, "--robot", robot
                )
            )

        running = [pool.submit(run, robot) for robot in plan.fleet]
        with closing(bus.of_robot(plan.fleet[1])) as other:
            for service in ("recognition", "policy"):
                told = collected(other, topics.SNAPSHOTS[service])
                # What it recognizes with, and where the robot is: what has been heard here, the other one has as well.
                heard = lambda told=told, of=service: told and (of == "policy" or told[-1].state)  # noqa: E731
                eventually(lambda heard=heard: heard() or running[1].done())
                os.kill(other.call(service, "status", Nothing(), Status).pid, signal.SIGKILL)
        assert [one.result() for one in running] == [["found"], ["found"]]
