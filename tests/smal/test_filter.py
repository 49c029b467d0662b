"""The filter follows a robot through a painted room, finds it, and knows when it is lost."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.camera import TURNS_DEG
from smal.features import extract
from smal.files.packed import unit
from smal.filter import Belief, Filter, SeenDirections
from smal.map import VisualMap
from smal.movement import BY_ATOMS, STILL, Movement, placed
from smal.particles import Particles
from smal.planning.config import PLANNER_CONFIG
from tests.smal.synthetic_world import (
    COLOR,
    COLUMNS,
    ROWS,
    Drive,
    Room,
    drive,
    from_beside,
    usual_map,
)

ROOM = Room()


def poses_of(belief: Belief, visual_map: VisualMap) -> np.ndarray:
    """Return the poses of particles in the axes of the drive, with the direction as a unit vector, (4, p)."""
    x, y, heading = visual_map.key_poses[belief.keyframes].T
    ahead, left, turned = belief.offsets.T
    cos = np.cos(heading)
    sin = np.sin(heading)
    points = [x + cos * ahead - sin * left, y + sin * ahead + cos * left]
    return np.stack([*points, np.cos(heading + turned), np.sin(heading + turned)])


def off(belief: Belief, pose: np.ndarray) -> tuple[float, float]:
    """Return how far the belief is from the truth, metres and degrees."""
    x, y, cos, sin = poses_of(belief, usual_map()[0]) @ belief.weights
    turn = math.remainder(math.atan2(sin, cos) - pose[2], math.tau)
    return math.hypot(x - pose[0], y - pose[1]), abs(math.degrees(turn))


def follow(seen: Drive, found: Filter | None = None, room: Room = ROOM) -> list[Belief]:
    """Show the filter a drive."""
    found = found or Filter(*usual_map())
    return [
        found.observe(extract(room.look(pose), COLOR), movement)
        for pose, movement in zip(seen.poses, [STILL, *seen.movements()], strict=True)
    ]


def beside(one: Drive, left: float, turn_deg: float) -> Drive:
    """Move a whole drive to the left, and turn it about its start."""
    start = from_beside(tuple(one.poses[0]), 0.0, left, 0.0)[:2]
    turn = math.radians(turn_deg)
    about = one.poses[:, :2] - one.poses[0, :2]
    turned = about @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return Drive(np.column_stack([turned + start, one.poses[:, 2] + turn]), one.atoms)


def way_of(one: Drive) -> float:
    return float(sum(movement.ahead for movement in one.movements()))


def same(one: Belief, other: Belief) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("keyframes", "offsets", "weights", "lost", "cosine", "tracked")
    )


@pytest.mark.parametrize(("rate_hz", "speed"), [(5.0, 1.0), (20.0, 1.0), (10.0, 2.0)])
def test_it_follows_the_taught_way_at_any_rate_and_speed(rate_hz: float, speed: float) -> None:
    seen = drive(way=((2.5, 90.0), (1.0, 0.0)), rate_hz=rate_hz, speed=speed)
    beliefs = follow(seen)
    # It has settled within a correlation length.
    settled = round(0.7 / 0.5 / speed * rate_hz)
    errors = np.array([off(*pair) for pair in zip(beliefs, seen.poses, strict=True)])[settled:]
    assert errors[:, 0].max() < 0.1
    assert errors[:, 1].max() < 2.0
    assert max(belief.lost for belief in beliefs[settled:]) < 0.05
    assert beliefs[-1].tracked == pytest.approx(way_of(seen), rel=0.01)


@pytest.mark.parametrize(("factor", "most_m", "most_deg"), [(0.5, 0.3, 6.0), (2.0, 0.35, 5.0)])
def test_filter_follows_a_bend_when_atoms_report_another_speed(
    factor: float, most_m: float, most_deg: float
) -> None:
    seen = drive(way=((2.5, 90.0), (1.0, 0.0)), rate_hz=20.0)
    features = [extract(ROOM.look(pose), COLOR) for pose in seen.poses]
    errors = []
    for seed in range(4):
        found = Filter(*usual_map(), seed=seed)
        beliefs = [found.observe(features[0])]
        for raw, movement in zip(features[1:], seen.movements(), strict=True):
            reported = Movement(movement.ahead / factor, movement.turn_rad / factor)
            beliefs.append(found.observe(raw, reported, BY_ATOMS))
        assert not beliefs[-1].is_lost
        errors += [off(*one) for one in zip(beliefs[21:], seen.poses[21:], strict=True)]
    way_m, turn_deg = np.mean(errors, axis=0)
    assert way_m < most_m
    assert turn_deg < most_deg


@pytest.mark.parametrize(
    ("left", "turn_deg", "seed"),
    [(0.3, -10.0, 0), (-0.3, 10.0, 1), (0.3, 10.0, 2), (-0.3, -10.0, 3)],
)
def test_it_follows_a_drive_that_starts_aside_and_turned(
    left: float, turn_deg: float, seed: int
) -> None:
    seen = beside(drive(way=((1.7, 0.0),)), left * usual_map()[0].correlation_length, turn_deg)
    beliefs = follow(seen, Filter(*usual_map(), seed))
    errors = np.array([off(*pair) for pair in zip(beliefs, seen.poses, strict=True)])[14:]
    assert errors[:, 0].max() < 0.2
    assert errors[:, 1].max() < 4.0
    assert beliefs[-1].lost < 0.1


def test_only_unseen_directions_are_new_when_the_robot_turns() -> None:
    visual_map, _ = usual_map()
    directions = SeenDirections(visual_map)
    assert directions.new() == 1.0

    def turned(step: float, count: int) -> float:
        new = 0.0
        for _ in range(count):
            directions.move(np.array([0.0, 0.0, step]))
            new += directions.new()
        return new

    once = turned(0.08, 10)
    assert 0.0 < once < 1.0
    assert turned(-0.08, 10) == 0.0
    assert turned(-0.08, 10) == pytest.approx(once)
    whole = once + once + turned(-0.08, 200)
    assert whole == pytest.approx(once * math.tau / 0.8, rel=0.02)
    directions.move(np.array([visual_map.correlation_length, 0.0, 0.0]))
    assert directions.new() > 0.3


def test_every_view_is_new_when_there_is_no_odometry() -> None:
    directions = SeenDirections(replace(usual_map()[0], odometry=False))
    for _ in range(3):
        assert directions.new() == 1.0
        directions.move(np.zeros(3))


@pytest.mark.parametrize("frames_before", [1, 20])
def test_a_robot_that_stands_still_does_not_become_surer(frames_before: int) -> None:
    visual_map = usual_map()[0]
    seen = drive(way=((1.5, 0.0),))
    found = Filter(*usual_map())
    before = follow(Drive(seen.poses[:frames_before], seen.atoms[:frames_before]), found)[-1]
    raw = extract(ROOM.look(seen.poses[frames_before - 1]), COLOR)
    for _ in range(50):
        after = found.observe(raw, STILL)
    # A particle may be seen from another keyframe, and stays where it is.
    np.testing.assert_allclose(poses_of(after, visual_map), poses_of(before, visual_map), atol=1e-9)
    np.testing.assert_allclose(after.weights, before.weights, atol=2e-4)
    assert after.lost == pytest.approx(before.lost, abs=1e-3)
    assert after.tracked == before.tracked


def test_noise_of_the_camera_is_no_new_view() -> None:
    rng = np.random.default_rng(1)
    found = Filter(*usual_map())
    before = follow(drive(way=((0.1, 0.0),)), found)[-1]
    image = ROOM.look(drive(way=((0.1, 0.0),)).poses[-1])
    for _ in range(100):
        noisy = np.clip(image + rng.normal(0.0, 5.0, image.shape), 0, 255).astype(np.uint8)
        after = found.observe(extract(noisy, COLOR), STILL)
    assert after.lost == pytest.approx(before.lost, abs=0.02)
    assert (
        np.bincount(after.keyframes, after.weights).max()
        < 1.2 * np.bincount(before.keyframes, before.weights).max()
    )


@pytest.mark.parametrize("to", [40, 110])
def test_a_robot_that_is_carried_with_still_wheels_notices(to: int) -> None:
    one = drive()
    found = Filter(*usual_map())
    follow(Drive(one.poses[:20], one.atoms[:20]), found)
    for pose in one.poses[to : to + 40 : 2]:
        belief = found.observe(extract(ROOM.look(pose), COLOR), STILL)
    old = belief.weights[
        np.hypot(*(poses_of(belief, usual_map()[0])[:2].T - one.poses[19, :2]).T) < 0.5
    ].sum()
    assert old * (1.0 - belief.lost) < 0.1


@settings(deadline=None)
@given(
    key=st.integers(0, 30),
    aside=st.floats(-1.0, 1.0),
    turn=st.integers(1, TURNS_DEG.size - 2),
    seed=st.integers(0, 2**16),
)
def test_the_likelihood_does_not_jump_between_the_virtual_views(
    key: int, aside: float, turn: int, seed: int
) -> None:
    visual_map = usual_map()[0]
    components = unit(
        np.random.default_rng(seed).standard_normal(visual_map.basis.shape[1], dtype=np.float32)
    )
    keys = np.full(2, key)
    offsets = np.array(
        [
            [0.0, aside * visual_map.aside, math.radians(TURNS_DEG[turn] + by)]
            for by in (-1e-6, 1e-6)
        ]
    )
    particles = Particles(visual_map, keys, placed(offsets, visual_map.key_poses[keys]))
    found, beyond = particles.interpolated(components)
    assert found[0] == pytest.approx(found[1], abs=1e-4)
    assert beyond[0] == pytest.approx(beyond[1], abs=1e-4)


@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize(("contrast", "frames"), [(0.0, 10), (3.0, 10), (70.0, 3)])
def test_hidden_frames_do_not_move_the_belief(moves: bool, contrast: float, frames: int) -> None:
    seen = drive(way=((2.2, 0.0),))
    found = Filter(*usual_map())
    follow(Drive(seen.poses[:20], seen.atoms[:20]), found)
    rng = np.random.default_rng(0)
    for number in range(20, 20 + frames):
        hidden = np.clip(rng.normal(128.0, contrast, (ROWS, COLUMNS, 3)), 0, 255).astype(np.uint8)
        movement = Movement.between(*seen.poses[number - 1 : number + 1]) if moves else STILL
        belief = found.observe(extract(hidden, COLOR), movement)
        metres, degrees = off(belief, seen.poses[number if moves else 19])
        assert metres < 0.5 * usual_map()[0].correlation_length
        assert degrees < 5.0
        assert belief.lost < 0.5


def test_a_blank_first_view_does_not_count() -> None:
    one = Filter(*usual_map())
    other = Filter(*usual_map())
    one.observe(extract(np.full_like(ROOM.look(drive().poses[0]), 128), COLOR))
    seen = drive().poses[40:42]
    beliefs = [
        [found.observe(extract(ROOM.look(pose), COLOR), STILL) for pose in seen][-1]
        for found in (one, other)
    ]
    assert beliefs[0].lost == pytest.approx(beliefs[1].lost, abs=0.05)


def arrives(start: int, found: Filter, lengths: float) -> None:
    """Show the way from a frame on; the belief has to be there within some correlation lengths, and to stay."""
    one = drive()
    seen = Drive(one.poses[start:], one.atoms[start:])
    beliefs = follow(seen, found)
    way = np.concatenate([[0.0], np.cumsum([abs(movement.ahead) for movement in seen.movements()])])
    after = np.flatnonzero(way >= lengths * usual_map()[0].correlation_length)
    assert after.size > 10
    for number in after:
        metres, degrees = off(beliefs[number], seen.poses[number])
        assert metres < 0.15
        assert degrees < 5.0
        assert beliefs[number].lost < 0.2


@pytest.mark.parametrize(("to", "lengths"), [(72, 3.0), (115, 2.0)])
def test_a_kidnapped_robot_is_found(to: int, lengths: float) -> None:
    found = Filter(*usual_map())
    before = follow(drive(way=((1.0, 0.0),)), found)[-1]
    assert before.tracked > 0.9
    arrives(to, found, lengths)
    # What was followed counts from when it was found again.
    belief = found.observe(extract(ROOM.look(drive().poses[-1]), COLOR), STILL)
    one = drive()
    assert belief.tracked < way_of(Drive(one.poses[to:], one.atoms[to:])) + 0.1


def at_home(found: Filter) -> None:
    """Show the way from its second metre on; within four correlation lengths it is not lost any more."""
    one = drive()
    back = follow(Drive(one.poses[20:80], one.atoms[20:80]), found)
    assert max(belief.lost for belief in back[50:]) < 0.3
    assert off(back[-1], one.poses[79])[0] < 0.2


def elsewhere(seed: int) -> tuple[list[float], Filter]:
    """Return what is lost over seven correlation lengths through another room."""
    one = drive()
    found = Filter(*usual_map())
    follow(Drive(one.poses[:20], one.atoms[:20]), found)
    far = drive((3.5, 4.0, 0.0), ((7.0 * usual_map()[0].correlation_length, 0.0),))
    return [belief.lost for belief in follow(far, found, Room(seed))], found


@pytest.mark.parametrize("turn_deg", [-90.0, 180.0])
def test_a_robot_that_drives_away_from_the_way_is_lost(turn_deg: float) -> None:
    away = (
        1.0 + 1.3 * usual_map()[0].config.elsewhere * usual_map()[0].correlation_length
    )  # It may first go back to the start.
    assert follow(drive(way=((1.0, 0.0), (0.0, turn_deg), (away, 0.0))))[-1].lost > 0.95


def test_robot_is_lost_in_another_room_and_found_again() -> None:
    rooms = [elsewhere(seed) for seed in range(1, 4)]
    assert max(lost[0] for lost, _ in rooms) < 0.2
    assert float(np.median([lost[-1] for lost, _ in rooms])) > 0.5
    at_home(rooms[0][1])


@settings(deadline=None, derandomize=True, max_examples=15)
@given(
    seed=st.integers(0, 2**16),
    steps=st.lists(st.tuples(st.floats(-2.0, 2.0), st.floats(-4.0, 4.0)), min_size=1, max_size=12),
)
def test_a_belief_is_made_of_probabilities(
    seed: int, steps: list[tuple[float, float, float]]
) -> None:
    rng = np.random.default_rng(seed)
    found = Filter(*usual_map(), seed)
    seen = [extract(ROOM.look(pose), COLOR) for pose in drive().poses[::40]]
    for ahead, turn in steps:
        raw = (
            seen[rng.integers(len(seen))]
            if rng.random() < 0.5
            else rng.standard_normal(COLOR.size) * 10.0 ** rng.integers(-3, 4)
        )
        belief = found.observe(raw.astype(np.float32), Movement(ahead, turn))
        assert belief.weights.sum() == pytest.approx(1.0)
        assert belief.weights.min() >= 0.0
        assert 0.0 <= belief.lost <= 1.0
        assert -1.0 <= belief.cosine <= 1.1
        assert np.isfinite(belief.offsets).all()
        assert belief.keyframes.min() >= 0
        assert belief.keyframes.max() < len(usual_map()[0].keyframes)


@pytest.mark.parametrize(
    ("raw", "movement"),
    [
        (np.ones(COLOR.size - 1), STILL),
        (np.ones(0), STILL),
        (np.array(1.0), STILL),
        (np.ones((2, COLOR.size)), STILL),
        (np.full(COLOR.size, math.nan), STILL),
        (np.where(np.arange(COLOR.size) == 7, math.inf, 1.0), STILL),
        (np.ones(COLOR.size), Movement(math.nan, 0.0)),
        (np.ones(COLOR.size), Movement(0.0, math.inf)),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_invalid_frame_is_refused_and_changes_nothing(
    raw: Any, movement: Movement, first: bool
) -> None:
    seen = drive(way=((0.2, 0.0),))
    one = Filter(*usual_map())
    other = Filter(*usual_map())
    if not first:
        follow(seen, one)
        follow(seen, other)
    with pytest.raises(ValueError, match=r"feature|movement"):
        one.observe(raw, movement)
    good = extract(ROOM.look(seen.poses[-1]), COLOR)
    assert same(one.observe(good, Movement(0.05, 0.0)), other.observe(good, Movement(0.05, 0.0)))


@pytest.mark.parametrize(("to", "lengths"), [(72, 3.0), (115, 2.0)])
def test_place_is_found_when_few_candidates_are_compared(to: int, lengths: float) -> None:
    visual_map, centering = usual_map()
    few = replace(visual_map, config=replace(visual_map.config, looked_at=20))
    found = Filter(few, centering)
    follow(drive(way=((1.0, 0.0),)), found)
    arrives(to, found, lengths)


@pytest.mark.parametrize("start", [25, 75])
def test_a_robot_that_is_switched_on_anywhere_is_found(start: int) -> None:
    arrives(start, Filter(*usual_map()), 3.0)


@pytest.mark.parametrize("turn_deg", [90.0, 135.0, 180.0, 225.0])
def test_robot_is_not_sure_before_it_has_turned_to_the_way(turn_deg: float) -> None:
    x, y, heading = drive().poses[0]
    angles = np.radians(np.arange(turn_deg, 361.0, 4.0))
    spin = np.column_stack([np.full((angles.size, 2), (x, y)), heading + angles])
    poses = np.concatenate([spin, drive().poses[1:80]])
    beliefs = follow(Drive(poses, np.zeros(len(poses), dtype=np.int8)))
    away = angles < math.radians(300.0)
    decisive = math.log(PLANNER_CONFIG.decisive)
    sure = [belief.support > decisive for belief in beliefs]
    assert not any(sure[: away.sum()])
    # A place that resembled the scene over the whole turn must not become certain either.
    assert off(beliefs[-1], poses[-1])[0] < 0.2 or beliefs[-1].is_lost


@pytest.mark.long
def test_place_is_likelier_when_the_robot_turns_to_the_way() -> None:
    shares = []
    for start in range(15, 95, 5):
        x, y, heading = drive().poses[start]
        angles = np.radians(np.arange(120.0, 361.0, 4.0))
        poses = np.column_stack([np.full((angles.size, 2), (x, y)), heading + angles])
        belief = follow(Drive(poses, np.zeros(len(poses), dtype=np.int8)))[-1]
        x_is, y_is, _, _ = poses_of(belief, usual_map()[0])
        near = np.hypot(x_is - x, y_is - y) < 0.5
        shares.append((1.0 - belief.lost) * float(belief.weights @ near))
    assert np.mean(shares) > 0.15  # Without the prior of a robot that looks away: 0.08.
