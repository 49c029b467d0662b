"""Self-contained HTML pages of results, filled from a template in ``templates``."""

import base64
import io
import platform
import re
import shlex
import sys
import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from jinja2 import Environment

from services.experiments.colours import PAGE_COLOURS
from services.experiments.words import counted
from services.kit.jpeg import encode_jpeg, shrunk
from services.kit.templates import template_environment
from services.kit.version import program_version
from smal.files.container import write_whole

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

_FRAME_PX: Final = 320  # Width of a camera image on a page, pixels.
#: Reports progress: the stage, the number of finished items, and their total.
Advance = Callable[[str, int, int], object]


def write_page(folder: Path, template: str, **data: object) -> Path:
    """Write ``index.html`` into an existing folder; return its path."""
    path = folder / "index.html"
    write_whole(path, render(template, **data).encode())
    return path


def render(template: str, **data: object) -> str:
    """Fill in a template; text in the data is escaped."""
    return _environment().get_template(template).render(data, made=made())


def made() -> str:
    """Return the date, the command and the versions of a page."""
    command = shlex.join(["smal", *sys.argv[1:]])
    date = time.strftime("%Y-%m-%d %H:%M %Z")
    return f"{date}, {command}, SMAL {program_version()}, Python {platform.python_version()}"


def svg(figure: "Figure") -> str:
    """Draw a figure as an inline SVG image, with the colours of the page, light or dark."""
    import matplotlib as mpl  # noqa: PLC0415 - takes a second to import

    with mpl.rc_context({"svg.fonttype": "none"}):
        text = _saved(figure, format="svg", transparent=True).decode()
    text = re.sub(
        r' width="[\d.]+pt" height="[\d.]+pt"|width="[\d.]+pt"|height="[\d.]+pt"', "", text
    )
    for colour, variable in PAGE_COLOURS.items():
        text = text.replace(colour, f"var({variable})")
    return text[text.index("<svg") :]


def png(figure: "Figure", dpi: int = 110) -> bytes:
    """Draw a figure as a PNG file."""
    return _saved(figure, format="png", dpi=dpi)


def _saved(figure: "Figure", **how: Any) -> bytes:  # noqa: ANN401
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Names of drives can contain letters that the font lacks.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, **how)
    return buffer.getvalue()


@cache
def _environment() -> Environment:
    environment = template_environment("services.experiments")
    environment.filters |= {"png_url": _png_url, "photo_url": _photo_url}
    environment.globals |= {"counted": counted, "colours": PAGE_COLOURS}
    return environment


def _png_url(data: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"


def _photo_url(rgb: "NDArray[np.uint8]") -> str:
    """Return a camera image, (height, width, 3) RGB, as a JPEG of at most `_FRAME_PX` columns."""
    jpeg = encode_jpeg(shrunk(rgb, min(_FRAME_PX, rgb.shape[1])))
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
