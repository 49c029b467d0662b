"""The learned Omega = (S, A, T, R, gamma) of the paper with the templates that recognize S, as one file."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats, Int8s, Int32s
from smal.features import Centering, FeatureSettings
from smal.files.stored import Content, Stored
from smal.movement import Atom
from smal.paper.transitions import Transitions

_TRANSITION_ARRAYS = [field.name for field in fields(Transitions) if field.name != "states"]
_MOST = 1e6  # Maximum of a weight in Eq. 7.
#: Parts that are stored unchanged: arrays, and numbers and tuples in the header. Streams are concatenated.
_ARRAYS = ("mean", "actions", "reward", "policy", "value")
_NUMBERS = ("sequence_length", "lambda1", "lambda2", "gamma")
_TUPLES = ("names", "successful", "recovery")
_STREAMS = ("state_streams", "atoms")


@dataclass(frozen=True, eq=False)
class PaperModel(Stored):
    """A learned model of the paper's scheme, from demonstrations d of f_d frames each."""

    scheme = "paper"

    feature_settings: FeatureSettings
    #: (m,) mean raw feature vector.
    mean: Float32s
    #: l.
    sequence_length: int
    #: Weights of Eq. 7.
    lambda1: float
    lambda2: float
    #: X (m, n); state j is the columns j * l and following.
    templates: Float32s
    #: (number of actions, l) atoms of every action.
    actions: Int8s
    #: (f_d // l,) sequences in time; they end with the last frame.
    state_streams: tuple[Int32s, ...]
    #: (f_d,) atom k was executed between frames k and k + 1.
    atoms: tuple[Int8s, ...]
    #: Episode of each demonstration.
    names: tuple[str, ...]
    #: Whether it ended at the goal.
    successful: tuple[bool, ...]
    #: Whether it started off the route.
    recovery: tuple[bool, ...]
    #: T.
    transitions: Transitions
    #: R (states,).
    reward: Floats
    #: (states,) action of every state; -1 in goals and dead ends.
    policy: Int32s
    #: V (states,) of the policy.
    value: Floats
    #: Discount factor.
    gamma: float

    def __post_init__(self) -> None:
        checks = self._arrays_fit() | self._drives_fit()
        wrong = [name for name, fits in checks.items() if not fits]
        if wrong:
            raise ValueError(f"the parts of the model do not fit together: {', '.join(wrong)}")

    def _arrays_fit(self) -> dict[str, bool]:
        states = self.transitions.states
        length = self.sequence_length
        size = self.feature_settings.size
        return {
            # Centred features have at most unit length.
            "templates": self.templates.shape == (size, states * length)
            and self.templates.dtype.kind == "f"
            and bool((np.abs(self.templates) <= 1.01).all()),
            "mean": self.mean.shape == (size,),
            "actions": self.actions.ndim == 2 and self.actions.shape[1] == length,
            "transitions": self.transitions.sound,
            "reward": self.reward.shape == (states,),
            "value": self.value.shape == (states,),
            "finite": bool(np.isfinite(self.reward).all() and np.isfinite(self.value).all()),
            "policy": self.policy.shape == (states,)
            and _within(self.policy, -1, len(self.actions) - 1),
        }

    def _drives_fit(self) -> dict[str, bool]:
        sequences = [len(atoms) // self.sequence_length for atoms in self.atoms]
        streams = self.state_streams
        counts = {*map(len, (self.names, self.atoms, self.successful, self.recovery))}
        every = (*self.atoms, self.actions)
        return {
            "names": len(counts) == 1 and all(isinstance(name, str) for name in self.names),
            "state_streams": [*map(len, streams)] == sequences
            and all(_within(stream, 0, self.transitions.states - 1) for stream in streams),
            "atoms": all(_within(atoms, min(Atom), max(Atom)) for atoms in every),
        }

    @property
    def states(self) -> int:
        """Number of states."""
        return self.transitions.states

    @property
    def centering(self) -> Centering:
        """Converts raw features to those of the templates."""
        return Centering(self.mean, self.feature_settings)

    @property
    def longest(self) -> int:
        """Number of frames of the longest drive."""
        return max(map(len, self.atoms))

    def content(self) -> Content:
        """Return the metadata and the arrays of the model file."""
        arrays = {"templates": self.templates.T} | {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {
            f"transitions.{name}": getattr(self.transitions, name) for name in _TRANSITION_ARRAYS
        }
        arrays |= {name: np.concatenate(getattr(self, name)) for name in _STREAMS}
        meta = {"frames": [len(atoms) for atoms in self.atoms], "states": self.states}
        meta |= {name: getattr(self, name) for name in (*_NUMBERS, *_TUPLES)}
        return self.feature_settings.content | meta, arrays

    @classmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, AnyArray]) -> Self:
        """Build the model from the content of a file."""
        _check_numbers(meta)
        frames = np.array(meta["frames"])
        length = meta["sequence_length"]
        parts = dict.fromkeys(_STREAMS, frames // length) | {"atoms": frames}
        ends = {name: np.cumsum(parts[name])[:-1] for name in _STREAMS}
        streams: dict[str, Any] = {
            name: tuple(np.split(arrays[name], ends[name])) for name in _STREAMS
        }
        if [len(atoms) for atoms in streams["atoms"]] != meta["frames"]:
            raise ValueError("its demonstrations are not as long as it says")
        named: dict[str, Any] = {name: arrays[f"transitions.{name}"] for name in _TRANSITION_ARRAYS}
        same: dict[str, Any] = {name: arrays[name] for name in _ARRAYS}
        same |= {name: tuple(meta[name]) for name in _TUPLES} | {
            name: meta[name] for name in _NUMBERS
        }
        return cls(
            feature_settings=FeatureSettings.of_content(meta),
            templates=arrays["templates"].T,
            transitions=Transitions(**named, states=meta["states"]),
            **same,
            **streams,
        )


def _within(numbers: AnyArray, low: int, high: int) -> bool:
    return (
        numbers.dtype.kind == "i"
        and low <= int(numbers.min(initial=low))
        and int(numbers.max(initial=high)) <= high
    )


def _check_numbers(meta: dict[str, Any]) -> None:
    """Raise ValueError for a header with wrong numbers, before any computation with them."""
    counts = ("sequence_length", "states")
    reals = ("lambda1", "lambda2", "gamma")
    wrong = [name for name in counts if type(meta[name]) is not int or meta[name] < 1]
    wrong += [
        name
        for name in reals
        if type(meta[name]) not in (int, float) or not 0.0 <= meta[name] <= _MOST
    ]
    wrong += [] if "gamma" in wrong or meta["gamma"] < 1.0 else ["gamma"]
    if wrong:
        raise ValueError(f"not a number that a model could have: {', '.join(wrong)}")
