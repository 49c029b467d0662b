"""Sequence-based Multimodal Apprenticeship Learning (Han, Yang, Zhang & Zhang, ICRA 2017), the pure method.

Read in the order of the paper: `features`, `objective`, `state_matching`, `state_space`, `action_space`,
`transitions`, `reward`, `policy`; `learning` and `execution` put them together around a `model`.
"""

from smal.state_matching import Solution, solve, solve_from_correlations
from smal.streaming import StreamingMatcher
from smal.template_index import TemplateIndex

__all__ = ["Solution", "StreamingMatcher", "TemplateIndex", "solve", "solve_from_correlations"]
