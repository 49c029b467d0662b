"""Execution (paper, section IV): l frames, their state, its action, l atom movements, until the victim is found.

`Recognizer` (`smal.recognition`) turns frames into states, `DecisionMaker` (`smal.decision`) states into atoms.
"""

from smal.decision import Decision, DecisionMaker
from smal.recognition import Candidate, Recognition, Recognizer

__all__ = ["Candidate", "Decision", "DecisionMaker", "Recognition", "Recognizer"]
