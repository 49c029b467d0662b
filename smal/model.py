"""What was learned: Omega = (S, A, T, R, gamma) of the paper with the templates that recognize S, as one file."""

import os
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from smal import container
from smal.action_space import Atom
from smal.container import ModelError, NoModelError
from smal.features import Centering, FeatureSettings
from smal.novelty import novelty_test
from smal.regular_file import open_regular
from smal.transitions import Transitions
from smal.visual_map import VisualMap

__all__ = ["FORMAT_VERSION", "Model", "ModelError", "NoModelError"]

FORMAT_VERSION = 3

_TRANSITION_ARRAYS = [field.name for field in fields(Transitions) if field.name != "states"]
_STREAMS = ("state_streams", "atoms")


@dataclass(frozen=True, eq=False)
class Model:
    """A learned model; `state` below is a template sequence, `demonstration` is d.

    Parameters
    ----------
    feature_settings : FeatureSettings
    mean : float32 array (m,)
        Mean raw feature vector.
    sequence_length : int
        l.
    lambda1, lambda2 : float
        Of Eq. 7.
    novelty : str
        Name of the test by which states were learned.
    novelty_parameters : dict
        Its parameters.
    templates : float32 array (m, n)
        X; state j is the columns j * l and following.
    actions : int8 array (number of actions, l)
        Atoms of every action.
    state_streams : tuple of int32 arrays (f_d // l,)
        The sequences of every demonstration in time; they end with its last frame.
    atoms : tuple of int8 arrays (f_d,)
        Atom k was executed between frames k and k + 1.
    names : tuple of str
        Episode of each demonstration.
    successful, recovery : tuples of bool
        Whether it ended at the goal; whether it began off the route.
    transitions : Transitions
        T.
    reward : float64 array (states,)
        R.
    policy : int32 array (states,)
        Action of every state; -1 in goals and dead ends.
    value : float64 array (states,)
        V of the policy.
    gamma : float
        Discount factor.
    visual_map : VisualMap, optional
        Where the filter follows the robot; None where no drive to the goal has images.
    """

    feature_settings: FeatureSettings
    mean: NDArray[np.float32]
    sequence_length: int
    lambda1: float
    lambda2: float
    novelty: str
    novelty_parameters: dict[str, float]
    templates: NDArray[np.float32]
    actions: NDArray[np.int8]
    state_streams: tuple[NDArray[np.int32], ...]
    atoms: tuple[NDArray[np.int8], ...]
    names: tuple[str, ...]
    successful: tuple[bool, ...]
    recovery: tuple[bool, ...]
    transitions: Transitions
    reward: NDArray[np.float64]
    policy: NDArray[np.int32]
    value: NDArray[np.float64]
    gamma: float
    visual_map: VisualMap | None = None

    def __post_init__(self) -> None:
        l, states = self.sequence_length, self.transitions.states  # noqa: E741
        checks = {
            "templates": self.templates.shape == (self.feature_settings.size, states * l),
            "mean": self.mean.shape == (self.feature_settings.size,),
            "actions": self.actions.ndim == 2 and self.actions.shape[1] == l,
            "reward": self.reward.shape == (states,),
            "policy": self.policy.shape == (states,) and int(self.policy.max(initial=-1)) < len(self.actions),
            "value": self.value.shape == (states,),
            "names": len(self.names) == len(self.atoms) == len(self.successful) == len(self.recovery)
            and all(isinstance(name, str) for name in self.names),
            "state_streams": [len(s) for s in self.state_streams] == [len(a) // l for a in self.atoms]
            and all(_within(stream, 0, states - 1) for stream in self.state_streams),
            "atoms": all(_within(atoms, min(Atom), max(Atom)) for atoms in (*self.atoms, self.actions)),
            "finite": bool(np.isfinite(self.reward).all() and np.isfinite(self.value).all()),
        }
        wrong = [name for name, fits in checks.items() if not fits]
        if not wrong and self.visual_map is not None:
            of_images = self.centering.of_images()
            if of_images is None or len(self.visual_map.basis) != of_images.settings.size:
                wrong.append("map")
            if not {name for names in self.visual_map.names for name in names} <= set(self.names):
                wrong.append("names of the map")
        if wrong:
            raise ValueError(f"the parts of the model do not fit together: {', '.join(wrong)}")
        novelty_test(self.novelty, self.novelty_parameters)

    @property
    def states(self) -> int:
        """Number of states."""
        return self.transitions.states

    @property
    def shared_states(self) -> int:
        """Number of states that occur in at least two demonstrations; without any the graph is a set of chains."""
        each = np.concatenate([np.unique(stream) for stream in self.state_streams])
        return int((np.bincount(each, minlength=self.states) >= 2).sum())

    @property
    def centering(self) -> Centering:
        """Turns raw features into those of the templates."""
        return Centering(self.mean, self.feature_settings)

    @property
    def mapped(self) -> VisualMap:
        """The map of views.

        Raises
        ------
        ValueError
            There is none.
        """
        if self.visual_map is None:
            raise ValueError(
                "the model has no map of views: no drive to the goal that it was learned from has images; "
                "learn it again, or use the paper's scheme"
            )
        return self.visual_map

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of all that the model holds, in hex: the one with which its file ends."""
        return container.checksum(FORMAT_VERSION, *self._content())

    def __repr__(self) -> str:
        """Say what it is, not all its numbers."""
        return (
            f"Model({self.states} states, {len(self.actions)} actions, l = {self.sequence_length}, "
            f"{'+'.join(self.feature_settings.modalities)}, {len(self.names)} demonstrations)"
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model to a file; an existing one is replaced only when the new one is complete."""
        container.write(Path(path), FORMAT_VERSION, *self._content())

    def _content(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what the file says of the model, and the arrays in it."""
        arrays: dict[str, NDArray[Any]] = {
            "mean": self.mean,
            "templates": self.templates.T,
            "actions": self.actions,
            "reward": self.reward,
            "policy": self.policy,
            "value": self.value,
        }
        arrays |= {f"transitions.{name}": getattr(self.transitions, name) for name in _TRANSITION_ARRAYS}
        arrays |= {name: np.concatenate(getattr(self, name)) for name in _STREAMS}
        meta = {
            "modalities": self.feature_settings.modalities,
            "modality_weights": self.feature_settings.weights,
            "feature_fingerprint": self.feature_settings.fingerprint,
            "sequence_length": self.sequence_length,
            "lambda1": self.lambda1,
            "lambda2": self.lambda2,
            "novelty": self.novelty,
            "novelty_parameters": self.novelty_parameters,
            "names": self.names,
            "frames": [len(atoms) for atoms in self.atoms],
            "successful": self.successful,
            "recovery": self.recovery,
            "states": self.states,
            "gamma": self.gamma,
            "map": None,
        }
        if self.visual_map is not None:
            meta["map"], parts = self.visual_map.content()
            arrays |= {f"map.{name}": array for name, array in parts.items()}
        return meta, arrays

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read the model in a file; see `read`."""
        try:
            descriptor = open_regular(Path(path))
        except OSError as error:
            raise NoModelError(f"{path}: cannot be read: {error.strerror}") from error
        with os.fdopen(descriptor, "rb") as file:
            return cls.read(file, str(path))

    @classmethod
    def read(cls, file: IO[bytes], name: str) -> Self:
        """Read a model from an open file, which errors call `name`.

        Nothing but this file is opened, whatever it says.

        Raises
        ------
        NoModelError
            The file cannot be read, is too large, or does not begin as a model does.
        ModelError
            It is of another version, truncated, altered or inconsistent, or was learned on features that this
            program computes differently.
        """
        meta, arrays, checksum = container.read(file, name, FORMAT_VERSION)
        try:
            _check_numbers(meta)
            settings = FeatureSettings(tuple(meta["modalities"]), tuple(meta["modality_weights"]))
            if settings.fingerprint != meta["feature_fingerprint"]:
                raise ValueError("it was learned on features that this version computes differently; learn it again")
            frames, length = np.array(meta["frames"]), meta["sequence_length"]
            parts = dict.fromkeys(_STREAMS, frames // length) | {"atoms": frames}
            streams: dict[str, Any] = {
                name: tuple(np.split(arrays[name], np.cumsum(parts[name])[:-1])) for name in _STREAMS
            }
            if [len(atoms) for atoms in streams["atoms"]] != meta["frames"]:
                raise ValueError("its demonstrations are not as long as it says")
            named: dict[str, Any] = {name: arrays[f"transitions.{name}"] for name in _TRANSITION_ARRAYS}
            same: dict[str, Any] = {name: arrays[name] for name in ("mean", "actions", "reward", "policy", "value")}
            same |= {name: tuple(meta[name]) for name in ("names", "successful", "recovery")}
            same |= {name: meta[name] for name in ("novelty", "novelty_parameters")}
            same |= {name: meta[name] for name in ("sequence_length", "lambda1", "lambda2", "gamma")}
            model = cls(
                feature_settings=settings,
                templates=arrays["templates"].T,
                transitions=Transitions(**named, states=meta["states"]),
                visual_map=_visual_map(meta["map"], arrays),
                **same,
                **streams,
            )
        except (LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise ModelError(f"{name}: {container.one_line(error)}") from error
        # Known from the file: hashing all templates again would delay the start of a service.
        vars(model)["checksum"] = checksum
        return model


def _within(numbers: NDArray[Any], low: int, high: int) -> bool:
    return numbers.dtype.kind == "i" and low <= int(numbers.min(initial=low)) and int(numbers.max(initial=high)) <= high


def _visual_map(numbers: dict[str, Any] | None, arrays: dict[str, NDArray[Any]]) -> VisualMap | None:
    """Make the map of what a file says of it."""
    if numbers is None:
        return None
    parts: dict[str, Any] = {name[4:]: array for name, array in arrays.items() if name.startswith("map.")}
    goals, names = numbers["goals"], numbers["names"]
    if not (isinstance(goals, list) and isinstance(names, list) and all(isinstance(each, list) for each in names)):
        raise TypeError("the goals of the map must be a list, and the names of its drives lists")
    return VisualMap(**numbers | {"goals": tuple(goals), "names": tuple(map(tuple, names))}, **parts)


def _check_numbers(meta: dict[str, Any]) -> None:
    """Reject a header with missing or wrong numbers before anything is computed with them."""
    counts, reals = ("sequence_length", "states"), ("lambda1", "lambda2", "gamma")
    wrong = [name for name in counts if type(meta[name]) is not int or meta[name] < 1]
    wrong += [name for name in reals if type(meta[name]) not in (int, float)]
    if wrong:
        raise ValueError(f"not a number that a model could have: {', '.join(wrong)}")
