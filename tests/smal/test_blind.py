"""A robot whose camera fails notices within half a second of driving, and stands."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from smal.features import extract
from smal.filter import Belief, CameraState, Filter
from smal.movement import STILL, Movement
from smal.planning import Planner
from smal.planning.config import PLANNER_CONFIG
from tests.smal.synthetic_world import COLOR, Room, drive, usual_map
from tests.smal.test_planning import SPLIT, STRAIGHT, belief

ROOM = Room()
FAILS_AT = 20  # Frame from which on the camera fails.
Picture = np.ndarray
RNG = np.random.default_rng(0)


def grainy(picture: Picture) -> Picture:
    return np.clip(picture + RNG.normal(0.0, 2.0, picture.shape), 0, 255).astype(np.uint8)


#: Each makes a picture of the honest one, and of the last one before the camera failed.
FAILURES: dict[str, tuple[CameraState | None, Callable[[Picture, Picture], Picture]]] = {
    "black": (None, lambda now, _: np.zeros_like(now)),
    "grey": ("blank", lambda now, _: np.full_like(now, 128)),
    "frozen": ("frozen", lambda _, last: last),
    "frozen with noise": ("frozen", lambda _, last: grainy(last)),
    "noise": (None, lambda now, _: RNG.integers(0, 256, now.shape, dtype=np.uint8)),
}


def seen_of(
    fails: Callable[[Picture, Picture], Picture] | None, way_m: float = 2.2
) -> list[Belief]:
    """Follow the taught way, with a camera that fails on it."""
    one = drive(way=((way_m, 0.0),))
    found = Filter(*usual_map())
    last = None
    beliefs = []
    for number, (pose, movement) in enumerate(
        zip(one.poses, [STILL, *one.movements()], strict=True)
    ):
        picture = ROOM.look(pose)
        if fails is not None and number >= FAILS_AT and last is not None:
            picture = fails(picture, last)
        else:
            last = picture
        beliefs.append(found.observe(extract(picture, COLOR), movement))
    return beliefs


def test_unseen_stays_near_zero_when_the_camera_works() -> None:
    assert max(belief.unseen for belief in seen_of(None)) < 0.1
    assert {belief.camera for belief in seen_of(None)} == {"sees"}


@pytest.mark.parametrize("failure", FAILURES)
def test_unseen_grows_with_the_way_when_the_camera_fails(failure: str) -> None:
    state, fails = FAILURES[failure]
    one = drive(way=((2.2, 0.0),))
    beliefs = seen_of(fails)
    way = np.cumsum([0.0, *(movement.ahead for movement in one.movements())])
    blind = PLANNER_CONFIG.blind_s * usual_map()[0].speed
    stands = next(number for number, belief in enumerate(beliefs) if belief.unseen > blind)
    assert way[stands] - way[FAILS_AT] < 2.0 * blind
    if state is not None:
        assert beliefs[stands].camera == state
    decided = Planner(usual_map()[0]).decide(beliefs[stands])
    assert decided.motion[0] == 0.0
    assert decided.kind == ("look_around" if beliefs[stands].camera == "sees" else "blind")


def test_unseen_ends_when_the_camera_sees_again() -> None:
    one = drive(way=((2.2, 0.0),))
    found = Filter(*usual_map())
    for number, (pose, movement) in enumerate(
        zip(one.poses, [STILL, *one.movements()], strict=True)
    ):
        picture = ROOM.look(pose) if not 20 <= number < 26 else np.zeros_like(ROOM.look(pose))
        belief = found.observe(extract(picture, COLOR), movement)
    assert belief.unseen < 0.1


def test_camera_is_not_frozen_when_the_robot_stands() -> None:
    one = drive(way=((1.5, 0.0),))
    found = Filter(*usual_map())
    picture = extract(ROOM.look(one.poses[0]), COLOR)
    beliefs = [found.observe(picture, STILL) for _ in range(50)]
    assert {belief.camera for belief in beliefs} == {"sees"}
    turned = [found.observe(picture, Movement(0.0, math.radians(10.0))) for _ in range(6)]
    assert turned[-1].camera == "frozen"


def test_camera_is_not_frozen_when_a_wide_place_changes_slowly() -> None:
    one = drive(way=((2.2, 0.0),))
    found = Filter(*usual_map())
    first, last = (ROOM.look(pose).astype(float) for pose in (one.poses[0], one.poses[-1]))
    states = set()
    for number, movement in enumerate([STILL, *one.movements()]):
        share = 0.2 * number / len(one.poses)
        picture = np.rint(first + share * (last - first)).astype(np.uint8)
        states.add(found.observe(extract(picture, COLOR), movement).camera)
    assert states == {"sees"}


def test_robot_looks_around_once_when_the_picture_is_blank() -> None:
    planner = Planner(STRAIGHT)
    here = belief((10, 0.0, 0.0, 0.0))
    blank = replace(here, unseen=1.0, camera="blank")
    again = round(PLANNER_CONFIG.blind_again_s / STRAIGHT.tick_s)
    turn = round(PLANNER_CONFIG.look_rad / STRAIGHT.turn_rad)
    kinds = [planner.decide(blank).kind for _ in range(3 * again + turn)]
    found = [(kind, len(list(same))) for kind, same in groupby(kinds)]
    assert [kind for kind, _ in found] == ["blind", "look_around", "blind"]
    assert [count for _, count in found[:2]] == pytest.approx([again, turn], abs=1)
    planner.decide(here)
    again_blank = [planner.decide(blank).kind for _ in range(2 * again)]
    assert {kind for kind, _ in groupby(again_blank)} == {"blind", "look_around"}


def test_robot_looks_around_when_the_camera_sees_unknown_views() -> None:
    planner = Planner(STRAIGHT)
    ticks = round(PLANNER_CONFIG.look_rad / STRAIGHT.turn_rad)
    assert {planner.decide(SPLIT).kind for _ in range(ticks)} == {"look_around"}
    here = belief((10, 0.0, 0.0, 0.0))
    assert planner.decide(here).kind == "follow"
    unseen = replace(here, unseen=1.0)
    assert {planner.decide(replace(unseen, camera="blank")).kind for _ in range(5)} == {"blind"}
    assert planner.decide(unseen).kind == "look_around"
    turns = [planner.decide(unseen).kind for _ in range(4 * ticks)]
    again = round(PLANNER_CONFIG.blind_again_s / STRAIGHT.tick_s)
    kinds = [(kind, len(list(same))) for kind, same in groupby(turns)]
    assert [kind for kind, _ in kinds][:3] == ["look_around", "blind", "look_around"]
    assert kinds[1][1] == pytest.approx(again, abs=1)
