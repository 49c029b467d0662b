"""Places, tasks and world files; independent of the renderer."""

from services.simulator.world.loading import known_worlds, load_foreign_world, load_world
from services.simulator.world.place import Pose, World, WorldError

__all__ = ["Pose", "World", "WorldError", "known_worlds", "load_foreign_world", "load_world"]
