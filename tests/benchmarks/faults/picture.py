"""Pictures: what the robot did around a fault and by whose command, and what processes hold over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from services.simulator.robots import RESCUEBOT
from tests.benchmarks.faults.judge import obeyed_s
from tests.benchmarks.faults.run import Outcome
from tests.benchmarks.soak.growth import Sample


def draw(outcome: Outcome, path: Path) -> None:
    """Draw the robot's movement, the frames answered and the fault over time."""
    zero_s = outcome.fault.begin_s
    figure = Figure(figsize=(9, 3), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(0.0, max(0.02, outcome.fault.end_s - zero_s), color="tab:red", alpha=0.2, label="fault")
    if outcome.steps:
        speeds = [one.speed_m_s / RESCUEBOT.drive.speed_m_s for one in outcome.steps]
        axes.plot([one.t_s - zero_s for one in outcome.steps], speeds, color="tab:orange", label="base moves")
    for number, track in enumerate(outcome.tracks):
        spans = track.intervals()
        label = {"label": "robot moves"} if number == 0 else {}
        moved = [one.moved_s / max(1e-3, one.end_s - one.begin_s) for one in spans]
        axes.step([one.begin_s - zero_s for one in spans], moved, where="post", color="tab:blue", **label)
        times = [t - zero_s for t in obeyed_s(track)]
        label = {"label": "new command obeyed"} if number == 0 else {}
        axes.plot(times, [-0.1] * len(times), "|", color="tab:green", **label)
    axes.set(xlabel="seconds since the fault began", ylabel="share of the nominal speed", title=outcome.name)
    axes.set_ylim(-0.2, 1.3)
    axes.legend(loc="upper right", ncols=3)
    figure.savefig(path, dpi=110)


def draw_growth(samples: Sequence[Sample], path: Path) -> None:
    """Draw memory and descriptors of every service over time."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    memory, descriptors = figure.subplots(2, 1, sharex=True)
    for service in dict.fromkeys(one.service for one in samples):
        own = [one for one in samples if one.service == service]
        minutes = [one.t_s / 60.0 for one in own]
        memory.plot(minutes, [one.rss_bytes / 1e6 for one in own], label=service)
        descriptors.plot(minutes, [one.descriptors for one in own], label=service)
    memory.set(ylabel="resident memory, MB", ylim=(0.0, None))
    descriptors.set(ylabel="open descriptors", xlabel="minutes", ylim=(0.0, None))
    memory.legend(loc="lower right", ncols=3)
    figure.savefig(path, dpi=110)
