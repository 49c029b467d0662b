"""The guard stops a robot before obstacles and where its depth camera shows nothing."""

import math
import threading
from collections.abc import Callable

import numpy as np
import pytest

from schemas.base import KEYS, STANDING, Atom, Velocity
from services.robot.body import Kinematics
from services.robot.gate import INSISTED, Applied, CommandGate
from services.robot.guard import MAX_LOOK_S, Guard
from smal.movement import Atom as Key
from tests.services.robot.gating import command
from tests.smal.depth_world import MOUNT, SPEED_M_S, Box, depth, moved, touches

WALL: Box = (8.0, -6.0, 8.4, 6.0, 2.0)


Pose = tuple[float, float, float]


def guard(braking_s: float = 0.22) -> Guard:
    return Guard(MOUNT, Kinematics(SPEED_M_S, math.pi / 4), braking_s)


def noisy(boxes: list[Box], pose: Pose, rng: np.random.Generator) -> np.ndarray:
    """Measure with the noise of a camera: no two images are the same."""
    return (depth(boxes, pose) * rng.normal(1.0, 0.005, (60, 80))).astype(np.float32)


@pytest.mark.parametrize("bearing", [0.0, 0.3, -0.5])
@pytest.mark.parametrize("high", [0.3, 2.0])
def test_guard_stops_the_robot_before_a_wall(bearing: float, high: float) -> None:
    wall: Box = (*WALL[:4], high)
    rng = np.random.default_rng(0)
    gate = CommandGate(first_stop=1)
    pose = (0.0, 0.0, bearing)
    gate.guard = guard(braking_s=0.0)
    assert gate.arm(1, "") is None
    gate.begin("e", "teleop")
    reasons = set()
    for tick in range(120):
        now_s = tick / 10
        gate.captured(tick, now_s)
        gate.guard.look(noisy([wall], pose, rng), pose, now_s)
        assert gate.offer(command(tick, source="teleop"), now_s) is None
        applied = gate.applied(now_s)
        reasons.add(applied.reason)
        pose = moved(pose, Key[applied.velocity.atom(still=0.0).upper()], applied.velocity.linear)
        assert not touches([wall], pose)
    assert reasons == {"command", "obstacle"}
    assert applied.velocity == STANDING
    assert touches(
        [wall], (pose[0] + 0.6, pose[1], 0.0)
    )  # it stands at the wall, and not far before it


@pytest.mark.parametrize("shown", [None, np.zeros((60, 80), dtype=np.float32)])
def test_way_is_closed_when_the_depth_camera_shows_nothing(
    shown: np.ndarray | None,
) -> None:
    here = (0.0, 0.0, 0.0)
    ways = ("forward", "backward")
    made = guard()
    made.look(shown, here, 0.0)
    assert [made.share(KEYS[atom], 0.0) for atom in ways] == [0.0, 0.0]
    made.look(depth([], here), here, 1.0)
    assert made.share(KEYS["forward"], 1.0) == 1.0
    made.look(shown, here, 1.2)
    assert made.share(KEYS["forward"], 1.0 + MAX_LOOK_S) == 1.0
    assert made.share(KEYS["forward"], 1.01 + MAX_LOOK_S) == 0.0
    turns: tuple[Atom, ...] = ("left", "right", "stop")
    assert {made.share(KEYS[atom], 9.0) for atom in turns} == {1.0}


#: Each makes what is delivered of the honest images so far.
LIES: dict[str, Callable[[list[np.ndarray]], np.ndarray]] = {
    "saturated": lambda honest: np.full_like(honest[-1], 65.0),
    "far plane": lambda honest: np.full_like(honest[-1], 10.0),
    "far plane beyond 2.5 m": lambda honest: np.where(
        honest[-1] < 2.5, honest[-1], np.float32(10.0)
    ),
    "frozen": lambda honest: honest[0],
    "0.5 s late": lambda honest: honest[max(len(honest) - 6, 0)],
    "ten times": lambda honest: 10.0 * honest[-1],
    "half NaN": lambda honest: np.where(
        np.indices(honest[-1].shape).sum(axis=0) % 2, np.float32(np.nan), honest[-1]
    ),
    "upside down": lambda honest: honest[-1][::-1],
}


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("since", [0, 8])
def test_guard_stands_before_a_wall_when_depth_lies(lie: str, since: int) -> None:
    """A base with mass drives by what the guard grants, a share every 20 ms; a wall stands 8 m ahead, a post beside."""
    boxes: list[Box] = [WALL, (5.0, -3.0, 5.3, -2.7, 1.5)]
    rng = np.random.default_rng(1)
    made = guard()
    pose = (0.0, 0.0, 0.0)
    speed_m_s = 0.0
    honest = list[np.ndarray]()
    for tick in range(100):
        measured = noisy(boxes, pose, rng)
        honest = [*honest, measured] if tick >= since else [measured]
        made.look(LIES[lie](honest) if tick >= since else measured, pose, tick / 10)
        for step in range(5):
            asked_m_s = made.share(KEYS["forward"], tick / 10 + 0.02 * step) * SPEED_M_S
            speed_m_s += max(-9.0 * 0.02, min(asked_m_s - speed_m_s, 4.0 * 0.02))
            pose = (pose[0] + speed_m_s * 0.02, 0.0, 0.0)
        assert not touches(boxes, pose)
    assert speed_m_s == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("height", [0.6, 1.5])
def test_guard_is_blind_when_its_mount_has_another_height(height: float) -> None:
    made = Guard(MOUNT._replace(height_m=height), Kinematics(SPEED_M_S, math.pi / 4), 0.22)
    made.look(depth([], (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 0.0)
    assert made.share(KEYS["forward"], 0.0) == 0.0


def test_gate_stops_at_once_while_its_guard_is_busy() -> None:
    gate = CommandGate(first_stop=1)
    busy = threading.Event()
    release = threading.Event()

    class Slow(Guard):
        def share(self, velocity: Velocity, now_s: float) -> float:
            busy.set()
            assert release.wait(30.0)
            return super().share(velocity, now_s)

    gate.guard = Slow(MOUNT, Kinematics(SPEED_M_S, math.pi / 4), 0.22)
    gate.guard.look(depth([], (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 0.0)
    assert gate.arm(1, "") is None
    gate.begin("e", "teleop")
    gate.captured(0, 0.0)
    assert gate.offer(command(0, source="teleop"), 0.0) is None
    found: list[Applied] = []
    asks = threading.Thread(target=lambda: found.append(gate.applied(0.0)))
    asks.start()
    assert busy.wait(30.0)
    stops = threading.Thread(target=gate.stop)
    stops.start()
    stops.join(30.0)
    stopped = not stops.is_alive()
    release.set()
    asks.join(30.0)
    assert stopped
    assert found[0].velocity == STANDING


def test_driven_way_is_no_longer_free() -> None:
    here = (0.0, 0.0, 0.0)
    wall = (1.2, -6.0, 1.6, 6.0, 2.0)
    made = guard()
    made.look(depth([wall], here), here, 0.0)
    shares = [made.share(KEYS["forward"], 0.02 * k) for k in range(13)]
    assert shares[0] > shares[5] > shares[12]


@pytest.mark.parametrize(("source", "goes"), [("teleop", INSISTED), ("policy", 0.0)])
def test_only_an_insisting_person_goes_on_before_an_obstacle(source: str, goes: float) -> None:
    here = (0.0, 0.0, 0.0)
    wall = (0.55, -6.0, 1.6, 6.0, 2.0)
    gate = CommandGate(first_stop=1)
    gate.guard = guard()
    assert gate.arm(1, "") is None
    gate.begin("e", "policy" if source == "policy" else "teleop")
    for tick, insists in enumerate((False, True)):
        gate.captured(tick, tick / 10)
        gate.guard.look(depth([wall], here), here, tick / 10)
        asked = command(tick, source=source).model_copy(update={"insists": insists})
        assert gate.offer(asked, tick / 10) is None
        applied = gate.applied(tick / 10)
        assert applied.velocity == ((goes, 0.0) if insists else STANDING)
        assert applied.reason == ("insisted" if insists and goes else "obstacle")


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("angular", [0.3, 0.6, 1.0])
def test_guard_stops_the_robot_in_a_bend(side: float, angular: float) -> None:
    made = guard()
    pose = (0.0, 0.0, 0.0)
    bend = (
        side * angular * (math.pi / 4) / SPEED_M_S
    )  # straight on is free: the box stands on the circle, 2.5 m along
    x = math.sin(2.5 * abs(bend)) / abs(bend)
    y = (1.0 - math.cos(2.5 * abs(bend))) / bend
    box: Box = (x - 0.2, y - 0.2, x + 0.2, y + 0.2, 0.5)
    driven_m = 0.0
    asked = Velocity(1.0, side * angular)
    for tick in range(60):
        made.look(depth([box], pose), pose, tick / 10)
        step_m = made.share(asked, tick / 10) * SPEED_M_S / 10
        turned = pose[2] + bend * step_m
        pose = (pose[0] + step_m * math.cos(turned), pose[1] + step_m * math.sin(turned), turned)
        driven_m += step_m
        assert not touches([box], pose)
    assert step_m == 0.0
    assert driven_m > 1.0
    made.look(depth([box], (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 7.0)
    assert made.share(Velocity(1.0, -side * angular), 7.0) >= 0.9  # away from it
