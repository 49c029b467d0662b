"""Drives are joined along stretches that they share, and nowhere else."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from smal.arrays import Floats, Indices
from smal.features import Centering
from smal.filter import Belief, Filter
from smal.map import VisualMap, in_common_axes
from smal.movement import placed, seen_from
from smal.planning import Planner
from smal.target.detector import TargetEstimate
from smal.teaching.stitches import stitched
from tests.smal.synthetic_world import SCENE, START, Room, drive, driven, taught

#: Two drives that begin the same way, the second 12 cm to the left, and part after 2 m.
LEFT = drive(START, ((2.0, 60.0), (1.5, 0.0)))
BESIDE = (START[0], START[1] + 0.12, START[2])
TO_RIGHT = ((2.0, -60.0), (1.5, 0.0))
RIGHT = drive(BESIDE, TO_RIGHT)


@cache
def two() -> tuple[VisualMap, Centering]:
    found, centering = taught(Room(), LEFT, RIGHT, scene=SCENE)
    return stitched(replace(found, goals=("left", "right"))), centering


def test_drives_are_joined_along_their_shared_way() -> None:
    found, _ = two()
    first = found.key_poses[found.stitched[:, 0]]
    second = found.key_poses[found.stitched[:, 1]]
    assert set(map(tuple, found.drives[found.keyframes[found.stitched]].tolist())) == {
        (0, 1),
        (1, 0),
    }
    # Odometry is the truth here: pairs are near each other, and stand as their views say.
    assert np.hypot(*(first - second)[:, :2].T).max() < 0.35
    apart = seen_from(first, second) - found.stitch_offsets
    assert np.abs(apart[:, :2]).max() < 0.15
    assert np.degrees(np.abs(apart[:, 2])).max() < 6.0
    shared = found.key_poses[found.drives[found.keyframes] == 0]
    joined = np.unique(found.stitched[found.stitched[:, 0] < len(shared), 0])
    assert (shared[joined, 0] < START[0] + 2.2).all()
    assert joined.size > 0.5 * (shared[:, 0] < START[0] + 1.9).sum()


def test_drives_are_not_joined_when_their_rooms_differ() -> None:
    there = drive((5.5, 8.0, math.pi), ((2.0, 40.0), (1.0, 0.0)))
    assert stitched(taught(Room(), LEFT, there, scene=SCENE)[0]).stitched.shape == (0, 2)


def test_joined_drives_are_drawn_in_common_axes() -> None:
    found, _ = two()
    poses = found.poses.copy()
    second = found.drives == 1
    # As if it had begun its odometry elsewhere, turned.
    poses[second] = placed(seen_from(poses[second], np.array([1.0, -3.0, 2.0])), np.zeros(3))
    apart = in_common_axes(replace(found, poses=poses)) - found.key_poses
    assert np.hypot(*apart[:, :2].T).max() < 0.3
    alone = replace(
        found, poses=poses, stitched=np.empty((0, 2), np.int32), stitch_offsets=np.empty((0, 3))
    )
    np.testing.assert_array_equal(in_common_axes(alone), alone.key_poses)


def test_similar_places_are_not_joined_against_the_odometry() -> None:
    found, _ = two()
    drives = found.drives[found.keyframes]
    ends = [np.flatnonzero(drives == number)[-9:] for number in (0, 1)]
    views = found.views.copy()
    views[ends[1]] = views[ends[0]]
    alike = replace(found, views=views)

    def joined_ends(visual_map: VisualMap) -> int:
        return int(np.isin(stitched(visual_map).stitched, np.concatenate(ends)).all(axis=1).sum())

    credulous = replace(alike.config, trusted=300.0)
    assert joined_ends(replace(alike, config=credulous)) >= 12
    assert joined_ends(alike) == 0
    # Without the stretch that they share nothing speaks against it.
    strange = views.copy()
    strange[(drives == 1) & ~np.isin(np.arange(len(drives)), ends[1])] *= -1
    assert joined_ends(replace(found, views=strange)) >= 12


def spun(poses: Floats, keys: Indices, step_rad: float, alternates: bool = False) -> None:
    """Turn the robot by a step before each of some keyframes, to one side or to alternate sides."""
    numbers = np.arange(1, keys.size + 1)
    poses[keys, 2] += step_rad * (numbers % 2 if alternates else numbers)


@pytest.mark.parametrize("wheels", [1.0, 1.05])
def test_drives_are_joined_again_after_they_turned_much(wheels: float) -> None:
    """Between the shared places both robots turn twice round; the second counts a twentieth more."""
    found, _ = two()
    first, second = (np.flatnonzero(found.drives == number) for number in (0, 1))
    keys = [np.flatnonzero(found.key_drives == number) for number in (0, 1)]
    poses = found.poses.copy()
    poses[second] = poses[first] + (0.0, 0.12, 0.0)
    after = second[second >= found.keyframes[keys[1][-7]]]
    pivot = poses[found.keyframes[keys[1][-8]]].copy()
    net_rad = 2.0 * math.tau
    wrong = np.array([0.0, 0.0, (wheels - 1.0) * net_rad])
    poses[after] = placed(placed(seen_from(poses[after], pivot), wrong), pivot)
    spun(poses, found.keyframes[keys[0][-11:-7]], net_rad / 5.0)
    spun(poses, found.keyframes[keys[1][-11:-7]], wheels * net_rad / 5.0)
    views = found.views.copy()
    views[keys[1][-7:]] = views[keys[0][-7:]]
    views[keys[0][-11:-7]] *= -1
    joined = stitched(replace(found, views=views, poses=poses)).stitched
    ends = np.concatenate([each[-7:] for each in keys])
    assert np.isin(joined, ends).all(axis=1).sum() >= 10


def test_similar_places_are_not_joined_after_a_winding_way() -> None:
    """The error of many turns to and fro grows with the square root of their sum."""
    found, _ = two()
    keys = [np.flatnonzero(found.key_drives == number) for number in (0, 1)]
    views = found.views.copy()
    views[keys[1][-7:]] = views[keys[0][-7:]]
    views[keys[0][-11:-7]] *= -1
    poses = found.poses.copy()
    for of_drive in keys:
        spun(poses, found.keyframes[of_drive[-11:-7]], 3.0, alternates=True)
    joined = stitched(replace(found, views=views, poses=poses)).stitched
    assert not np.isin(joined, np.concatenate([each[-7:] for each in keys])).all(axis=1).any()


@cache
def of_two_people() -> tuple[VisualMap, Centering]:
    """Learn of two people: the second is half as fast, with wheels that count a twentieth more."""
    slow = replace(drive(BESIDE, TO_RIGHT, speed=0.5), wheels=1.05)
    found, centering = taught(Room(), LEFT, slow, scene=SCENE)
    return stitched(replace(found, goals=("left", "right"))), centering


@pytest.mark.parametrize(("goal", "taught_by"), [("left", two), ("right", of_two_people)])
def test_goal_is_reached_from_the_start_of_the_other_drive(
    goal: str, taught_by: Callable[[], tuple[VisualMap, Centering]]
) -> None:
    """The filter and the planner drive: from the start of one drive to the end of the other."""
    visual_map, centering = taught_by()
    begin, finish = (RIGHT, LEFT) if goal == "left" else (LEFT, RIGHT)
    found = Filter(visual_map, centering)
    planner = Planner(visual_map, goal)
    pose = driven(found, planner, Room(), begin.poses[0], 200)
    assert planner.said
    assert math.hypot(*(pose - finish.poses[-1])[:2]) < 0.3


def test_next_end_is_tried_when_the_target_is_not_at_one() -> None:
    """Of two drives to one goal, one ends half way along the other."""
    shorter = drive(START, ((1.8, 0.0),))
    longer = drive(BESIDE, ((3.2, 0.0),))
    found, _ = taught(Room(), shorter, longer, scene=SCENE)
    visual_map = stitched(replace(found, goals=("victim", "victim")))
    planner = Planner(visual_map)

    def at_end(number: int) -> Belief:
        end = np.flatnonzero(visual_map.key_drives == number)[-1:]
        return Belief(end, np.zeros((1, 3)), np.ones(1), 0.0, 0.9, 3.0)

    kinds = [
        planner.decide(at_end(0), target=TargetEstimate(0.0, near=0.0)).kind for _ in range(150)
    ]
    assert (kinds[0], kinds[-1], planner.said) == ("search", "follow", None)
    kinds = [
        planner.decide(at_end(1), target=TargetEstimate(0.0, near=0.0)).kind for _ in range(150)
    ]
    assert (kinds[0], kinds[-1], planner.said) == ("search", "goal", "not_here")
