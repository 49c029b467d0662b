"""Other simulators as bodies: the example of CONTRIBUTING, and Gymnasium environments."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.base import Atom, Message, Velocity
from schemas.motion import TruePose
from schemas.rpc import ResetRequest
from services.cli.stack import free_endpoint
from services.kit.node import ServiceError
from services.robot.body import Kinematics, OdometryReading
from services.robot.gymnasium_body import GymnasiumBody
from services.robot.lockstep import SimulatorsTask, SteppedBody, SteppedEpisode, StepView
from tests.command import run_smal
from tests.services.waiting import eventually

MANUAL = Path(__file__).parents[3] / "CONTRIBUTING.md"
ACTIONS: dict[Atom, int] = {"stop": 0, "forward": 1, "backward": 2, "left": 3, "right": 4}


def example(folder: Path) -> Path:
    (code,) = re.findall(r"```python\n(.*?)```", MANUAL.read_text(), re.DOTALL)
    path = folder / "painted_room.py"
    path.write_text(code)
    return path


@pytest.fixture
def painted(tmp_path: Path) -> SteppedBody:
    spec = importlib.util.spec_from_file_location("painted_room", example(tmp_path))
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    body: SteppedBody = module.PaintedRoom()
    return body


def episode_of(body: SteppedBody, **request: object) -> SteppedEpisode[StepView]:
    asked = ResetRequest.model_validate({"seed": 1} | request)
    return SteppedEpisode(body, SimulatorsTask(), asked)


def test_example_body_moves_by_its_own_frame_time(painted: SteppedBody) -> None:
    episode = episode_of(painted)
    assert episode.view.pose is not None
    x, y, heading = episode.view.pose
    after = episode.step("forward").pose
    assert after is not None
    # 0.2 s at 0.5 m/s.
    assert after[:2] == pytest.approx((x + 0.1 * np.cos(heading), y + 0.1 * np.sin(heading)))


def test_example_body_ends_by_collision_and_goal(painted: SteppedBody) -> None:
    episode = episode_of(painted)
    while episode.outcome is None:
        episode.step("forward")
    assert episode.outcome == "collision"
    episode = episode_of(painted)
    while episode.outcome is None:
        x, y, heading = episode.view.pose or (0.0, 0.0, 0.0)
        off = np.angle(np.exp(1j * (np.arctan2(5.0 - y, 6.0 - x) - heading)))
        episode.step(Velocity(1.0, float(np.clip(3 * off, -1, 1))))
    assert episode.outcome == "found"


def test_example_body_draws_walls_that_move_with_it(painted: SteppedBody) -> None:
    episode = episode_of(painted)
    before = episode.view.image.astype(int)
    turned = episode.step("left").image.astype(int)
    assert before.shape == (120, 160, 3)
    # 0.16 rad to the left move the middle of the image to the right.
    shift = min(
        range(-40, 41),
        key=lambda k: np.abs(turned[60, 45:115] - before[60, 45 - k : 115 - k]).sum(),
    )
    assert 10 <= shift <= 25


def test_view_publishes_a_heading_of_many_turns() -> None:
    view = StepView(np.zeros((24, 32, 3), dtype=np.uint8), pose=(1.0, 2.0, 7 * np.pi + 0.1))
    header = Message(robot="r", episode="e", tick=0, stamp_ns=0)
    (pose,) = view.more(header)
    assert isinstance(pose, TruePose)
    assert pose.heading_rad == pytest.approx(0.1 - np.pi)


@pytest.mark.parametrize(
    "wish",
    [
        {"obstacles": 3}, {"people": 1}, {"blocked": True}, {"victim": "absent"},
        {"kidnap_tick": 5}, {"start": "anywhere"}, {"world": "campus"}, {"variation": "dark"},
    ],
)  # fmt: skip
def test_body_refuses_conditions_that_it_lacks(painted: SteppedBody, wish: dict[str, Any]) -> None:
    ((name, value),) = wish.items()
    with pytest.raises(ServiceError, match=f"painted-room: {name} {value} is unsupported"):
        episode_of(painted, **wish)
    painted.conditions = (name,)
    episode_of(painted, **wish)


def test_stepped_body_moves_in_real_time_too(painted: SteppedBody) -> None:
    painted.begin(ResetRequest(seed=1, mode="realtime"))
    start = painted.look(0).pose
    painted.drive(Velocity(1.0, 0.0))
    moved = painted.look(1).pose
    painted.stand()
    assert painted.look(2).pose == moved != start


def fails(*_: object) -> None:
    raise RuntimeError("the physics\nexploded")


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ({"advance": fails}, "advance failed: RuntimeError: the physics exploded (test_other_"),
        ({"observe": fails}, "observe failed: RuntimeError: the physics exploded (test_other_"),
        ({"start": fails}, "start failed: RuntimeError: the physics exploded (test_other_"),
        ({"start": lambda _: None}, "start must return a Beginning, got None"),
        ({"frame_s": 0.0}, "frame_s must be greater than 0, got 0.0"),
        ({"kinematics": None}, "kinematics not found; set it to a Kinematics"),
    ],
)
def test_body_reports_a_fault_in_one_line(
    painted: SteppedBody, fault: dict[str, Any], line: str
) -> None:
    vars(painted).update(fault)
    with pytest.raises(ServiceError, match=f"^painted-room: {re.escape(line)}") as raised:
        episode_of(painted).step("forward")
    assert "\n" not in str(raised.value)


IMAGE = np.zeros((24, 32, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("view", "line"),
    [
        (None, "observe must return a StepView, got None"),
        (StepView(IMAGE[..., 0]), "uint8 (24, 32) is not an RGB image; give uint8 (height, width"),
        (StepView(IMAGE[:0]), "uint8 (0, 32, 3) is not an RGB image"),
        (StepView(IMAGE / 255.0), "float64 (24, 32, 3) is not an RGB image"),  # type: ignore[arg-type]
        (StepView(None), "the image must be an array, got None"),  # type: ignore[arg-type]
        (StepView(IMAGE, pose=(np.nan, 0.0, 0.0)), "the pose must be three finite numbers, x, y"),
        (StepView(IMAGE, pose=(1.0, 2.0)), "the pose must be three finite numbers, x, y in metres"),  # type: ignore[arg-type]
        (
            StepView(IMAGE, odometry=OdometryReading(np.inf, 0.0, 0.0, 0.0, 0.0)),
            "the odometry must be an OdometryReading of finite numbers",
        ),
    ],
)
def test_body_rejects_an_invalid_view(
    painted: SteppedBody, monkeypatch: pytest.MonkeyPatch, view: StepView, line: str
) -> None:
    monkeypatch.setattr(painted, "observe", lambda: view)
    with pytest.raises(ServiceError, match=f"^painted-room: {re.escape(line)}"):
        episode_of(painted)


@contextmanager
def stack(folder: Path) -> Iterator[str]:
    """Run `smal up` with the example in a folder; yield its address."""
    fails = "if Path('fails').exists(): raise OSError('out of paint')"
    path = example(folder)
    path.write_text(
        "from pathlib import Path\n"
        + re.sub(r"(def advance.*\n)", rf"\1        {fails}\n", path.read_text())
    )
    endpoint = free_endpoint()
    command = [
        "-c",
        "from services.cli.main import main; main()",
        "up",
        "--robot-module",
        "painted_room",
    ]
    options = ["--router", endpoint, "--console", "none", "--root", str(folder)]
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, *command, *options], cwd=folder, stderr=log, stdout=log,
            env=os.environ | {"PYTHONPATH": str(MANUAL.parent)},
        )  # fmt: skip
        try:
            log_of = (folder / "log").read_text
            eventually(lambda: "ready: " in log_of() or process.poll() is not None)
            assert process.poll() is None, log_of()
            yield endpoint
        finally:
            process.terminate()
            process.wait()


@pytest.mark.long
@pytest.mark.system
def test_stack_drives_and_records_the_example(tmp_path: Path) -> None:
    with stack(tmp_path) as endpoint:
        drives = tmp_path / "drives"
        done = run_smal("demonstrate", "--connect", endpoint, "--out", drives, "--seed", 1)
        assert done.returncode == 0, done.stderr
        learned = run_smal(
            "learn", drives, "--out", tmp_path / "m.smal", "--json", tmp_path / "l.json"
        )
        assert learned.returncode == 0, learned.stderr
        model = ("--model", tmp_path / "m.smal", "--connect", endpoint, "--episodes", 1)
        refused = run_smal("run", *model, "--obstacles", 3)
        assert (
            "painted-room: obstacles 3 is unsupported by this body; leave it out" in refused.stderr
        )
        assert refused.returncode == 1
        found = run_smal("run", *model, "--json", tmp_path / "runs.json")
        assert found.returncode == 0, found.stderr
        (tmp_path / "fails").touch()
        failed = run_smal("demonstrate", "--connect", endpoint, "--out", tmp_path / "failed")
        assert failed.returncode == 1
        line = failed.stderr.splitlines()[-1]
        assert "painted-room: advance failed: OSError: out of paint (painted_room.py, line" in line
    (run,) = json.loads((tmp_path / "runs.json").read_text())["episodes"]
    assert run["outcome"] == "found"


class Corridor(gymnasium.Env[dict[str, NDArray[np.uint8]], np.int64]):
    """A corridor of ten squares; the goal is at the end, and the wall behind the start."""

    observation_space = gymnasium.spaces.Dict()
    action_space = gymnasium.spaces.Discrete(5)

    def __init__(self) -> None:
        self.at = 0
        self.actions: list[int] = []

    def _seen(self) -> tuple[dict[str, NDArray[np.uint8]], dict[str, Any]]:
        image = np.full((24, 32, 3), 10 * self.at % 256, dtype=np.uint8)
        return {"camera": image}, {"pose": (float(self.at), 0.0, 0.0)}

    def reset(self, **_: Any) -> tuple[dict[str, NDArray[np.uint8]], dict[str, Any]]:
        self.at = 0
        return self._seen()

    def step(self, action: np.int64) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(int(action))
        self.at += {1: 1, 2: -1}.get(int(action), 0)
        image, info = self._seen()
        return image, float(self.at >= 10), not 0 <= self.at < 10, False, info


def test_gymnasium_environment_is_a_body() -> None:
    body = GymnasiumBody(Corridor(), ACTIONS, Kinematics(1.0, 1.0), frame_s=0.5, image="camera")
    episode = episode_of(body)
    while episode.outcome is None:
        episode.step("forward")
    assert (episode.outcome, episode.tick, episode.view.pose) == ("found", 10, (10.0, 0.0, 0.0))
    assert episode.view.image.mean() == 100
    episode = episode_of(body)
    episode.step("backward")
    assert episode.outcome == "collision"


class Guided(Corridor):
    """A corridor that reports its route and odometry, and goes on after the goal."""

    def reset(self, **how: Any) -> tuple[dict[str, NDArray[np.uint8]], dict[str, Any]]:
        self.options = how["options"]
        image, info = super().reset()
        return image, self._more(info) | {"route": np.array([[0, 0], [10, 0]]), "found_m": 2.0}

    def step(self, action: np.int64) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        image, _, _, _, info = super().step(action)
        return image, 0.0, False, False, self._more(info)

    def _more(self, info: dict[str, Any]) -> dict[str, Any]:
        return info | {"odometry": (2.0 * self.at, 0.0, 0.0), "is_success": self.at >= 8}


def test_gymnasium_body_takes_odometry_route_and_options() -> None:
    env = Guided()
    body = GymnasiumBody(env, ACTIONS, Kinematics(1.0, 1.0), frame_s=0.5, image="camera")
    episode_of(body)
    assert env.options is None
    body.conditions = ("start", "kidnap_tick")
    episode = episode_of(body, start="anywhere", kidnap_tick=3, until_said=True)
    assert env.options == {"purpose": "run", "start": "anywhere", "kidnap_tick": 3}
    assert episode.beginning.route == ((0.0, 0.0), (10.0, 0.0))
    assert episode.beginning.found_m == 2.0
    views = [episode.step("forward") for _ in range(9)]
    assert views[0].odometry == (2.0, 0.0, 0.0, 4.0, 0.0)
    assert [view.reached for view in views] == [False] * 7 + [True, True]
    assert views[-1].pose == (9.0, 0.0, 0.0)


def test_gymnasium_body_spreads_small_turns() -> None:
    corridor = Corridor()
    body = GymnasiumBody(corridor, ACTIONS, Kinematics(1.0, 1.0), image="camera")
    episode = episode_of(body)
    for _ in range(12):
        episode.step(Velocity(0.0, 0.25))
    assert corridor.actions.count(ACTIONS["left"]) == 3
    corridor.actions.clear()
    episode.step("stop")
    assert corridor.actions == [ACTIONS["stop"]]


def test_gymnasium_body_rejects_other_observations() -> None:
    body = GymnasiumBody(gymnasium.make("CartPole-v1"), ACTIONS, Kinematics(1.0, 1.0))
    with pytest.raises(ServiceError, match=r"CartPole-v1: float32 \(4,\) is not an RGB image"):
        episode_of(body)
