"""Decisions of the planner: on the way, beside it, at its end, and when the belief is too wide."""

import itertools
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.base import Velocity
from smal.camera import TURNS_DEG, Camera, Scene
from smal.filter import Belief, Filter
from smal.likelihood import GRID, SHARES
from smal.map import VisualMap
from smal.movement import Atom, Motion
from smal.planning import Decision, Planner, cost_to_go
from smal.planning.config import PLANNER_CONFIG
from smal.planning.steering import Chassis, Intent, Steering
from smal.target.detector import TargetEstimate
from tests.smal.synthetic_world import START, TICK, Room, drive, driven, from_beside, usual_map

#: Pairs of keyframes, and how the first stands to the second.
Stitches = tuple[tuple[tuple[int, int], tuple[float, float, float]], ...]


def map_of(
    *lengths_m: float, goals: tuple[str, ...] | None = None, stitches: Stitches = ()
) -> VisualMap:
    """Make a map of straight drives at 0.5 m/s and 10 Hz, a keyframe every 10 cm; each in other axes, without views."""
    ways = []
    for number, metres in enumerate(lengths_m):
        along = np.arange(round(metres / 0.05) + 1)[:, None] * 0.05
        angle = 2.0 * number
        ways.append(along * (math.cos(angle), math.sin(angle), 0.0) + (0.0, 0.0, angle))
    drives = np.repeat(np.arange(len(ways), dtype=np.int32), [len(way) for way in ways])
    ends = np.cumsum([len(way) for way in ways])
    every = [np.arange(end - len(way), end, 2) for way, end in zip(ways, ends, strict=True)]
    keyframes = np.unique(np.concatenate([*every, ends - 1])).astype(np.int32)
    return VisualMap(
        poses=np.concatenate(ways),
        drives=drives,
        keyframes=keyframes,
        basis=np.eye(4, 1, dtype=np.float32),
        views=np.zeros((keyframes.size, 3, TURNS_DEG.size, 1), dtype=np.int8),
        blank=np.zeros(1, dtype=np.float32),
        correlation_length=0.5,
        correlation_rad=0.2,
        log_ratio=np.tile(np.linspace(-3.0, 10.0, GRID.size), (SHARES.size, 1)),
        gamma=1.0,
        next_correlation=0.5,
        movements=np.array(
            [[0, 0], [0.05, 0], [-0.05, 0], [0, math.radians(4.5)], [0, -math.radians(4.5)]]
        ),
        tick_s=TICK,
        odometry=True,
        taught_scene=Scene(Camera.of_field(70.0), 0.3, 5.0),
        goals=goals or ("victim",) * len(ways),
        names=tuple((f"drive-{k}",) for k in range(len(ways))),
        size=(64, 48),
        stitched=np.array([pair for pair, _ in stitches], dtype=np.int32).reshape(-1, 2),
        stitch_offsets=np.array([offset for _, offset in stitches]).reshape(-1, 3),
    )


STRAIGHT = map_of(5.0)


def key(decision: Decision) -> Atom:
    """Return the key of teleoperation that is nearest to a decision."""
    return Atom[Velocity(*decision.motion).atom().upper()]


def belief(
    *places: tuple[int, float, float, float],
    weights: tuple[float, ...] = (1.0,),
    lost: float = 0.0,
    tracked: float = 3.0,
) -> Belief:
    """Believe in places: keyframe, ahead, left, turned in degrees."""
    keyframes, ahead, left, turned = zip(*places, strict=True)
    offsets = np.stack([ahead, left, np.radians(turned)], axis=1)
    return Belief(np.array(keyframes), offsets, np.array(weights), lost, 0.8, tracked)


SPLIT = belief((10, 0.0, 0.0, 0.0), (10, 0.0, 0.0, 180.0), weights=(0.5, 0.5))


@pytest.mark.parametrize(
    ("left", "turned_deg", "atom"),
    [
        (0.0, 20.0, Atom.RIGHT),
        (0.0, -20.0, Atom.LEFT),
        (0.5, 0.0, Atom.RIGHT),
        (-0.5, 0.0, Atom.LEFT),
    ],
)
def test_robot_turns_back_when_it_is_turned_or_aside(
    left: float, turned_deg: float, atom: Atom
) -> None:
    decision = Planner(STRAIGHT).decide(belief((10, 0.0, left, turned_deg)))
    assert (decision.kind, key(decision)) == ("follow", atom)
    # It aims at the way 0.35 m ahead.
    aim = -math.degrees(math.atan2(left, 0.35)) - turned_deg
    assert math.degrees(decision.heading_rad) == pytest.approx(aim, abs=6.0)


def test_robot_looks_around_when_evidence_is_not_decisive() -> None:
    faint = replace(belief((10, 0.0, 0.0, 0.0)), support=1.0)
    planner = Planner(STRAIGHT)
    decisions = [planner.decide(faint) for _ in range(10)]
    assert {decision.kind for decision in decisions} == {"look_around"}
    assert {decision.motion[0] for decision in decisions} == {0.0}
    assert planner.decide(replace(faint, support=10.0)).kind == "follow"


def test_robot_stops_for_good_when_it_is_at_the_end() -> None:
    planner = Planner(STRAIGHT)
    end = len(STRAIGHT.keyframes) - 1
    assert key(planner.decide(belief((end, -0.1, 0.0, 0.0)))) is Atom.FORWARD
    assert not planner.said
    decision = planner.decide(belief((end, 0.0, 0.0, 0.0)))
    assert (decision.kind, key(decision), planner.said) == ("goal", Atom.STOP, "found")
    assert planner.decide(belief((10, 0.0, 0.0, 0.0))).kind == "goal"
    planner.reset()
    assert not planner.said
    assert key(planner.decide(belief((10, 0.0, 0.0, 0.0)))) is Atom.FORWARD


END = belief((len(STRAIGHT.keyframes) - 1, 0.0, 0.0, 0.0))


def test_goal_is_found_only_when_the_target_is_seen() -> None:
    planner = Planner(STRAIGHT)
    decision = planner.decide(END, target=TargetEstimate(0.5, near=0.0))
    assert (decision.kind, planner.arrived, planner.said) == ("search", True, None)
    assert key(decision) is Atom.LEFT
    assert key(planner.decide(END, target=TargetEstimate(0.99, near=1.1))) is Atom.STOP
    assert planner.said == "found"


def looked_around(planner: Planner, *places: tuple[int, float, float, float]) -> None:
    """Look around, at one place after the other."""
    for number in range(105):
        here = belief(places[number * len(places) // 105], tracked=0.0, lost=0.6)
        planner.decide(here, target=TargetEstimate(0.0, 0.0))


LAST = (len(STRAIGHT.keyframes) - 1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("before", "arrived"), [((LAST, (10, 0.0, 0.0, 0.0)), False), ((LAST,), True)]
)
def test_look_around_counts_at_its_own_place(
    before: tuple[tuple[int, float, float, float], ...], arrived: bool
) -> None:
    planner = Planner(STRAIGHT)
    looked_around(planner, *before)
    planner.decide(belief(LAST, tracked=0.0), target=TargetEstimate(0.99, 1.1, 0.0))
    assert planner.said == ("found" if arrived else None)


def test_robot_must_track_its_way_when_it_has_no_target() -> None:
    planner = Planner(STRAIGHT)
    looked_around(planner, LAST)
    for tracked, said in ((0.1, None), (3.0, "found")):
        planner.decide(belief(LAST, tracked=tracked))
        assert planner.said == said


def test_search_is_not_confused_by_similar_places() -> None:
    planner = Planner(STRAIGHT)
    planner.decide(END, target=TargetEstimate(0.0, near=0.0))
    kinds = [
        planner.decide(belief((10, 0.0, 0.0, 2.0)), target=TargetEstimate(0.0, near=0.0)).kind
        for _ in range(120)
    ]
    assert set(kinds) == {"search", "goal"}
    assert planner.said == "not_here"


def test_robot_approaches_a_distant_target() -> None:
    planner = Planner(STRAIGHT)
    atoms = [
        key(planner.decide(END, target=TargetEstimate(0.99, 0.5, left)))
        for left in (0.4, 0.4, 0.0, 0.0, -0.4)
    ]
    assert atoms == [Atom.LEFT, Atom.LEFT, Atom.FORWARD, Atom.FORWARD, Atom.RIGHT]
    assert planner.said is None
    assert key(planner.decide(END, target=TargetEstimate(0.99, near=1.1))) is Atom.STOP
    assert planner.said == "found"


def test_robot_gives_up_a_target_that_stays_far() -> None:
    planner = Planner(STRAIGHT)
    made = Counter[Atom]()
    while planner.said is None:
        assert made.total() < 200, "no end is reported"
        made[key(planner.decide(END, target=TargetEstimate(0.99, near=0.0)))] += 1
    assert planner.said == "not_here"
    assert made[Atom.FORWARD] * STRAIGHT.tick_s <= PLANNER_CONFIG.goal_s + STRAIGHT.tick_s


def test_robot_reports_not_here_after_a_full_turn() -> None:
    planner = Planner(STRAIGHT)
    turned_rad = 0.0
    while planner.said is None:
        assert turned_rad < 8.0, "no end is reported"
        turned_rad += {Atom.LEFT: abs(float(STRAIGHT.movements[Atom.LEFT, 1]))}.get(
            key(planner.decide(END, target=TargetEstimate(0.0, near=0.0))), 0.0
        )
    assert planner.said == "not_here"
    assert turned_rad > 2.0 * math.pi
    planner.reset()
    assert not planner.arrived
    assert planner.decide(belief((10, 0.0, 0.0, 0.0))).kind == "follow"


@pytest.mark.parametrize(
    ("share", "lost", "tracked"),
    [(1.0, 0.0, 0.1), (1.0, 0.0, 0.25), (1.0, 0.2, 3.0), (0.8, 0.0, 3.0)],
)
def test_goal_is_not_reported_when_the_belief_is_unsure(
    share: float, lost: float, tracked: float
) -> None:
    places = ((len(STRAIGHT.keyframes) - 1, 0.0, 0.0, 0.0), (10, 0.0, 0.0, 0.0))
    for target in (None, TargetEstimate(0.99, 1.1, 0.0)):
        planner = Planner(STRAIGHT)
        unsure = belief(*places, weights=(share, 1.0 - share), lost=lost, tracked=tracked)
        assert planner.decide(unsure, target=target).kind != "goal"
        assert not planner.said


@pytest.mark.parametrize("lost", [0.0, 0.6])
def test_unsure_robot_looks_around_then_guesses(lost: float) -> None:
    planner = Planner(STRAIGHT)
    unsure = SPLIT if not lost else belief((10, 0.0, 0.0, 0.0), lost=lost)
    decisions = [planner.decide(unsure) for _ in range(400)]
    kinds = [decision.kind for decision in decisions]
    look = math.ceil(math.degrees(PLANNER_CONFIG.look_rad) / 4.5)
    drive = round(PLANNER_CONFIG.guess_s / TICK)
    guess = drive + round(180.0 / 4.5)  # It may have to turn round first.
    assert set(kinds) == {"look_around", "guess"}
    assert kinds[:look] == ["look_around"] * look
    for start in range(0, 400 - look - guess - 5, look + guess):
        some = decisions[start : start + look + guess]
        counted = Counter(decision.kind for decision in some)
        assert counted["look_around"] == pytest.approx(look, abs=2)
        assert counted["guess"] == pytest.approx(guess, abs=2)
        assert sum(decision.motion[0] == 1.0 for decision in some) >= drive - 2
    # It looks to one side, turns round the other way, and drives when it guesses.
    turns = [key(decision) for decision in decisions[:look]]
    aside = turns.index(Atom.RIGHT if turns[0] is Atom.LEFT else Atom.LEFT)
    assert aside == pytest.approx(PLANNER_CONFIG.look_aside_deg / 4.5, abs=1)
    assert len(set(turns[:aside])) == len(set(turns[aside:])) == 1
    assert key(decisions[0]) in (Atom.LEFT, Atom.RIGHT)
    if lost:
        assert key(decisions[look + 2]) is Atom.FORWARD


def steps(headings_deg: list[float], elapsed_s: float = TICK) -> list[Motion]:
    """Return the motions of a robot among things, at the headings of one frame after the other."""
    steering = Steering(Chassis.of(STRAIGHT, PLANNER_CONFIG), STRAIGHT.tick_s)
    intents = [
        Intent("follow", heading_rad=math.radians(one), stepwise=True) for one in headings_deg
    ]
    return [steering.steer(intent, elapsed_s, 0.0) for intent in intents]


LEFT = (0.0, 1.0)
RIGHT = (0.0, -1.0)
AHEAD = (1.0, 0.0)


def test_stepwise_turn_ends_when_a_smaller_one_would_not_help() -> None:
    assert steps([4.0, 8.0, 4.0, 2.0]) == [AHEAD, LEFT, LEFT, AHEAD]
    assert steps([-4.0, -8.0, -4.0, -2.0]) == [AHEAD, RIGHT, RIGHT, AHEAD]


def test_robot_does_not_oscillate_when_its_rate_is_low() -> None:
    """A quarter of a second of turning is 11 degrees: from 6 to one side it would lead to 5 on the other."""
    assert steps([6.0, -5.25, 5.25], 0.25) == [LEFT, AHEAD, AHEAD]


def test_robot_approaches_a_target_beside_the_way_and_goes_on() -> None:
    planner = Planner(STRAIGHT)
    before = belief((len(STRAIGHT.keyframes) - 3, 0.0, 0.0, 0.0))
    atoms = [
        key(planner.decide(before, target=TargetEstimate(0.99, 0.9, left))) for left in (0.4, 0.0)
    ]
    assert atoms == [Atom.LEFT, Atom.FORWARD]
    kinds = [planner.decide(before, target=TargetEstimate(0.99, 0.9, 0.0)).kind for _ in range(30)]
    assert (kinds[0], kinds[-1], planner.said) == ("search", "follow", None)
    planner.reset()
    planner.decide(before, target=TargetEstimate(0.99, 1.1, 0.0))
    assert planner.said == "found"


def test_robot_does_not_approach_an_unlocated_target() -> None:
    planner = Planner(STRAIGHT)
    atoms = {key(planner.decide(END, target=TargetEstimate(0.99, 0.5, None))) for _ in range(20)}
    assert atoms == {Atom.LEFT}


def test_robot_reports_not_here_when_no_way_leads_on() -> None:
    planner = Planner(map_of(5.0, 5.0, goals=("victim", "elsewhere")), "victim")
    end = belief((50, 0.0, 0.0, 0.0))
    other = belief((70, 0.0, 0.0, 0.0))
    for _ in range(200):
        planner.decide(other if planner.arrived else end, target=TargetEstimate(0.0, 0.0))
    assert planner.said == "not_here"


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_steering_predicts_turns_that_are_under_way(side: float) -> None:
    turns = []
    for delay_s in (0.0, 0.1, 0.3):
        planner = Planner(STRAIGHT)
        planner.decide(belief((10, 0.0, 0.0, -20.0 * side)), delay_s=delay_s)
        turns.append(
            side * planner.decide(belief((10, 0.0, 0.0, -6.0 * side)), delay_s=delay_s).motion[1]
        )
    assert turns[0] > turns[1] > 0.0 > turns[2]


@pytest.mark.parametrize("car", [False, True])
def test_robot_returns_to_the_way_without_a_stop(car: bool) -> None:
    table = STRAIGHT.movements.copy()
    table[[Atom.LEFT, Atom.RIGHT], 0] = 0.05 if car else 0.0
    planner = Planner(replace(STRAIGHT, movements=table))
    x = 1.0
    y = 0.1
    turned = math.radians(15.0)
    for _ in range(60):
        key = round(x / 0.1)
        linear, angular = planner.decide(
            belief((key, x - key / 10.0, y, math.degrees(turned)))
        ).motion
        assert linear > 0.2
        assert not car or abs(angular) <= linear
        x = x + 0.05 * linear * math.cos(turned)
        y = y + 0.05 * linear * math.sin(turned)
        turned += angular * math.radians(4.5)
    assert abs(y) < 0.01
    unsure = belief((10, 0.0, 0.0, 15.0), (11, 0.0, 0.0, -15.0), weights=(0.5, 0.5))
    sure = belief((10, 0.0, 0.0, 0.0))
    assert 0.0 < planner.decide(unsure).motion[0] < planner.decide(sure).motion[0]
    back = planner.decide(belief((10, 0.0, 0.0, 120.0))).motion
    assert (back[0] > 0.0) == car


@pytest.mark.parametrize("ahead", [0.0, -0.3, -0.6])
def test_robot_goes_to_the_start_when_it_is_behind_it(ahead: float) -> None:
    two = map_of(2.0, 3.0)
    first = int(np.flatnonzero(two.drives[two.keyframes] == 1)[0])
    decision = Planner(two).decide(belief((first, ahead, 0.0, 0.0)))
    assert (decision.kind, key(decision)) == ("follow", Atom.FORWARD)
    assert decision.heading_rad == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("left", "turn_deg"), [(0.25, 15.0), (-0.25, -25.0)])
def test_robot_reaches_the_goal_when_it_starts_beside_the_way(left: float, turn_deg: float) -> None:
    goal = drive().poses[-1]
    found = Filter(*usual_map())
    planner = Planner(usual_map()[0])
    pose = driven(
        found, planner, Room(), from_beside(START, 0.0, left, math.radians(turn_deg)), 260
    )
    assert planner.said
    assert math.hypot(*(pose - goal)[:2]) < 0.25


def fork(goals: tuple[str, ...] = ("kitchen", "office"), left_m: float = 0.0) -> VisualMap:
    """Two drives of 4 m and 6 m (keyframes 0 to 40, and 41 to 101) that share their second metre, both ways."""
    shared = [(10 + k, 41 + 10 + k) for k in range(10)]
    pairs = tuple(((one, other), (0.0, left_m, 0.0)) for one, other in shared)
    back = tuple(((other, one), (0.0, -left_m, 0.0)) for one, other in shared)
    return map_of(4.0, 6.0, goals=goals, stitches=tuple(sorted(pairs + back)))


def test_global_search_covers_a_way_just_above_its_maximum() -> None:
    # 501 keyframes: the overview has as many groups as the search selects.
    near, share = map_of(50.0).likely(np.zeros(1, dtype=np.float32))
    assert near.tolist() == list(range(501))
    assert share.sum() == 501


def test_costs_to_go_satisfy_bellman_s_equation() -> None:
    two = fork(left_m=0.3)
    cost, following = cost_to_go(two, "office")
    edges = {(k, k + 1): 0.2 for k in range(101) if k != 40}
    # Going over takes the time to drive 0.3 m aside as well.
    edges |= dict.fromkeys(map(tuple, two.stitched.tolist()), PLANNER_CONFIG.go_over_s + 0.6)
    for here in range(102):
        onward = {there: step + cost[there] for (one, there), step in edges.items() if one == here}
        if here == 101:
            assert (cost[here], following[here]) == (pytest.approx(0.0, abs=1e-6), -1)
        elif np.isfinite(cost[here]):
            assert cost[here] == pytest.approx(min(onward.values()), abs=1e-6)
            assert onward[int(following[here])] == pytest.approx(cost[here], abs=1e-6)
        else:
            assert all(np.isinf(value) for value in onward.values())
            assert following[here] == -1


LENGTHS_M = (1.0, 1.5, 2.0)
ENDS = np.cumsum([0, *(round(metres / 0.1) + 1 for metres in LENGTHS_M)])


@st.composite
def meetings(draw: st.DrawFn) -> Stitches:
    """Three drives that share any places, as far apart from each other as may be."""
    found: dict[tuple[int, int], tuple[float, float, float]] = {}
    for _ in range(draw(st.integers(0, 30))):
        one, other = draw(st.permutations(range(3)))[:2]
        pair = [
            draw(st.integers(int(ENDS[drive]), int(ENDS[drive + 1]) - 1)) for drive in (one, other)
        ]
        left_m = draw(st.sampled_from([0.0, 0.05, 0.5]))
        found[pair[0], pair[1]] = (0.0, left_m, 0.0)
        found[pair[1], pair[0]] = (0.0, -left_m, 0.0)
    return tuple(sorted(found.items()))


@settings(max_examples=40)
@given(meetings())
def test_every_step_is_nearer_to_the_goal(stitches: Stitches) -> None:
    three = map_of(*LENGTHS_M, goals=("victim", "victim", "elsewhere"), stitches=stitches)
    cost, following = cost_to_go(three, "victim")
    on_way = np.flatnonzero(following >= 0)
    assert (cost[following[on_way]] < cost[on_way]).all()
    assert np.isin(np.flatnonzero(np.isfinite(cost) & (following < 0)), ENDS[1:3] - 1).all()
    Planner(three, "victim")


@pytest.mark.parametrize(("goal", "end", "other_end"), [("kitchen", 40, 101), ("office", 101, 40)])
def test_robot_arrives_at_the_named_goal_only(goal: str, end: int, other_end: int) -> None:
    planner = Planner(fork(), goal)
    assert planner.decide(belief((other_end, 0.0, 0.0, 0.0))).kind != "goal"
    assert not planner.said
    assert planner.decide(belief((end, 0.0, 0.0, 0.0))).kind == "goal"


@pytest.mark.parametrize(("goal", "end", "said"), [
    (None, 40, "the model has the goals kitchen, office; name one of them"),
    ("cellar", 40, "the model has no goal 'cellar'; it has kitchen, office"),
])  # fmt: skip
def test_goal_is_refused_when_it_is_unknown_or_missing(
    goal: str | None, end: int, said: str
) -> None:
    with pytest.raises(ValueError, match=f"^{said}$"):
        Planner(fork(), goal)
    assert (
        Planner(fork(("kitchen", "kitchen")), None).decide(belief((end, 0.0, 0.0, 0.0))).kind
        == "goal"
    )


def test_robot_looks_round_then_stands_when_no_way_leads_on() -> None:
    planner = Planner(fork(), "office")
    kinds = [planner.decide(belief((30, 0.0, 0.0, 0.0))) for _ in range(300)]
    look = math.ceil(math.degrees(PLANNER_CONFIG.look_rad) / 4.5)
    assert [one.kind for one in kinds] == ["look_around"] * look + ["dead_end"] * (300 - look)
    assert {key(one) for one in kinds[look:]} == {Atom.STOP}
    # As soon as it believes otherwise it goes on.
    assert planner.decide(belief((70, 0.0, 0.0, 0.0))).kind == "follow"


def test_robot_looks_to_one_side_when_a_fork_is_ambiguous() -> None:
    planner = Planner(STRAIGHT)
    atoms = []
    for k in range(60):
        share = 0.52 if k % 2 else 0.48
        places = ((10, 0.0, 0.0, 60.0), (10, 0.0, 0.0, -60.0))
        atoms.append(key(planner.decide(belief(*places, weights=(share, 1.0 - share)))))
    # It turns to look, to one side and then to the other.
    assert sum(one is not other for one, other in itertools.pairwise(atoms)) == 1


def test_guess_depends_on_time_when_the_rate_differs() -> None:
    usual = Planner(STRAIGHT)
    fast = Planner(STRAIGHT)
    lost = belief((10, 0.0, 0.0, 0.0), lost=0.9)
    at_10_hz = [usual.decide(lost, 0.1).kind for _ in range(150)]
    at_20_hz = [fast.decide(lost, 0.05).kind for _ in range(300)]
    assert at_10_hz.index("guess") == pytest.approx(at_20_hz.index("guess") / 2.0, abs=1)
    assert at_10_hz.count("guess") == pytest.approx(at_20_hz.count("guess") / 2.0, abs=2)


def test_robot_approaches_a_target_at_a_second_end() -> None:
    ways = (((50, 51), (0.0, 0.0, 0.0)), ((10, 61), (0.0, 0.0, 0.0)), ((61, 10), (0.0, 0.0, 0.0)))
    planner = Planner(map_of(5.0, 9.0, stitches=ways))
    for _ in range(200):
        planner.decide(belief((50, 0.0, 0.0, 0.0)), target=TargetEstimate(0.99, 0.5, 0.0))
    assert (planner.arrived, planner.said) == (False, None)
    beside = belief((136, 0.0, 0.0, 0.0))
    assert planner.decide(beside, target=TargetEstimate(0.99, 0.9, 0.2)).kind == "search"
