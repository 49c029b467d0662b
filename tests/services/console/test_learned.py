"""Beliefs about places that the model lacks are not drawn."""

from schemas.state import State
from services.console.learned import learned_of
from services.kit.model_service import identity_of
from tests import corridor
from tests.places import places
from tests.services.recordings.recorded_messages import header


def test_a_belief_is_not_drawn_when_its_places_are_unknown() -> None:
    learned = learned_of(corridor.model(), None, {})
    last = len(corridor.model().mapped.keyframes) - 1
    for keyframes, drawn in (((last,), True), ((last + 1,), False), ((last, 1_000_000), False)):
        where = places(*[(key, 0.0, 0.0, 0.0, 0.5) for key in keyframes])
        state = State.after(
            header("e", 0), status="recognized", model=identity_of(corridor.model()), places=where
        )
        assert bool(learned.belief(state)) is drawn
