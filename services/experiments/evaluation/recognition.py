"""Place recognition as in the paper's experiments, and its evaluation."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import Degradation, Degrader
from services.experiments.evaluation.drives import views_of_expert
from services.experiments.evaluation.plan import JUDGED_TICKS, Criterion
from services.simulator.simulation import Simulation
from smal.evaluation.ground_truth import judge_by_poses
from smal.features import FeatureSettings, extract
from smal.paper.model import PaperModel
from smal.paper.phase import matched_phase
from smal.paper.sequences import last_frames
from smal.paper.state_matching import solve
from smal.place_recognition import Matches


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
