"""The page of a map of views: the taught ways, the cost to go, and where the belief was wide."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from schemas.codec import printable
from services.experiments import html
from services.experiments.showing import figures
from services.experiments.showing.belief import Believed, believed
from services.experiments.showing.drives import TaughtDrives
from services.experiments.showing.parts import counted, figure, missing, seconds, strip
from services.experiments.showing.summary import facts, goals_of
from services.experiments.showing.ways import Ways
from services.recordings.taught import episode_of
from smal.demonstration import drives_to_goals
from smal.model import Model
from smal.planning import cost_to_go

#: Shares of a drive at which its cost to go stands in the table.
_SHARES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Keyframes of a drive that are shown, spread over it.
_SHOWN: Final = 5


class MapPage:
    """Makes the page; parameters as of `write_page`."""

    def __init__(
        self, folder: Path, model: Model, file: Path, found: TaughtDrives | None,
        advance: Callable[[str, int, int], None],
    ) -> None:  # fmt: skip
        self._folder, self._model, self._file, self._found, self._advance = folder, model, file, found, advance
        self._ways = Ways(model.mapped)
        self._goals = goals_of(model)
        self._names = [printable(episode_of(names[0])) for names in model.mapped.names]
        known = [] if found is None else [one for one in found.demonstrations if one is not None]
        whole = dict(drives_to_goals(known))
        self._drives = {
            names: whole[names]
            for names, frames in zip(model.mapped.names, model.mapped.frames.tolist(), strict=True)
            if names in whole and len(whole[names].atoms) == frames
        }

    def body(self) -> Iterator[str]:
        """Yield the page, part by part."""
        taught, believed_on = self._model.mapped, self._believed()
        yield html.tiles(
            {
                "drives": str(len(taught.goals)),
                "frames": f"{len(taught.poses):,}",
                "goals": ", ".join(self._goals),
                "keyframes": f"{len(taught.keyframes):,}",
                "shared by drives": str(int(self._ways.shared.sum())),
            }
        )
        yield from missing(self._found, sum(map(len, taught.names)))
        yield "<h2>The taught ways</h2>"
        yield from self._map(believed_on)
        yield "<h2>Cost to go</h2>"
        yield from self._costs(self._ways)
        yield "<h2>Where the belief was wide</h2>"
        yield from self._belief(self._ways, believed_on)
        yield "<h2>What it looked like</h2>"
        yield from self._seen()
        yield "<h2>The model</h2>"
        yield html.table(["of", "is"], facts(self._model, str(self._file), self._file.stat().st_size).items(), left=2)
        rows = [
            [
                printable(", ".join(names)),
                printable(goal),
                "there" if names in self._drives else "not there",
                f"{count:,}",
            ]
            for names, goal, count in zip(taught.names, taught.goals, taught.frames.tolist(), strict=True)
        ]
        yield "<h3>Drives</h3>"
        yield html.table(["name", "goal", "recording", "frames"], rows, left=3)

    def _map(self, believed_on: Mapping[int, Believed]) -> Iterator[str]:
        partings = [
            f"{number}: {'fork' if one.fork else 'the ways meet'} {self._at(one.keyframe)}, with "
            f"{' and '.join(self._names[d] for d in one.drives if d != self._ways.of[one.keyframe])}"
            for number, one in enumerate(self._ways.partings, 1)
        ]
        how = "by odometry" if self._ways.map.odometry else "as a schematic, since they are without odometry"
        said = f"{counted(len(self._ways.map.goals), 'drive')} {how}."
        yield figure(figures.draw_ways(self._ways, self._goals, believed_on), "ways", "Where they run", said)
        if partings:
            yield f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in partings)}</ul>"
        elif len(self._ways.map.goals) > 1:
            yield "<p>Nowhere do shared ways part or meet.</p>"

    def _at(self, keyframe: int) -> str:
        way = float(self._ways.way[self._ways.map.keyframes[keyframe]])
        return f"{way:.1f} {figures.unit(self._ways)} along {self._names[int(self._ways.of[keyframe])]}"

    def _costs(self, ways: Ways) -> Iterator[str]:
        names = self._names
        pictures, rows, no_way = [], [], []
        for number, goal in enumerate(self._goals):
            costs, _ = cost_to_go(ways.map, goal)
            said = (
                f"Time to {escape(goal)} from each place of the drives, going over to another one where that is sooner."
            )
            drawn = figures.draw_cost_to_go(ways, costs, names)
            pictures.append(figure(drawn, f"costs{number}", f"Cost to go to {goal}", said))
            for drive, name in enumerate(names):
                on = costs[ways.of == drive]
                where = np.round(np.array(_SHARES) * (on.size - 1)).astype(int)
                rows.append([goal, name, *(seconds(cost) for cost in on[where].tolist())])
                if not np.isfinite(on).any():
                    no_way.append(f"No taught way leads from {name} to {goal}.")
        head = ["to", "on the drive", "start", *(f"{share:.0%}" for share in _SHARES[1:-1]), "end"]
        yield f'<div class="pair">{"".join(pictures)}</div>'
        yield from (f"<p>{escape(line)}</p>" for line in no_way)
        yield html.table(head, rows, left=2)

    def _believed(self) -> dict[int, Believed]:
        """Let recognition follow each drive of the map whose recording is there."""
        taught = self._model.mapped
        whole = {k: self._drives[names] for k, names in enumerate(taught.names) if names in self._drives}
        total, done = sum(len(drive.atoms) for drive in whole.values()), 0

        def advance(frames: int) -> None:
            nonlocal done
            done += frames
            self._advance("recognizing", done, total)

        return {drive: believed(self._model, self._ways, drive, one, advance) for drive, one in whole.items()}

    def _belief(self, ways: Ways, believed_on: Mapping[int, Believed]) -> Iterator[str]:
        if not believed_on:
            yield "<p>Recognition was not run: none of the drives' recordings is there.</p>"
            return
        pictures, rows = [], []
        for drive, one in believed_on.items():
            wide = one.wide()
            tick_s = ways.map.tick_s
            where = ", ".join(f"{first * tick_s:.1f} to {last * tick_s:.1f} s" for first, last in wide) or "nowhere"
            drawn = figures.draw_belief(ways, drive, one)
            name = self._names[drive]
            pictures.append(figure(drawn, f"belief{drive}", name, f"Less likely there than not: {where}."))
            widest = int(one.spread.argmax())
            rows.append(
                [
                    name,
                    f"{np.median(one.here):.0%}",
                    f"{(one.here < 0.5).mean():.0%}",
                    f"{one.spread[widest]:.2f} {figures.unit(ways)} at {widest * tick_s:.1f} s",
                    f"{one.lost.max():.0%}",
                ]
            )
        yield (
            "<p>Recognition follows the drives that it was taught from once more. “Where it was” is the part of the "
            f"belief within {ways.map.correlation_length:.2f} {figures.unit(ways)} of the robot, the way over which "
            "views become half as alike; the belief is wide where that is less than half.</p>"
        )
        yield f'<div class="pair">{"".join(pictures)}</div>'
        yield html.table(
            ["drive", "where it was, median", "of the time wide", "largest spread", "lost, at most"], rows, left=1
        )

    def _seen(self) -> Iterator[str]:
        taught = self._model.mapped
        if not self._drives:
            yield "<p>None of the drives' recordings is there.</p>"
        for drive, names in enumerate(taught.names):
            if names not in self._drives:
                continue
            images = self._drives[names].images
            assert images is not None  # noqa: S101 - drives that are mapped have them
            first = int(np.searchsorted(taught.drives, drive))
            keys = taught.keyframes[self._ways.of == drive] - first
            shown = keys[np.unique(np.linspace(0, len(keys) - 1, min(_SHOWN, len(keys))).astype(int))].tolist()
            said = f"{self._names[drive]}: frames {', '.join(map(str, shown))}"
            picture = strip(self._folder / "drives" / f"{drive:05d}.jpg", [images[k] for k in shown], escape(said))
            yield f"<figure>{picture}<figcaption>{escape(said)}</figcaption></figure>"
