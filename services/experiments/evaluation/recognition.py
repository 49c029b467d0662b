"""Place recognition as in the paper's experiments: by Eq. 9, and by the nearest frames."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import Degradation, Degrader
from services.experiments.evaluation.drives import views_of_expert
from services.experiments.evaluation.plan import JUDGED_TICKS, Criterion
from services.simulator.simulation import Simulation
from smal.evaluation.ground_truth import judge_by_poses
from smal.features import Centering, FeatureSettings, extract
from smal.movement import Atom
from smal.paper.model import PaperModel
from smal.paper.phase import matched_phase
from smal.paper.sequences import last_frames
from smal.paper.state_matching import solve
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from smal.teaching.demonstration import Demonstration


def query_drive(
    simulation: Simulation, features: FeatureSettings, seed: int, views: Mapping[str, Degradation]
) -> dict[str, NDArray[Any]]:
    """Drive with the expert on held-out ways; return ``poses`` (f, 3) and features (f, m) by view."""
    degraders = {name: Degrader(how, seed) for name, how in views.items()}
    poses: list[tuple[float, float, float]] = []
    kept: dict[str, list[NDArray[np.float32]]] = {name: [] for name in views}
    for tick, (view, _) in enumerate(views_of_expert(simulation, seed)):
        poses.append((view.pose.x, view.pose.y, view.pose.heading))
        for name, degrader in degraders.items():
            kept[name].append(extract(degrader.apply(tick, view.image), features))
    return {"poses": np.array(poses)} | {name: np.stack(seen) for name, seen in kept.items()}


def recognize_states(model: PaperModel, views: NDArray[np.float32]) -> Matches:
    """Recognize states (Eq. 9) at each `JUDGED_TICKS`-th view (f, m), scored as in Eq. 8."""
    length = model.sequence_length
    frame_of = demonstrated_frames(model)
    matches = Matches.none(len(views))
    centred = model.centering.apply(views)
    for tick in range(JUDGED_TICKS - 1, len(views), JUDGED_TICKS):
        if tick < length - 1:
            continue
        window = centred[tick - length + 1 : tick + 1].T
        solution = solve(
            model.templates, window, length, model.lambda1, model.lambda2, tolerance=1e-3
        )
        if (state := solution.best_block) is not None:
            matches.reference[tick] = frame_of(state, matched_phase(solution, state))
            matches.score[tick] = solution.block_weights.max() / length
    return matches


def demonstrated_frames(model: PaperModel) -> Callable[[int, float], int]:
    """Return a function from a state and its phase to the frame among all drives.

    Phases beyond the template map to a later frame of the drive.
    """
    counts = [len(atoms) for atoms in model.atoms]
    starts = np.cumsum([0, *counts[:-1]])
    ends = [
        start + last_frames(count, model.sequence_length)
        for start, count in zip(starts, counts, strict=True)
    ]
    # A state is made of its first sequence.
    _, made = np.unique(np.concatenate(model.state_streams), return_index=True)
    begin = np.concatenate(ends)[made] - model.sequence_length + 1
    last = np.repeat(starts + counts - 1, [len(each) for each in ends])[made]
    return lambda state, phase: int(min(begin[state] + round(phase), last[state]))


def recognize_nearest(
    drives: Sequence[NDArray[np.float32]], views: NDArray[np.float32], length: int
) -> Matches:
    """Match each window of centred features with the most similar window of all drives.

    Windows do not cross the border of two drives.
    """
    found = [match_nearest_sequence(each, views, length) for each in drives]
    starts = np.cumsum([0, *map(len, drives[:-1])])
    scores = np.stack([np.where(one.matched, one.score, -np.inf) for one in found])
    references = np.stack([start + one.reference for start, one in zip(starts, found, strict=True)])
    best = scores.argmax(axis=0)
    every = np.arange(len(views))
    matched = np.isfinite(scores.max(axis=0))
    answered = np.where(matched, references[best, every], NONE)
    score = np.where(matched, scores[best, every], 0.0)
    return Matches(answered, score, np.zeros(len(views)))


class NearestImitation:
    """Repeats the action at the demonstrated frame with the most similar window."""

    def __init__(
        self, demonstrations: Sequence[Demonstration], features: FeatureSettings, frames: int = 1
    ) -> None:
        self._features = features
        self._frames = frames
        raw = [one.rows for one in demonstrations]
        self._centering = Centering.fit(raw, features)
        self._drives = [self._centering.apply(each) for each in raw]
        self._atoms = np.concatenate([one.atoms for one in demonstrations])
        self.reset()

    def reset(self) -> None:
        """Forget all frames before a new episode."""
        self._seen: list[NDArray[np.float32]] = []

    def step(self, image: NDArray[np.uint8], odometry: Sequence[float] | None = None) -> Atom:
        """Return the action for an image, (height, width, 3) RGB; the odometry is ignored."""
        del odometry
        self._seen = [*self._seen, self._centering.apply(extract(image, self._features))][
            -self._frames :
        ]
        matches = recognize_nearest(self._drives, np.stack(self._seen), len(self._seen))
        return Atom(int(self._atoms[matches.reference[-1]]))


def judged(
    matches: Matches,
    demonstrated: NDArray[np.float64],
    true: NDArray[np.float64],
    criterion: Criterion,
) -> dict[str, Any]:
    """Compare each `JUDGED_TICKS`-th answer with true poses (n, 3), (f, 3); return lists for JSON."""
    ticks = np.arange(JUDGED_TICKS - 1, len(true), JUDGED_TICKS)
    asked = matches.of(ticks)
    there = true[ticks]
    judgement = judge_by_poses(
        asked, demonstrated, there, criterion.distance_m, criterion.angle_deg
    )
    return {
        "tick": ticks.tolist(),
        "score": [float(f"{score:.6g}") for score in asked.score.tolist()],
        "answered": asked.matched.astype(int).tolist(),
        "right": judgement.right.astype(int).tolist(),
        "findable": judgement.findable.astype(int).tolist(),
    }
