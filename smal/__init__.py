"""Sequence-based Multimodal Apprenticeship Learning (Han, Yang, Zhang & Zhang, ICRA 2017), the pure method.

Read in the order of the paper: `features`, `objective`, `state_matching`, `state_space`, `action_space`,
`transitions`, `reward`, `policy`; `learning` and `execution` put them together around a `model`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smal.state_matching import Solution, solve, solve_from_correlations
    from smal.streaming import StreamingMatcher
    from smal.template_index import TemplateIndex

_FILES = {
    "Solution": "state_matching",
    "StreamingMatcher": "streaming",
    "TemplateIndex": "template_index",
    "solve": "state_matching",
    "solve_from_correlations": "state_matching",
}
__all__ = ["Solution", "StreamingMatcher", "TemplateIndex", "solve", "solve_from_correlations"]


def __getattr__(name: str) -> object:
    """Import what is asked for, when it is: a process that only extracts features needs no compiler."""
    if name not in _FILES:
        raise AttributeError(f"module 'smal' has no attribute {name!r}")
    return getattr(import_module(f"smal.{_FILES[name]}"), name)
