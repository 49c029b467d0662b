"""Matching problems: templates cut from streams of frames, and queries that were not among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.float32]

#: Cosine of successive frames of the synthetic video, of its scene alone, and of a query frame with its own frame.
_SUCCESSIVE, _SCENE, _QUERY = 0.9, 0.97, 0.8


@dataclass(frozen=True, eq=False)
class Problem:
    """Templates and queries of one size.

    Parameters
    ----------
    templates : float32 array (m, n), Fortran order
    queries : tuple of float32 arrays (m, l)
    length : int
        l.
    """

    templates: Frames
    queries: tuple[Frames, ...]
    length: int

    @property
    def n(self) -> int:
        """How many template frames there are."""
        return int(self.templates.shape[1])

    @property
    def penalty(self) -> float:
        """Both lambda1 and lambda2."""
        return 0.1 * float(np.sqrt(self.length))


class Dataset(Protocol):
    """Makes problems of any size that its frames allow."""

    @property
    def name(self) -> str: ...

    def problem(self, n: int, length: int, queries: int) -> Problem:
        """Make a problem with n template frames, or as many as there are (Problem.n says how many)."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Frames of rendered streams.

    Parameters
    ----------
    name : str
    taught : sequence of float32 arrays (f, m)
        Streams to cut templates from, in order.
    held_out : sequence of float32 arrays (f, m)
        Streams to cut queries from.
    """

    name: str
    taught: Sequence[Frames]
    held_out: Sequence[Frames]

    def problem(self, n: int, length: int, queries: int) -> Problem:
        """Cut the first sequences, without overlap."""
        cuts = [one[k : k + length] for one in self.taught for k in range(0, len(one) - length + 1, length)]
        rows = np.concatenate(cuts[: n // length])
        windows = [(k, start) for k, one in enumerate(self.held_out) for start in range(len(one) - length + 1)]
        if not windows:
            raise ValueError(f"no held-out stream of {self.name} has {length} frames")
        chosen = np.linspace(0, len(windows) - 1, queries + 2)[1:-1].round().astype(int)
        cut = (self.held_out[k][start : start + length].T for k, start in (windows[i] for i in chosen))
        return Problem(rows.T, tuple(cut), length)


@dataclass(frozen=True)
class Synthetic:
    """A video of a scene that changes smoothly (a random walk of unit vectors), with noise in each frame.

    Queries are noisy views of successive frames at any phase.

    Parameters
    ----------
    frames : int
        Length of the video: the largest n.
    features : int
        m.
    seed : int
    """

    frames: int
    features: int
    seed: int = 1
    name: str = "synthetic"

    @cached_property
    def _video(self) -> Frames:
        rng = np.random.default_rng(self.seed)
        share = np.sqrt(_SUCCESSIVE / _SCENE)
        video = rng.standard_normal((self.frames, self.features), dtype=np.float32)
        scene = rng.standard_normal(self.features, dtype=np.float32)
        for k in range(self.frames):
            step = rng.standard_normal(self.features, dtype=np.float32)
            scene = np.float32(_SCENE) * scene + np.float32(np.sqrt(1.0 - _SCENE**2)) * step
            video[k] *= np.float32(np.sqrt(1.0 - share**2))
            video[k] += np.float32(share) * scene
            video[k] /= np.linalg.norm(video[k])
        return video

    def problem(self, n: int, length: int, queries: int) -> Problem:
        """Take the first n frames as templates, cut without overlap."""
        rng = np.random.default_rng((self.seed, n, length))
        starts = rng.integers(0, n - length, queries, endpoint=True)
        views = tuple(self._view(rng, start, length).T for start in starts)
        return Problem(self._video[:n].T, views, length)

    def _view(self, rng: np.random.Generator, start: int, count: int) -> Frames:
        noise = rng.standard_normal((count, self.features), dtype=np.float32)
        noise /= np.linalg.norm(noise, axis=1, keepdims=True)
        return np.asarray(
            _QUERY * self._video[start : start + count] + np.sqrt(1.0 - _QUERY**2) * noise, dtype=np.float32
        )
