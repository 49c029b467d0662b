"""Page about a model."""

from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.showing.drives import TaughtDrives
from services.experiments.showing.figures import draw_belief, draw_cost_to_go, draw_ways
from services.experiments.showing.summary import facts, goals_of, taught_drives
from services.experiments.showing.ways import Believed, Ways, believed
from services.experiments.words import counted
from services.recordings.recorded import episode_of
from services.simulator.world import World, known_worlds, load_world
from smal.arrays import evenly
from smal.model import Model
from smal.paper.model import PaperModel
from smal.planning import cost_to_go
from smal.teaching.demonstration import Demonstration

_SHOWN: Final = 5  # Number of frames of a drive on the page, evenly spaced.


def write_page(
    folder: Path,
    model: Model | PaperModel,
    file: Path,
    drives: TaughtDrives | None,
    advance: html.Advance = lambda _what, _done, _total: None,
) -> Path:
    """Write the page of a model with images from recordings; ValueError names a damaged episode."""
    found = {} if drives is None else drives.found
    taught = [
        {
            "name": printable(", ".join(one.parts)),
            "end": printable(one.end),
            "frames": one.frames,
            "recording": "there" if number in found else "not there",
        }
        for number, one in enumerate(taught_drives(model))
    ]
    return html.write_page(
        folder,
        "model.html",
        file=printable(file.name),
        drives=drives,
        map=_map(model, drives, advance) if isinstance(model, Model) else None,
        photos_of_drives=[_photos(taught[number]["name"], one) for number, one in found.items()],
        taught=taught,
        facts=facts(model, str(file), file.stat().st_size),
    )


def _photos(name: object, drive: Demonstration) -> dict[str, Any]:
    assert drive.images is not None  # noqa: S101 - drives without images count as missing
    frames = evenly(len(drive.atoms), _SHOWN).tolist()
    return {f"{name}, frame {frame}": drive.images[frame] for frame in frames}


def _map(model: Model, taught: TaughtDrives | None, advance: html.Advance) -> dict[str, Any]:
    ways = Ways(model.mapped)
    drives = {} if taught is None else taught.found
    shown, world = (ways, None) if taught is None else _in_world(model, ways, taught)
    goals = goals_of(model)
    names = [printable(episode_of(parts[0])) for parts in model.mapped.names]
    total = sum(len(one.atoms) for one in drives.values())
    done = count(1)

    def step() -> None:
        advance("recognizing", next(done), total)

    beliefs = {number: believed(model, ways, number, one, step) for number, one in drives.items()}
    costs = {goal: cost_to_go(ways.map, goal)[0] for goal in goals}
    source = (
        "by odometry" if ways.map.odometry else "by usual movements of actions, without odometry"
    )
    if world is not None:
        source = "in the world's axes, by the true poses of the recordings"
    return {
        "names": names,
        "caption": f"{counted(len(names), 'drive')} {source}; "
        f"{counted(int(ways.shared.sum()), 'keyframe')} shared by drives.",
        "ways_svg": html.svg(draw_ways(shown, goals, beliefs, world)),
        "partings": list(_partings(ways, names)),
        "costs": {goal: html.svg(draw_cost_to_go(ways, one, names)) for goal, one in costs.items()},
        "unreachable": [
            f"No taught way leads from {name} to {goal}."
            for goal, one in costs.items()
            for drive, name in enumerate(names)
            if not np.isfinite(one[ways.of == drive]).any()
        ],
        "beliefs": [_belief(ways, names[drive], one) for drive, one in beliefs.items()],
        "near": ways.map.correlation_length,
        "unit": ways.unit,
    }


def _in_world(model: Model, ways: Ways, taught: TaughtDrives) -> tuple[Ways, World | None]:
    """Return the ways in the axes of their world, and the world, if both are known."""
    if taught.truth is None or model.world not in known_worlds():
        return ways, None
    return ways.at(taught.truth), load_world(model.world)


def _partings(ways: Ways, names: Sequence[str]) -> Iterator[str]:
    for one in ways.partings:
        here = int(ways.of[one.keyframe])
        others = " and ".join(names[drive] for drive in one.drives if drive != here)
        what = "fork" if one.fork else "the ways meet"
        at = f"{ways.way[one.keyframe]:.1f} {ways.unit}"
        yield f"{what} {at} along {names[here]}, with {others}"


def _belief(ways: Ways, name: str, one: Believed) -> dict[str, Any]:
    widest = int(one.spread.argmax())
    return {
        "name": name,
        "svg": html.svg(draw_belief(ways, one)),
        "here": np.median(one.here),
        "wide": (one.here < 0.5).mean(),
        "spread": f"{one.spread[widest]:.2f} {ways.unit} at {widest * ways.map.tick_s:.1f} s",
        "lost": one.lost.max(),
    }
