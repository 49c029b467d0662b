"""Report of a recorded episode: a self-contained page to save or send."""

import base64
import time
from functools import cache
from typing import Final, NamedTuple

from jinja2 import Template

from schemas.episode import in_words
from services.console.listing import ListedRecording
from services.kit.templates import template_environment
from services.kit.version import program_version

#: The page contains its style and its pictures, and no script.
POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
#: Share of the path's extent that stays free around it, and minimum extent, metres.
_MARGIN: Final = 0.08
_LEAST_M: Final = 4.0


class _Map(NamedTuple):
    """Path in an image of this size, metres, with y downwards as in SVG."""

    pieces: list[list[tuple[float, float]]]
    size: float
    line: float  # Thickness of the path.


def report_page(recording: ListedRecording) -> str:
    """Return the page of a listed recording; text of the recording is escaped."""
    kind = "Run" if recording.purpose == "run" else "Drive"
    facts = {
        "outcome": in_words(recording.outcome),
        "driven": f"{recording.metres:.1f} m",
        "time": f"{recording.seconds:.1f} s",
        "frames": recording.frames,
        "world": recording.world or "unknown",
    }
    if recording.kidnapped:
        facts["kidnapped"] = "once" if recording.kidnapped == 1 else f"{recording.kidnapped} times"
    return _template().render(
        title=f"{kind} to {recording.goal or 'an unknown goal'}",
        facts=facts,
        pictures=[base64.b64encode(jpeg).decode() for jpeg in recording.thumbnails],
        map=_map(recording.path),
        episode=recording.episode,
        made=time.strftime("%Y-%m-%d %H:%M %Z", time.localtime(recording.when_s)),
        version=program_version(),
    )


def _map(path: tuple[tuple[tuple[float, float], ...], ...]) -> _Map | None:
    """Return a square map around the pieces of a path; None without a path."""
    if not path:
        return None
    every = (point for piece in path for point in piece)
    spans = [(min(values), max(values)) for values in zip(*every, strict=True)]
    extent = max(_LEAST_M, *(high - low for low, high in spans))
    size = extent * (1.0 + 2.0 * _MARGIN)
    (left, right), (low, high) = spans
    to_x = size / 2.0 - (left + right) / 2.0
    to_y = size / 2.0 + (low + high) / 2.0
    pieces = [[(round(x + to_x, 2), round(to_y - y, 2)) for x, y in piece] for piece in path]
    return _Map(pieces, round(size, 2), round(size / 150.0, 3))


@cache
def _template() -> Template:
    return template_environment("services.console").get_template("report.html")
