"""Summary of a model in lines of text."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

from schemas.codec import printable
from services.experiments.words import counted
from services.recordings.recorded import episode_of
from smal.model import Model
from smal.paper.model import PaperModel
from smal.planning import cost_to_go


def shared_and_forks(model: PaperModel) -> tuple[int, int]:
    """Count the states of at least two episodes, and the states with several successors."""
    episodes: list[set[str]] = [set() for _ in range(model.states)]
    following: list[set[int]] = [set() for _ in range(model.states)]
    for name, stream in zip(model.names, model.state_streams, strict=True):
        for state in stream.tolist():
            episodes[state].add(episode_of(name))
        for state, then in pairwise(stream.tolist()):
            following[state] |= {then} - {state}
    shared, forks = (sum(len(some) > 1 for some in each) for each in (episodes, following))
    return shared, forks


def numbers_of(model: PaperModel) -> dict[str, int]:
    """Count the learned data: dead ends have no successor, rewards are above 1e-6."""
    return {
        "demonstrations": len(model.names),
        "frames": sum(map(len, model.atoms)),
        "sequences": sum(map(len, model.state_streams)),
        "states": model.states,
        "actions": len(model.actions),
        "goals": model.transitions.goals.size,
        "shared_states": shared_and_forks(model)[0],
        "dead_ends": model.states - len(set(model.transitions.state.tolist())),
        "reward_states": int((model.reward > 1e-6).sum()),
        "template_bytes": model.templates.nbytes,
    }


class TaughtSummary(NamedTuple):
    """A taught drive: names of its parts, number of frames, and destination."""

    parts: tuple[str, ...]
    frames: int
    end: str


def taught_drives(model: Model | PaperModel) -> list[TaughtSummary]:
    """Return the drives of a model, in order."""
    if isinstance(model, Model):
        each = zip(
            model.mapped.names, model.mapped.frames.tolist(), model.mapped.goals, strict=True
        )
        return [TaughtSummary(parts, frames, f"to {goal}") for parts, frames, goal in each]
    ends = [
        f"{'recovery: ' if recovery else ''}{'reached' if good else 'did not reach'} the goal"
        for recovery, good in zip(model.recovery, model.successful, strict=True)
    ]
    return [
        TaughtSummary((name,), len(atoms), end)
        for name, atoms, end in zip(model.names, model.atoms, ends, strict=True)
    ]


def lines(model: Model | PaperModel, file: str, size: int) -> Iterator[str]:
    """Yield the summary of a model file of a size in bytes."""
    for name, value in facts(model, file, size).items():
        yield f"{name:15}{value}"
    for one in taught_drives(model):
        yield f"  {printable(', '.join(one.parts))}: {one.frames} frames, {printable(one.end)}"


def facts(model: Model | PaperModel, file: str, size: int) -> dict[str, str]:
    """Return the properties of a model by heading."""
    found = {
        "model": f"{printable(file)}, {size / 1e6:.1f} MB, checksum {model.checksum[:12]}",
        "scheme": "filter, by a map of views" if isinstance(model, Model) else "paper, by states",
        "modalities": " ".join(model.feature_settings.modalities),
    }
    return found | (_of_map(model) if isinstance(model, Model) else _of_paper(model))


def _of_map(model: Model) -> dict[str, str]:
    taught = model.mapped
    camera = taught.taught_scene.camera
    where = f", {taught.taught_scene.height:.2f} m above the ground" if taught.odometry else ""
    return {
        "world": printable(model.world) or "unknown",
        "goals": ", ".join(_goal(model, goal) for goal in goals_of(model)),
        "map": f"{len(taught.keyframes)} keyframes of {counted(taught.drive_count, 'drive')}, {taught.basis.shape[1]} "
        f"components a view, {taught.views.nbytes / 1e6:.1f} MB, {counted(len(taught.stitched), 'joint')}; "
        f"a frame each {taught.tick_s:g} s",
        "view variants": f"{len(taught.variants)}, learned from runs",
        "odometry": "yes, in metres" if taught.odometry else "none: usual movement of actions",
        "camera": f"{camera.field_deg:.0f} degrees wide ({camera.lens}){where}",
        "drives": f"{taught.drive_count}, {len(taught.poses)} frames",
    }


def _of_paper(model: PaperModel) -> dict[str, str]:
    numbers = numbers_of(model)
    (shared, forks) = shared_and_forks(model)
    return {
        "states": f"{model.states} of {counted(model.sequence_length, 'frame')}, {shared} shared by drives, "
        f"{counted(forks, 'fork')}, {counted(numbers['goals'], 'goal state')}",
        "actions": f"{len(model.actions)} of {model.actions.shape[1]} actions",
        "reward": f"in {numbers['reward_states']} of {model.states} states, "
        f"the largest {float(model.reward.max(initial=0.0)):.3g}; discount {model.gamma:g}",
        "templates": f"{model.templates.shape[1]} frames of {model.templates.shape[0]} features, "
        f"{model.templates.nbytes / 1e6:.1f} MB",
        "drives": f"{len(model.names)}, {numbers['frames']} frames",
    }


def goals_of(model: Model) -> list[str]:
    """Return the distinct names of the goals."""
    return list(dict.fromkeys(model.mapped.goals))


def _goal(model: Model, goal: str) -> str:
    costs, _ = cost_to_go(model.mapped, goal)
    drives = counted(model.mapped.goals.count(goal), "drive")
    return f"{printable(goal)} ({drives}, at most {costs[costs < math.inf].max():.0f} s away)"
