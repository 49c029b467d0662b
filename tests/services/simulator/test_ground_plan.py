"""The ground plan of a world, which the page draws under the map."""

import pytest

from schemas.rpc import MOST_SHAPES
from services.simulator.plan import plan_of
from services.simulator.world import load_world


@pytest.mark.parametrize(("name", "kinds"), [("yard", {"street", "solid"}), ("indoor", {"solid"})])
def test_ground_plan_holds_streets_and_solids(name: str, kinds: set[str]) -> None:
    plan = plan_of(load_world(name))
    assert plan.world == name
    assert kinds <= {one.kind for one in plan.shapes}
    assert len(plan.shapes) <= MOST_SHAPES
    # The edge of the world is a line: filled it would hide the world.
    assert any(not one.filled for one in plan.shapes)
