"""Movements between poses, what atoms usually do, and ways added up from them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smal.movement import Atom, Movement, dead_reckoning, turns_ahead, wrapped
from smal.teaching.movements import atom_movements

COORDINATE = st.floats(-50.0, 50.0)
ANGLE = st.floats(-10.0, 10.0)
TABLE = np.array([[0.0, 0.0], [0.05, 0.01], [-0.04, 0.02], [0.003, 0.08], [0.002, -0.07]])


def moved(pose: tuple[float, float, float], movement: Movement) -> tuple[float, float, float]:
    """Make half of the turn, go ahead, and make the other half, as dead reckoning and the filter do."""
    x, y, heading = pose
    middle = heading + movement.turn_rad / 2.0
    return (
        x + movement.ahead * math.cos(middle),
        y + movement.ahead * math.sin(middle),
        heading + movement.turn_rad,
    )


@given(
    pose=st.tuples(COORDINATE, COORDINATE, ANGLE),
    ahead=st.floats(0.001, 5.0),
    sign=st.sampled_from([-1.0, 1.0]),
    turn=st.floats(-3.0, 3.0),
)
def test_between_finds_the_movement_that_was_made(
    pose: tuple[float, float, float], ahead: float, sign: float, turn: float
) -> None:
    found = Movement.between(pose, moved(pose, Movement(sign * ahead, turn)))
    assert found.ahead == pytest.approx(sign * ahead, abs=1e-9)
    assert found.turn_rad == pytest.approx(turn, abs=1e-9)


@given(angle=st.floats(-100.0, 100.0))
def test_wrapped_angles_point_the_same_way(angle: float) -> None:
    found = float(wrapped(np.array(angle)))
    assert -math.pi <= found < math.pi
    assert math.cos(found - angle) == pytest.approx(1.0)


@given(atoms=st.lists(st.sampled_from(list(Atom)), min_size=1, max_size=40))
def test_dead_reckoning_makes_the_movements_of_its_atoms(atoms: list[Atom]) -> None:
    way = dead_reckoning(np.array(atoms, dtype=np.int8), TABLE)
    assert way[0].tolist() == [0.0, 0.0, 0.0]
    for before, after, atom in zip(way[:-1], way[1:], atoms[:-1], strict=True):
        np.testing.assert_allclose(after, moved(tuple(before), Movement(*TABLE[atom])), atol=1e-9)


def test_movements_are_estimated_from_a_noisy_drive() -> None:
    rng = np.random.default_rng(0)
    atoms = [rng.integers(0, 5, 400).astype(np.int8) for _ in range(2)]
    ways = []
    for each in atoms:
        pose = (1.0, 2.0, 0.5)
        way = [(1.0, 2.0, 0.5)]
        for number, atom in enumerate(each[:-1]):
            ahead, turn = TABLE[atom] * (1.0 + 0.05 * rng.standard_normal(2))
            # A wheel slips for a while, and the odometry jumps.
            pose = moved(pose, Movement(ahead + (1.5 if number % 29 == 0 else 0.0), turn))
            way.append(pose)
        ways.append(np.array(way))
    np.testing.assert_allclose(atom_movements(ways, atoms), TABLE, atol=2e-3)


@pytest.mark.parametrize(
    ("made", "missing", "sign"),
    [
        (Atom.RIGHT, Atom.LEFT, (1.0, -1.0)), (Atom.LEFT, Atom.RIGHT, (1.0, -1.0)),
        (Atom.FORWARD, Atom.BACKWARD, (-1.0, -1.0)),
    ],
)  # fmt: skip
def test_missing_atom_is_the_opposite_of_its_opposite(
    made: Atom, missing: Atom, sign: tuple[float, float]
) -> None:
    atoms = np.full(20, made, dtype=np.int8)
    found = atom_movements([dead_reckoning(atoms, TABLE)], [atoms])
    np.testing.assert_allclose(found[made], TABLE[made], atol=1e-9)
    np.testing.assert_array_equal(found[missing], found[made] * sign)
    assert not found[Atom.STOP].any()


def test_bends_do_not_make_a_turning_robot_a_car() -> None:
    spot = np.array([(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.08), (0.0, -0.08)])
    bends = spot + np.array([(0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.2, -0.03), (0.2, 0.03)])
    atoms = np.repeat(list(Atom), 20).astype(np.int8)
    found = atom_movements(
        [dead_reckoning(atoms, bends), dead_reckoning(atoms, spot)], [atoms, atoms]
    )
    np.testing.assert_allclose(found, spot, atol=1e-9)
    assert turns_ahead(atom_movements([dead_reckoning(atoms, bends)], [atoms]))


def test_robot_is_no_car_when_it_rolls_ahead_in_short_turns() -> None:
    atoms = np.tile(
        np.repeat([Atom.FORWARD, Atom.LEFT, Atom.FORWARD, Atom.RIGHT], [20, 3, 20, 1]), 5
    ).astype(np.int8)
    way = [(0.0, 0.0, 0.0)]
    ahead = 0.0
    for atom in atoms[:-1]:
        ahead = 0.2 if atom == Atom.FORWARD else 0.6 * ahead
        way.append(moved(way[-1], Movement(ahead, TABLE[atom, 1])))
    assert not turns_ahead(atom_movements([np.array(way)], [atoms]))


def test_movements_are_those_of_the_faster_person() -> None:
    atoms = np.repeat(list(Atom), 20).astype(np.int8)
    slow = np.repeat(atoms, 2)
    found = atom_movements(
        [dead_reckoning(slow, 0.5 * TABLE), dead_reckoning(atoms, TABLE)], [slow, atoms]
    )
    np.testing.assert_allclose(found, TABLE, atol=1e-9)
