"""A belief that crosses the bus."""

import math
from dataclasses import fields

import numpy as np
import pytest

from schemas.state import State
from services.kit.belief import belief_of, fields_of
from smal.filter import Belief
from smal.robot import Located


@pytest.mark.parametrize("support", [4.5, math.inf])
def test_belief_is_whole_after_it_crosses_the_bus(support: float) -> None:
    belief = Belief(
        keyframes=np.array([3, 1]),
        offsets=np.array([[0.5, -0.25, 0.125], [0.0, 0.0, 1.0]]),
        weights=np.array([0.75, 0.25]),
        lost=0.125,
        cosine=0.5,
        tracked=2.5,
        evidence=-1.5,
        unseen=0.75,
        camera="frozen",
        support=support,
        pitch_deg=-2.5,
        moved=0.25,
    )
    head = {"robot": "rescue", "episode": "drive-0", "tick": 1, "stamp_ns": 1}
    sent = fields_of(Located(belief, belief, None, math.inf))
    state = State.model_validate(head | {"model": "0" * 16} | sent)
    received = belief_of(state)
    for field in fields(Belief):
        expected = getattr(belief, field.name)
        if field.name == "support":
            expected = min(expected, 1e9)
        np.testing.assert_array_equal(getattr(received, field.name), expected, field.name)
