"""Sequence-based Multimodal Apprenticeship Learning (Han, Yang, Zhang & Zhang, ICRA 2017), the pure method.

Read in the order of the paper: `features`, `objective`, `state_matching`, `state_space`, `action_space`,
`transitions`, `reward`, `policy`; `learning` puts them together to a `model`, `recognition` and `decision` execute it.
Beside it are `place_recognition`, the same matching on two traverses, and `evaluation`.

Words of the paper and of this project:

frame
    One camera image, and the features of it: a vector of m numbers.
sequence
    l successive frames; template sequences are those that states were made of.
state
    What a sequence shows; state j is the columns j l to j l + l - 1 of X, its template, a block of rows of W.
phase
    The frame of a state's template at which the last frame of a query is.
atom
    The movement until the next frame (the paper's atom movement); l of them are an action.
recovery
    A short demonstrated drive from beside the way back onto it.
traverse
    One drive along a route as a folder of images: one of references, one of queries.
polar
    Of the penalties in Eq. 7: how far a point is outside of the dual problem (`matching.certificate`).
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smal.action_space import Atom
    from smal.decision import Decision, DecisionMaker
    from smal.features import FeatureSettings, extract
    from smal.filter import Belief
    from smal.learning import Demonstration, LearningReport, LearningSettings, fit, learn
    from smal.matching.streaming import StreamingMatcher
    from smal.model import Model
    from smal.recognition import Recognition, Recognizer
    from smal.robot import Robot
    from smal.state_matching import Solution, solve

_FILES = {
    "Atom": "action_space",
    "Belief": "filter",
    "Decision": "decision",
    "DecisionMaker": "decision",
    "Demonstration": "learning",
    "FeatureSettings": "features",
    "LearningReport": "learning",
    "LearningSettings": "learning",
    "Model": "model",
    "Recognition": "recognition",
    "Recognizer": "recognition",
    "Robot": "robot",
    "Solution": "state_matching",
    "StreamingMatcher": "matching.streaming",
    "extract": "features",
    "fit": "learning",
    "learn": "learning",
    "solve": "state_matching",
}
__all__ = [
    "Atom",
    "Belief",
    "Decision",
    "DecisionMaker",
    "Demonstration",
    "FeatureSettings",
    "LearningReport",
    "LearningSettings",
    "Model",
    "Recognition",
    "Recognizer",
    "Robot",
    "Solution",
    "StreamingMatcher",
    "extract",
    "fit",
    "learn",
    "solve",
]


def __getattr__(name: str) -> object:
    """Import what is asked for, when it is: a process that only extracts features needs no compiler."""
    if name not in _FILES:
        raise AttributeError(f"module 'smal' has no attribute {name!r}")
    return getattr(import_module(f"smal.{_FILES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
