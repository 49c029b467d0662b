"""Precision and recall of recognizing where the robot is, as in the paper's experiments.

Queries are frames of drives that were not learned from, clean or degraded. Every method says at which demonstrated
frame the robot is, and how sure it is; that is right if the frame was taken near the true pose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.rpc import ResetRequest
from services.experiments.evaluation.controllers import SEQSLAM, SEQSLAM_FEATURES, seqslam_templates
from services.experiments.evaluation.degradation import Degradation, Degrader, degradation_named
from services.experiments.evaluation.demonstrations import expert_of
from services.experiments.evaluation.plan import JUDGED_TICKS, Criterion, Recognizer
from services.experiments.evaluation.worker_cache import Workplace, query_file, replace_file
from services.expert.driver import DRIVE_TICKS
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from smal.evaluation.baselines.seqslam_localization import SeqSlamLocalizer
from smal.evaluation.ground_truth import PoseTruth, judge
from smal.evaluation.localization import DemonstratedFrames
from smal.features import Centering, FeatureSettings, extract
from smal.paper.matching.streaming import StreamingMatcher
from smal.paper.model import Model
from smal.paper.phase import matched_phase
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.nearest_sequence import match_nearest_sequence


def query_drive(
    simulation: Simulation, features: FeatureSettings, seed: int, views: dict[str, Degradation]
) -> dict[str, NDArray[Any]]:
    """Have the expert drive, and keep what the robot sees under every degradation.

    Parameters
    ----------
    simulation
        Opened with the shake of the degradations.
    features
        To keep of every view.
    seed
        Of the drive, one that was not learned from.
    views
        Degradations by name.

    Returns
    -------
    dict
        ``poses`` (f, 3), and for every view NAME ``features_NAME`` (f, m) and ``seqslam_NAME``, what SeqSLAM looks at.
    """
    request = ResetRequest(seed=seed, purpose="drive", driver="expert", max_ticks=DRIVE_TICKS)
    episode = LockstepEpisode(simulation, request)
    expert = expert_of(simulation)
    degraders = {name: Degrader(how, seed) for name, how in views.items()}
    poses: list[tuple[float, float, float]] = []
    parts = [f"{part}_{name}" for name in views for part in ("features", "seqslam")]
    kept: dict[str, list[NDArray[Any]]] = {part: [] for part in parts}
    while episode.outcome is None:
        image, pose = episode.view.image, episode.view.pose
        poses.append((pose.x, pose.y, pose.heading))
        for name, degrader in degraders.items():
            seen = degrader.apply(episode.tick, image)
            kept[f"features_{name}"].append(extract(seen, features))
            kept[f"seqslam_{name}"].append(extract(seen, SEQSLAM_FEATURES))
        if expert.arrived(pose.x, pose.y):
            break
        episode.step(expert.key(*poses[-1]))
    return {"poses": np.array(poses)} | {name: np.stack(views) for name, views in kept.items()}


def make_queries(workplace: Workplace, world: str, seed: int, degradations: tuple[str, ...]) -> dict[str, Any]:
    """Make a held-out drive once for every strength of shake, and write what is seen of it."""
    arrays: dict[str, NDArray[Any]] = {}
    named = {name: degradation_named(name) for name in degradations}
    for shake in dict.fromkeys(how.shake for how in named.values()):
        views = {name: how for name, how in named.items() if how.shake == shake}
        made = query_drive(workplace.simulation(world, shake), workplace.features, seed, views)
        # Shake moves the camera and not the robot: the way is the same.
        arrays |= made
    replace_file(workplace.folder / query_file(world, seed), arrays.items())
    return {"frames": len(arrays["poses"]), "files": [query_file(world, seed)]}


def recognize(
    workplace: Workplace, world: str, drives: int, recognizer: Recognizer, degradation: str, seed: int
) -> tuple[Matches, NDArray[np.float64]]:
    """Have a method recognize every `JUDGED_TICKS`-th frame of a held-out drive.

    Returns
    -------
    matches
        Demonstrated frame, counted over all demonstrations, and score of every query.
    poses : float64 array (q, 3)
        The true ones.
    """
    matches, poses = _recognize_all(workplace, world, drives, recognizer, degradation, seed)
    judged = slice(JUDGED_TICKS - 1, None, JUDGED_TICKS)
    return Matches(matches.reference[judged], matches.score[judged]), poses[judged]


def _recognize_all(
    workplace: Workplace, world: str, drives: int, recognizer: Recognizer, degradation: str, seed: int
) -> tuple[Matches, NDArray[np.float64]]:
    with np.load(workplace.folder / query_file(world, seed), allow_pickle=False) as held:
        poses = held["poses"]
        part = "seqslam" if recognizer.name == "seqslam" else "features"
        views = held[f"{part}_{degradation}"]
    if recognizer.name == "smal":
        model = workplace.model(world, drives, recognizer.length)
        if sum(map(len, model.atoms)) != len(workplace.poses(world, drives)):
            raise ValueError(f"the drives in {workplace.folder} are not those that the model was learned from")
        return recognize_states(model, views, JUDGED_TICKS), poses
    taught = workplace.drives(world, drives)
    if recognizer.name == "seqslam":
        localizer = SeqSlamLocalizer(seqslam_templates(taught), replace(SEQSLAM, length=recognizer.length))
        matches = _by_seqslam(localizer, [len(one.poses) for one in taught], views)
    else:
        raw = [one.demonstration.features for one in taught]
        centering = Centering.fit(raw, workplace.features)
        templates = [centering.apply(each) for each in raw]
        matches = recognize_nearest(templates, centering.apply(views), recognizer.length)
    return matches, poses


def recognize_states(model: Model, views: NDArray[np.float32], every: int = 1) -> Matches:
    """Recognize states (Eq. 9) at every so many frames, and where in them the robot is by W.

    The score is the weight of the best sequence (left side of Eq. 8, for each query frame).
    """
    length, frames = model.sequence_length, DemonstratedFrames(model)
    matcher = StreamingMatcher(model.templates, length, model.lambda1, model.lambda2, tolerance=1e-3)
    matches = Matches.none(len(views))
    for tick, view in enumerate(model.centering.apply(views)):
        matcher.observe(view)
        if not matcher.ready or (tick + 1) % every != 0:
            continue
        solution = matcher.match()
        if (state := solution.best_block) is not None:
            matches.reference[tick] = frames.frame(state, matched_phase(solution, state))
            matches.score[tick] = solution.block_weights.max() / length
    return matches


def _by_seqslam(localizer: SeqSlamLocalizer, lengths: list[int], views: NDArray[np.float32]) -> Matches:
    """Take the mean enhanced difference, whose least is the best, as the score with its sign changed."""
    starts = np.cumsum([0, *lengths])
    matches = Matches.none(len(views))
    for tick, view in enumerate(views):
        place = localizer.observe(view)
        if place is not None:
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
    matches: Matches,
    demonstrated: NDArray[np.float64],
    true: NDArray[np.float64],
    criteria: tuple[Criterion, ...],
) -> dict[str, Any]:
    """Hold the answers against the truth, in numbers that JSON knows.

    Returns
    -------
    dict
        For every query ``score``, ``answered``, ``apart_m`` (distance of the answer's pose; -1 without one);
        and for every criterion ``right`` and ``findable``, lists of lists.
    """
    judgements = [judge(matches, PoseTruth(demonstrated, true, one.distance_m, one.angle_deg)) for one in criteria]
    apart_m = np.hypot(*(demonstrated[matches.reference, :2] - true[:, :2]).T)
    return {
        "score": [float(f"{score:.6g}") for score in matches.score.tolist()],
        "answered": matches.matched.astype(int).tolist(),
        "apart_m": np.where(matches.reference == NONE, -1.0, apart_m).round(3).tolist(),
        "right": [one.right.astype(int).tolist() for one in judgements],
        "findable": [one.findable.astype(int).tolist() for one in judgements],
    }
