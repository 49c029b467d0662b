"""Precision and recall of recognizing where the robot is, as in the paper's experiments.

Queries are frames of drives that were not learned from, clean or degraded. Every method says at which demonstrated
frame the robot is, and how sure it is; that is right if the frame was taken near the true pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import Degradation, Degrader
from services.experiments.evaluation.drives import Drive, views_of_expert
from services.experiments.evaluation.plan import JUDGED_TICKS, Criterion
from services.simulator.simulation import Simulation
from smal.evaluation.baselines.seqslam_localization import (
    SEQSLAM,
    SEQSLAM_FEATURES,
    SeqSlamLocalizer,
    seqslam_templates,
)
from smal.evaluation.ground_truth import PoseTruth, judge
from smal.evaluation.localization import DemonstratedFrames
from smal.features import Centering, FeatureSettings, extract
from smal.paper.model import Model
from smal.paper.phase import matched_phase
from smal.paper.state_matching import solve
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.nearest_sequence import match_nearest_sequence

#: Of all drives and queries.
FEATURES: Final = FeatureSettings()


def query_drive(simulation: Simulation, seed: int, views: Mapping[str, Degradation]) -> dict[str, NDArray[Any]]:
    """Have the expert drive a way that is not learned from, and keep what the robot sees under every degradation.

    The simulation is opened with their shake. Returns ``poses`` (f, 3), and for every view NAME ``features_NAME``
    (f, m) and ``seqslam_NAME``, what SeqSLAM looks at.
    """
    degraders = {name: Degrader(how, seed) for name, how in views.items()}
    poses: list[tuple[float, float, float]] = []
    kept: dict[str, list[NDArray[Any]]] = {f"{part}_{name}": [] for name in views for part in ("features", "seqslam")}
    for tick, (view, _) in enumerate(views_of_expert(simulation, seed)):
        poses.append((view.pose.x, view.pose.y, view.pose.heading))
        for name, degrader in degraders.items():
            seen = degrader.apply(tick, view.image)
            kept[f"features_{name}"].append(extract(seen, FEATURES))
            kept[f"seqslam_{name}"].append(extract(seen, SEQSLAM_FEATURES))
    return {"poses": np.array(poses)} | {name: np.stack(of_it) for name, of_it in kept.items()}


def recognize(
    method: str, length: int, model: Model | None, taught: Sequence[Drive], views: NDArray[np.float32]
) -> Matches:
    """Return the demonstrated frame, counted over all drives, and the score of each view of a held-out drive.

    The views are raw features (f, m): SeqSLAM's for it, the usual ones for Eq. 9 (``smal``, with its model) and
    ``nearest``.
    """
    if model is not None:
        return recognize_states(model, views, JUDGED_TICKS)
    demonstrations = [one.demonstration for one in taught]
    if method == "seqslam":
        localizer = SeqSlamLocalizer(seqslam_templates(demonstrations), replace(SEQSLAM, length=length))
        return _by_seqslam(localizer, [len(one.poses) for one in taught], views)
    raw = [one.features for one in demonstrations]
    centering = Centering.fit(raw, FEATURES)
    return recognize_nearest([centering.apply(each) for each in raw], centering.apply(views), length)


def recognize_states(model: Model, views: NDArray[np.float32], every: int = 1) -> Matches:
    """Recognize states (Eq. 9) at every so many frames, and where in them the robot is by W.

    The score is the weight of the best sequence (left side of Eq. 8, for each query frame).
    """
    length, frames = model.sequence_length, DemonstratedFrames(model)
    matches, centred = Matches.none(len(views)), model.centering.apply(views)
    for tick in range(length - 1, len(views)):
        if (tick + 1) % every != 0:
            continue
        window = centred[tick - length + 1 : tick + 1].T
        solution = solve(model.templates, window, length, model.lambda1, model.lambda2, tolerance=1e-3)
        if (state := solution.best_block) is not None:
            matches.reference[tick] = frames.frame(state, matched_phase(solution, state))
            matches.score[tick] = solution.block_weights.max() / length
    return matches


def _by_seqslam(localizer: SeqSlamLocalizer, lengths: list[int], views: NDArray[np.float32]) -> Matches:
    """Take the mean enhanced difference, whose least is the best, as the score with its sign changed."""
    starts = np.cumsum([0, *lengths])
    matches = Matches.none(len(views))
    for tick, view in enumerate(views):
        if (place := localizer.observe(view)) is not None:
            matches.reference[tick] = starts[place.demonstration] + place.frame
            matches.score[tick] = -place.cost
    return matches


def recognize_nearest(drives: list[NDArray[np.float32]], views: NDArray[np.float32], length: int) -> Matches:
    """Match each window with the most alike one of all drives, none of which spans two."""
    found = [match_nearest_sequence(each, views, length) for each in drives]
    starts = np.cumsum([0, *map(len, drives[:-1])])
    scores = np.stack([np.where(one.matched, one.score, -np.inf) for one in found])
    references = np.stack([start + one.reference for start, one in zip(starts, found, strict=True)])
    best, every = scores.argmax(axis=0), np.arange(len(views))
    matched = np.isfinite(scores.max(axis=0))
    return Matches(np.where(matched, references[best, every], NONE), np.where(matched, scores[best, every], 0.0))


def judged(
    matches: Matches, demonstrated: NDArray[np.float64], true: NDArray[np.float64], criteria: Sequence[Criterion]
) -> dict[str, Any]:
    """Hold every `JUDGED_TICKS`-th answer against the truth, poses (n, 3) and (f, 3), in numbers that JSON knows.

    Returns
    -------
    dict
        For every query ``score`` and ``answered``; and for every criterion ``right`` and ``findable``, lists of lists.
    """
    every = slice(JUDGED_TICKS - 1, None, JUDGED_TICKS)
    asked, there = Matches(matches.reference[every], matches.score[every]), true[every]
    judgements = [judge(asked, PoseTruth(demonstrated, there, one.distance_m, one.angle_deg)) for one in criteria]
    return {
        "score": [float(f"{score:.6g}") for score in asked.score.tolist()],
        "answered": asked.matched.astype(int).tolist(),
        "right": [one.right.astype(int).tolist() for one in judgements],
        "findable": [one.findable.astype(int).tolist() for one in judgements],
    }
