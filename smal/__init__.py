"""Teach a robot a way by driving it once; the robot then drives it by camera and odometry.

Read in this order. `robot` processes a frame. Its `filter` estimates the place in the `model`, a map of the views of a
`camera` along the way. `particles` represent possible places, `likelihood` weighs a view at a place, and `movement`
models the odometry. `planning` decides the motion. `recordings` reads recordings of the services.

`teaching` builds the map from drives; driving imports nothing from it. `target` detects the target, and `obstacles`
plans around obstacles. Beside these are `paper`, all of Sequence-based Multimodal Apprenticeship Learning (Han, Yang,
Zhang & Zhang, ICRA 2017), `place_recognition` between two traverses, and `evaluation`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smal import recordings as recordings
    from smal.features import FeatureSettings as FeatureSettings
    from smal.features import extract as extract
    from smal.filter import Belief as Belief
    from smal.model import Model as Model
    from smal.movement import Atom as Atom
    from smal.paper.state_matching import Solution as Solution
    from smal.paper.state_matching import solve as solve
    from smal.place_recognition.matching import match as match
    from smal.planning import Decision as Decision
    from smal.robot import Robot as Robot
    from smal.teaching.demonstration import Demonstration as Demonstration
    from smal.teaching.mapping import fit as fit
    from smal.teaching.mapping import learn as learn

_FILES = {
    "Atom": "movement",
    "Belief": "filter",
    "Decision": "planning",
    "Demonstration": "teaching.demonstration",
    "FeatureSettings": "features",
    "Model": "model",
    "Robot": "robot",
    "Solution": "paper.state_matching",
    "extract": "features",
    "fit": "teaching.mapping",
    "learn": "teaching.mapping",
    "match": "place_recognition.matching",
    "recordings": "recordings",
    "solve": "paper.state_matching",
}
__all__ = list(_FILES)


def __getattr__(name: str) -> object:
    """Import a public name on first use: a process that only extracts features loads nothing else."""
    if name not in _FILES:
        raise AttributeError(f"module 'smal' has no attribute {name!r}")
    module = import_module(f"smal.{_FILES[name]}")
    return getattr(module, name, module)


def __dir__() -> list[str]:
    return __all__
