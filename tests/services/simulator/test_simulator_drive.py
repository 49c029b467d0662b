"""Kinematics: exact arcs, and errors that are seeded, of the stated size, and independent of the stepping."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import ATOMS, Atom
from services.simulator.base import Actuator, move, wheel_speeds
from services.simulator.robots import Drive
from services.simulator.world.place import Pose


@given(speed=st.floats(0, 1))
def test_atoms_move_as_they_are_called(speed: float) -> None:
    drive = Drive()
    done = {atom: move(Pose(0, 0, 0), wheel_speeds(atom, drive, speed), drive.track_m, 1.0) for atom in ATOMS}
    assert done["forward"] == Pose(pytest.approx(2.0 * speed), 0.0, 0.0)
    assert done["backward"] == Pose(pytest.approx(-2.0 * speed), 0.0, 0.0)
    assert done["left"].heading == pytest.approx(0.785 * speed)
    assert done["right"].heading == pytest.approx(-0.785 * speed)
    assert (done["left"].x, done["left"].y) == (0, 0), "turning is on the spot"
    assert done["stop"] == Pose(0, 0, 0)


@given(seed=st.integers(0, 2**32 - 1), atoms=st.lists(st.sampled_from(ATOMS), min_size=1, max_size=8))
def test_errors_belong_to_ticks_and_not_to_steps(seed: int, atoms: list[Atom]) -> None:
    coarse, fine = (Actuator(Drive(), np.random.default_rng(seed)) for _ in range(2))
    for atom in atoms:
        whole = coarse.wheels(atom, 1.0, 0.1)
        assert [fine.wheels(atom, 1.0, 0.02) for _ in range(5)] == [whole] * 5
