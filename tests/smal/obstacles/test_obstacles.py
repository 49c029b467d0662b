"""Free ground from a depth camera, and ways round obstacles."""

import math
import tracemalloc
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smal.movement import Atom
from smal.obstacles.avoidance import Turns, best_turn, detour_turn, hit_m
from smal.obstacles.clearance import Surroundings, most_speed, scan
from tests.smal.depth_world import MOUNT, MOVEMENTS, Box, depth, moved, touches

HERE = (0.0, 0.0, 0.0)
WALL: Box = (4.0, -5.0, 4.5, 5.0, 2.0)
OFF_M = MOUNT.radius_m + 0.1  # Distance of the robot's middle from an obstacle.


def around(*boxes: Box) -> Surroundings:
    made = Surroundings(MOUNT.radius_m)
    assert made.observe(HERE, depth(boxes, HERE), MOUNT)
    return made


@pytest.mark.parametrize("pitch_deg", [-2.0, 0.0, 2.0])
def test_ground_is_free_and_wall_is_placed_when_the_camera_nods(pitch_deg: float) -> None:
    seen = scan(depth([WALL], HERE, math.radians(pitch_deg)), MOUNT)
    middle = np.abs(seen.across) < 0.4
    np.testing.assert_allclose(seen.hit_m[middle], 4.0 - MOUNT.ahead_m, atol=0.15)
    np.testing.assert_allclose(seen.free_m[middle], 4.0 - MOUNT.ahead_m, atol=0.35)
    assert scan(depth([], HERE, math.radians(pitch_deg)), MOUNT).hit_m.min() == math.inf


@pytest.mark.parametrize("high", [0.2, 0.5, 2.0])
def test_way_is_free_up_to_an_obstacle(high: float) -> None:
    assert around((3.0, -0.2, 3.5, 0.2, high)).free_m(ahead=True) == pytest.approx(
        3.0 - OFF_M, abs=0.15
    )
    assert around((3.0, 0.6, 3.5, 1.0, high)).free_m(ahead=True) > 3.5  # beside the way
    # Only what is seen above 1.5 m of it hangs above the robot.
    lifted = np.where(
        np.arange(60)[:, None] < 60 / 2 - 0.5 * MOUNT.focal * 80 / 2.65, depth([WALL], HERE), 0.0
    )
    made = Surroundings(MOUNT.radius_m)
    assert made.observe(
        HERE, np.where(lifted > 0, lifted, depth([], HERE)).astype(np.float32), MOUNT
    )
    assert made.free_m(ahead=True) > 3.5


def test_unseen_ground_is_not_free() -> None:
    made = Surroundings(MOUNT.radius_m)
    assert not made.observe(HERE, np.zeros((60, 80), dtype=np.float32), MOUNT)
    assert not made.observe(HERE, None, MOUNT)
    assert made.free_m(ahead=True) < 0.7
    # A hole in the picture of the ground ahead is as little known as what lies behind it.
    holed = depth([], HERE)
    holed[:48, 30:50] = 0.0
    assert made.observe(HERE, holed, MOUNT)
    assert made.free_m(ahead=True) < 3.0
    assert made.free_m(ahead=False) == 0.0  # nobody has looked behind


def test_obstacle_out_of_view_is_kept_until_it_is_seen_gone() -> None:
    box: Box = (1.7, -0.2, 2.1, 0.2, 0.3)
    made = around(box)
    for k in range(1, 8):  # so near that the camera sees over it
        pose = (0.1 * k, 0.0, 0.0)
        made.observe(pose, depth([box], pose), MOUNT)
    assert made.free_m(ahead=True) == pytest.approx(1.7 - 0.7 - OFF_M, abs=0.15)
    assert made.free_m(ahead=False) > 0.2  # where it has come from
    made = around((3.0, -0.2, 3.3, 0.2, 1.7))
    for _ in range(6):
        made.observe(HERE, depth([], HERE), MOUNT)
    assert made.free_m(ahead=True) > 3.5


def test_moving_obstacle_out_of_view_is_forgotten() -> None:
    box = (2.5, -0.2, 2.9, 0.2, 1.7)
    aside = (0.0, 0.0, math.radians(80.0))
    for before, known in ([], False), ([box], True):
        made = Surroundings(MOUNT.radius_m)
        for boxes in [before] * 4 + [[box]] * 3:
            made.observe(HERE, depth(boxes, HERE), MOUNT)
        for _ in range(40):
            made.observe(aside, depth([], aside), MOUNT)
        assert bool(made.occupied[made.cells(np.array([0.4, -2.5]))]) == known


def test_robot_keeps_off_walkers_and_passes_standing_things() -> None:
    def aside_at(y_m: float) -> Box:
        return 2.6, y_m, 3.0, y_m + 0.4, 1.7

    # at 1 m/s, towards the way
    made = around()
    walks = [aside_at(1.8 - 0.1 * tick) for tick in range(10)]
    for box in walks:
        made.observe(HERE, depth([box], HERE), MOUNT)
    assert made.moving.any()
    assert made.free_m(ahead=True) < 1.6  # half a second of a person's from there
    for _ in range(20):  # it stands
        made.observe(HERE, depth([walks[-1]], HERE), MOUNT)
    assert not made.moving.any()
    assert made.free_m(ahead=True) > 3.5


LYING: Box = (8.0, -0.3, 9.7, 0.3, 0.28)


@pytest.mark.parametrize("step_m", [0.1, 0.2])
def test_lying_person_has_not_come_when_it_comes_into_view(step_m: float) -> None:
    made = Surroundings(MOUNT.radius_m)
    for x_m in np.arange(0.0, 6.5, step_m):
        pose = (x_m, 0.0, 0.0)
        made.observe(pose, depth([LYING], pose, shape=(240, 320)), MOUNT)
        assert not made.is_new(0.0)
    assert made.free_m(ahead=True) < 2.0


def test_lying_person_has_come_when_the_place_was_seen_free() -> None:
    made = Surroundings(MOUNT.radius_m)
    pose = (6.0, 0.0, 0.0)
    for boxes in [[]] * 5 + [[LYING]] * 5:
        made.observe(pose, depth(boxes, pose, shape=(240, 320)), MOUNT)
    assert made.is_new(0.0)


@pytest.mark.parametrize("seed", range(3))
def test_standing_things_do_not_move_when_the_robot_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    made = Surroundings(MOUNT.radius_m)
    pose = (0.0, 0.0, 0.3)
    boxes: list[Box] = [
        (3.0, 0.7, 3.5, 1.2, 1.0),
        (4.5, -1.6, 5.0, -1.0, 0.6),
        (7.0, -6.0, 7.4, 6.0, 2.0),
    ]
    for tick in range(30):
        measured = depth(boxes, pose) * rng.normal(1.0, 0.01, (60, 80))
        made.observe(pose, measured.astype(np.float32), MOUNT)
        ahead, left = made.in_robot_axes(0.0)
        assert np.hypot(ahead, left)[made.moving].min(initial=9.0) > 1.5
        pose = moved(pose, Atom.RIGHT if tick < 4 else Atom.FORWARD, 0.8)


@given(st.floats(0.0, 10.0), st.floats(0.2, 3.0), st.floats(0.0, 0.5), st.floats(0.05, 0.3))
def test_robot_stands_before_an_obstacle(
    free_m: float, speed_m_s: float, braking_s: float, wait_s: float
) -> None:
    share = most_speed(free_m, speed_m_s, braking_s, wait_s)
    assert 0.0 <= share <= 1.0
    assert share * speed_m_s * wait_s + share**2 * speed_m_s * braking_s / 2 <= free_m + 1e-9
    assert most_speed(free_m + 1.0, speed_m_s, braking_s, wait_s) >= share
    assert most_speed(100.0, speed_m_s, braking_s, wait_s) == 1.0
    assert most_speed(-free_m, speed_m_s, braking_s, wait_s) == 0.0


KNOWN_M = 4.0  # Aside of the way.
END_M = 16.0
TURN_RAD = float(MOVEMENTS[Atom.LEFT, 1])
TURNS = Turns(TURN_RAD, float(MOVEMENTS[Atom.FORWARD, 0]), KNOWN_M)


def drive(boxes: Sequence[Box], ticks: int = 400) -> tuple[np.ndarray, int]:
    """Follow the way, y = 0, and go round boxes; return the poses and how often nothing led round."""
    around = Surroundings(MOUNT.radius_m)
    pose = (0.0, 0.0, 0.0)
    blocked = 0
    poses = [pose]
    for _ in range(ticks):
        around.observe(pose, depth(boxes, pose), MOUNT)
        x = np.arange(pose[0] + 1.4, min(pose[0] + 7.8, END_M + 1.5), 0.35)
        c = math.cos(pose[2])
        s = math.sin(pose[2])
        way = np.stack([x - pose[0], np.full(x.size, -pose[1])], axis=1) @ np.array(
            [[c, -s], [s, c]]
        )
        turn: float | None = math.atan2(way[0, 1], way[0, 0])
        if hit_m(around, way, around.body_m) < math.inf:
            turn = best_turn(around, way, TURNS)
        if turn is None:
            blocked += 1
            continue
        pose = moved(
            pose, Atom.FORWARD if abs(turn) < TURN_RAD else Atom.LEFT if turn > 0 else Atom.RIGHT
        )
        assert not touches(boxes, pose)
        poses.append(pose)
        if pose[0] > END_M:
            break
    return np.array(poses), blocked


@pytest.mark.parametrize(
    "boxes",
    [
        [],
        [(6.0, -0.4, 6.8, 0.4, 0.9)],
        [(6.0, -1.6, 6.3, 0.2, 1.0)],
        [(6.0, -0.9, 10.2, 0.9, 1.5)],
        [(5.0, -0.2, 5.5, 1.5, 1.0), (9.0, -1.5, 9.5, 0.2, 1.0)],
    ],
    ids=["nothing", "a box", "to the left", "a car", "two"],
)
def test_it_goes_round_and_comes_back(boxes: list[Box]) -> None:
    poses, blocked = drive(boxes)
    assert poses[-1, 0] > END_M
    assert blocked == 0
    assert np.abs(poses[:, 1]).max() < 2.4
    assert abs(poses[-1, 1]) < 0.2
    assert len(poses) < 160  # 80 frames straight on


@pytest.mark.parametrize("heading", [2.0, -2.6])
def test_robot_turns_back_when_it_faces_away_from_an_obstacle(heading: float) -> None:
    box: Box = (2.2, -0.3, 2.8, 0.5, 1.0)
    made = around(box)
    pose = (0.0, 0.0, heading)
    made.observe(pose, depth([box], pose), MOUNT)
    c = math.cos(heading)
    s = math.sin(heading)
    way = np.stack([np.arange(1.4, 7.8, 0.35), np.zeros(19)], axis=1) @ np.array([[c, -s], [s, c]])
    turn = best_turn(made, way, TURNS)
    assert turn is not None
    assert abs(heading + turn) < 0.8


def test_robot_waits_when_no_way_leads_round() -> None:
    poses, blocked = drive([(6.0, -8.0, 6.3, 8.0, 1.0)], ticks=200)
    assert blocked > 100
    assert poses[-1, 0] < 6.0


@pytest.mark.parametrize(("evades", "follows"), [(False, True), (True, False)])
def test_taught_way_is_free_when_it_is_narrow(evades: bool, follows: bool) -> None:
    """The obstacle stands 4 cm beside the robot: less than the margin of a way around."""
    aside_m = MOUNT.radius_m + 0.04
    made = around((2.5, aside_m, 3.0, 3.0, 1.0))
    way = np.stack([np.arange(1.4, 7.8, 0.35), np.zeros(19)], axis=1)
    turn = detour_turn(made, way, TURNS, 0.01, evades)
    assert (turn == 0.01) == follows


@pytest.mark.parametrize("far_m", [1e4, 1e6])
def test_a_way_costs_no_memory_when_it_lies_far_away(far_m: float) -> None:
    way = np.stack([far_m + np.arange(0.0, 7.0, 0.35), np.full(20, -far_m)], axis=1)
    tracemalloc.start()
    assert hit_m(around(), way, MOUNT.radius_m) == math.inf
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 2_000_000


@pytest.mark.parametrize("shape", [(1, 1), (1, 80), (2, 80), (60, 1)])
def test_image_of_few_pixels_shows_nothing(shape: tuple[int, int]) -> None:
    assert not Surroundings(MOUNT.radius_m).observe(HERE, np.ones(shape, dtype=np.float32), MOUNT)
