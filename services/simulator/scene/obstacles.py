"""What stands in the way, as meshes with what they wear."""

from collections.abc import Iterable, Iterator

from services.simulator.scene.meshes import block
from services.simulator.scene.surfaces import Finish, Piece
from services.simulator.world.obstacles import Obstacle


def obstacles(things: Iterable[Obstacle]) -> Iterator[Piece]:
    """Yield their parts where they stand."""
    for thing in things:
        for part in thing.parts:
            yield Finish(part.wears), block(part.box, part.low_m, part.high_m).placed(thing.pose)
