"""What was learned: Omega = (S, A, T, R, gamma) of the paper with the templates that recognize S, as one file."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats, Int8s, Int32s
from smal.features import Centering, FeatureSettings
from smal.files.stored import Content, Stored
from smal.movement import Atom
from smal.paper.transitions import Transitions

_TRANSITION_ARRAYS = [field.name for field in fields(Transitions) if field.name != "states"]
_MOST = 1e6  # Of a weight in Eq. 7.
#: What stands in the file as it is: arrays, and in its header numbers and tuples. Streams stand one after the other.
_ARRAYS = ("mean", "actions", "reward", "policy", "value")
_NUMBERS = ("sequence_length", "lambda1", "lambda2", "gamma")
_TUPLES = ("names", "successful", "recovery")
_STREAMS = ("state_streams", "atoms")


@dataclass(frozen=True, eq=False)
class PaperModel(Stored):
    """A learned model of the paper's scheme: of demonstrations d, each of f_d frames."""

    scheme = "paper"

    feature_settings: FeatureSettings
    mean: Float32s  # (m,) mean raw feature vector.
    sequence_length: int  # l.
    lambda1: float  # Of Eq. 7.
    lambda2: float
    templates: Float32s  # X (m, n); state j is the columns j * l and following.
    actions: Int8s  # (number of actions, l) atoms of every action.
    state_streams: tuple[
        Int32s, ...
    ]  # (f_d // l,) sequences in time; they end with the last frame.
    atoms: tuple[Int8s, ...]  # (f_d,) atom k was executed between frames k and k + 1.
    names: tuple[str, ...]  # Episode of each demonstration.
    successful: tuple[bool, ...]  # Whether it ended at the goal.
    recovery: tuple[bool, ...]  # Whether it began off the route.
    transitions: Transitions  # T.
    reward: Floats  # R (states,).
    policy: Int32s  # (states,) action of every state; -1 in goals and dead ends.
    value: Floats  # V (states,) of the policy.
    gamma: float  # Discount factor.

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
            # Centred features are of unit length at most.
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
        """Turns raw features into those of the templates."""
        return Centering(self.mean, self.feature_settings)

    @property
    def longest(self) -> int:
        """Frames of the longest drive."""
        return max(map(len, self.atoms))

    def content(self) -> Content:
        """Return what the file says of the model, and the arrays in it."""
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
        """Make it of what a file says."""
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
    """Reject a header with missing or wrong numbers before anything is computed with them."""
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
