"""The scanner: a way is free only where the scan shows it free."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.base import KEYS
from services.kit.node import ServiceError
from tests.ros2.rig import SCAN, Rig

INF = math.inf
NAN = math.nan
STOP_M = 0.4
BLIND_M = 0.1
HALF_RAD = 0.6
GAP_RAD = 0.2
MOST_M = 12.0
STEP = math.tau / 360
#: The scanner of a TurtleBot 3: LDS-01, 0 where nothing comes back; and LDS-02, which leaves some beams out as well.
LDS_01 = {"angle_max": math.tau, "angle_increment": STEP, "range_min": 0.12, "range_max": 3.5}
LDS_02 = {"angle_min": 0.01, "angle_max": 6.26, "angle_increment": 6.25 / 240}
LDS_02 |= {"range_min": 0.0, "range_max": 100.0}


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """Share one: where it is not forbidden after one scan, it is as if there had been none."""
    return Rig(tmp_path_factory.mktemp("scanner"))


def after(rig: Rig, ranges: object, **fields: float) -> Rig:
    """Have everything be heard, all ways be free, and then such a scan."""
    rig.begun().scans(ranges, **fields)
    return rig


@pytest.mark.parametrize("value", [-INF, NAN, 0.0, 0.05, -1.0, 12.1, 65.533, 1e30], ids=str)
def test_way_is_closed_when_the_scanner_sees_nothing(rig: Rig, value: float) -> None:
    assert after(rig, [value] * 360).ways() == "left right"


WRONG: list[dict[str, float]] = [
    *({"angle_increment": step} for step in (0.0, NAN, INF, -INF, 1.0, 1e-30, -STEP, STEP / 2, 2 * STEP)),
    {"angle_min": NAN}, {"angle_min": 1e9, "angle_max": 1e9}, {"angle_max": NAN}, {"angle_max": 3.0},
    *({"range_min": metres} for metres in (1e9, NAN, -1.0, STOP_M)), {"range_max": 0.3}, {"range_max": NAN},
    {"range_max": 0.0}, {"range_max": -1.0}, {"range_min": 5.0, "range_max": 1.0}, {"range_min": 0.3, "range_max": 0.1},
]  # fmt: skip


@pytest.mark.parametrize("fields", WRONG, ids=str)
def test_scan_is_refused_when_it_is_impossible(rig: Rig, fields: dict[str, float]) -> None:
    refused = rig.senses.refused[SCAN]
    assert after(rig, [5.0] * 360, **fields).ways() == "left right"
    assert rig.senses.refused[SCAN] == refused + 1
    assert not rig.may_go("forward")
    assert f"{SCAN}: " in str(rig.body.detail()["lacks"])


@pytest.mark.parametrize("beams", [0, 1, 180, 300, 420, 720])
def test_scan_is_refused_when_its_count_contradicts_its_angles(rig: Rig, beams: int) -> None:
    refused = rig.senses.refused[SCAN]
    whole = {"angle_min": 0.0, "angle_max": math.tau, "angle_increment": STEP}
    assert after(rig, [5.0] * beams, **whole).ways() == "left right"
    assert rig.senses.refused[SCAN] == refused + 1


@pytest.mark.parametrize("value", [-INF, NAN, 0.0, -1.0, 1e-30, 0.01, 12.1], ids=str)
@pytest.mark.parametrize(
    ("middle", "others"), [(0, "backward left right"), (180, "forward left right")]
)
def test_only_the_way_is_closed_when_its_beams_are_invalid(
    rig: Rig, value: float, middle: int, others: str
) -> None:
    ranges = np.full(360, 5.0, np.float32)
    ranges[np.arange(middle - 10, middle + 11) % 360] = value
    assert after(rig, ranges).ways() == others


@st.composite
def scans(draw: st.DrawFn) -> tuple[list[float], dict[str, float]]:
    """Make scans of scanners that are more or less broken."""
    value = st.sampled_from(
        [0.0, -INF, INF, NAN, 0.05, 0.3, STOP_M, 5.0, MOST_M, 13.0]
    ) | st.floats(width=32)
    beams = draw(st.sampled_from([120, 360]) | st.integers(0, 400))
    ranges = [draw(st.sampled_from([5.0, 5.0, INF, INF, 0.0, NAN]))] * beams
    for _ in range(draw(st.integers(0, 3))):
        begin = draw(st.integers(0, 400))
        size = draw(st.integers(0, 60))
        ranges[begin : begin + size] = [draw(value)] * len(ranges[begin : begin + size])
    begin = draw(st.floats(-4, 4, width=32))
    turn = draw(st.sampled_from([6.2, 6.2, -6.2]) | st.floats(-7, 7))
    fields = {"angle_min": begin, "angle_max": begin + turn}
    fields |= {"angle_increment": turn / max(1, beams - 1)}
    wrong = st.dictionaries(
        st.sampled_from([*fields, "range_min", "range_max"]), st.floats(width=32), max_size=1
    )
    return ranges, fields | draw(st.just({}) | wrong)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scans(), st.sampled_from([("forward", 0.0), ("backward", math.pi)]))
def test_way_is_free_only_when_the_scan_covers_all_of_it(
    rig: Rig, scan: tuple[list[float], dict[str, float]], way: tuple[str, float]
) -> None:
    ranges, fields = scan
    if not after(rig, ranges, **fields).may_go(way[0]):
        return
    most = fields.get("range_max", MOST_M)
    there = []
    for number, metres in enumerate(np.asarray(ranges, np.float32).tolist()):
        angle = fields["angle_min"] + number * fields["angle_increment"]
        off = math.remainder(angle - way[1], math.tau)
        if abs(off) <= HALF_RAD - 1e-3:  # angles are of 32 bits
            assert metres != -INF
            assert not BLIND_M < metres < STOP_M
        if abs(off) <= HALF_RAD + 1e-3 and (STOP_M <= metres <= most or metres == INF):
            there.append(off)
    for direction in np.linspace(-HALF_RAD, HALF_RAD, 61):
        assert min(abs(off - direction) for off in there) <= GAP_RAD + 1e-3


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(60, 720),
    st.floats(-math.pi, math.pi),
    st.sampled_from([-1, 1]),
    st.lists(
        st.sampled_from([INF, MOST_M, STOP_M]) | st.floats(0.5, 11.5), min_size=1, max_size=20
    ),
)
def test_way_is_free_when_all_beams_are_free(
    rig: Rig, beams: int, begin: float, sense: int, values: list[float]
) -> None:
    step = sense * math.tau / beams
    end = begin + (beams - 1) * step
    after(rig, np.resize(values, beams), angle_min=begin, angle_increment=step, angle_max=end)
    assert rig.ways() == "forward backward left right"


def test_only_the_way_ahead_is_closed_when_it_is_unknown(rig: Rig) -> None:
    ranges = [5.0] * 360
    ranges[20:40] = [NAN] * 20
    assert after(rig, ranges).ways() == "backward left right"
    assert not rig.may_go("forward")
    assert rig.body.detail()["lacks"] == f"{SCAN}: 15 degrees ahead are unknown"
    rig.passes(0.1)  # it needs not be armed again
    assert rig.may_go("forward")


def test_way_back_is_open_when_it_is_configured_as_unguarded(tmp_path: Path) -> None:
    half = {"angle_min": -2.0, "angle_max": 2.0, "angle_increment": 4.0 / 240}
    assert after(Rig(tmp_path), [5.0] * 241, **half).ways() == "forward left right"
    unguarded = after(Rig(tmp_path, "stop_m: 0.4, behind: false"), [5.0] * 241, **half)
    assert unguarded.ways() == "forward backward left right"
    behind = [5.0] * 360
    behind[180] = 0.2
    assert not after(unguarded, behind).may_go("backward")  # what it sees all the same counts


@pytest.mark.parametrize("lds", [LDS_01, LDS_02], ids=["LDS-01", "LDS-02"])
def test_turtlebot_3_drives_when_its_zeros_are_declared_free(
    tmp_path: Path, lds: dict[str, float]
) -> None:
    beams = 360 if lds is LDS_01 else 241
    nothing = np.zeros(beams, np.float32)
    if lds is LDS_02:
        nothing[::5] = NAN
    safe = after(Rig(tmp_path, "half_angle_rad: 0.6", preset="turtlebot3"), nothing, **lds)
    assert not safe.may_go("forward")
    assert "if 0 means free, set zero_is_free" in str(safe.body.detail()["lacks"])
    assert safe.may_go("left")
    told = Rig(tmp_path, "zero_is_free: true", preset="turtlebot3")
    assert after(told, nothing, **lds).may_go("forward")
    for metres in (0.15, 0.05):  # less than the LDS-01 can measure, which says so all the same
        near = nothing.copy()
        near[3] = metres
        assert not after(told, near, **lds).may_go("forward")
    assert not after(told, np.full(beams, NAN), **lds).may_go("forward")
    room = np.full(beams, 2.5, np.float32)
    room[::7] = 0.0  # what is black sends nothing back
    assert after(safe, room, **lds).may_go("forward")


def test_obstacle_is_near_when_it_is_too_near_to_be_measured(rig: Rig) -> None:
    ranges = [5.0] * 360
    ranges[3] = -INF
    after(rig, ranges)
    with pytest.raises(
        ServiceError,
        match=r"obstacle 0\.00 m ahead \(/scan\); it stands until it is armed",
    ):
        rig.body.drive(KEYS["forward"])
    assert rig.may_go("backward")
