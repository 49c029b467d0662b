"""Pieces of a page of results: one HTML file that needs nothing beside it."""

import base64
import html
import io
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.kit.jpeg import encode_jpeg, shrunk
from smal.files.container import write_whole

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


_FRAME_PX: Final = 320  # How wide a camera image is shown, pixels.
Advance = Callable[
    [str, int, int], object
]  # Called with what is being done, how much of it is and how much there is.


def page(title: str, body: str, width_rem: int = 60) -> str:
    """Return a whole page; the title is escaped, the body is HTML."""
    return _PAGE.format(title=html.escape(title), body=body, width_rem=width_rem)


def write_page(folder: Path, title: str, parts: Iterable[str], width_rem: int = 72) -> Path:
    """Write ``index.html`` of parts, which are HTML, into a folder that is there; return its path."""
    path = folder / "index.html"
    write_whole(path, page(title, "\n".join(parts), width_rem).encode())
    return path


def tiles(values: Mapping[str, str]) -> str:
    """Show values large, each with what it is of."""
    cells = "".join(f"<div><b>{html.escape(value)}</b><span>{html.escape(name)}</span></div>"
                    for name, value in values.items())  # fmt: skip
    return f'<div class="tiles">{cells}</div>'


def png(figure: "Figure", dpi: int = 110) -> bytes:
    """Draw a figure as a PNG file."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Of letters in names of drives.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def image(data: bytes, alt: str, kind: str = "png") -> str:
    """Embed a picture that is as wide as the page."""
    data_url = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return f'<img class="wide" src="{data_url}" alt="{html.escape(alt)}">'


def titled(figure: "Figure", title: str, said: str) -> str:
    """Return a figure with its title, which is text, and its caption, which is HTML."""
    picture = image(png(figure), title)
    return f'<figure class="own"><h3>{html.escape(title)}</h3>{picture}<figcaption>{said}</figcaption></figure>'


def strip(pictures: "Mapping[str, NDArray[np.uint8]]") -> str:
    """Show camera images, (height, width, 3) RGB, beside each other, each with what it is."""
    figures = (
        f"<figure>{image(encode_jpeg(shrunk(seen, min(_FRAME_PX, seen.shape[1]))), said, 'jpeg')}"
        f"<figcaption>{html.escape(said)}</figcaption></figure>"
        for said, seen in pictures.items()
    )
    return f'<div class="strip">{"".join(figures)}</div>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 0) -> str:
    """Return a table of escaped cells; the first ``left`` columns are texts, the others numbers."""

    def cells(row: Sequence[str], tag: str) -> str:
        kinds = (' class="text"' if column < left else "" for column in range(len(row)))
        return "".join(
            f"<{tag}{kind}>{html.escape(cell)}</{tag}>"
            for cell, kind in zip(row, kinds, strict=True)
        )

    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    # A region that scrolls is reached by the keyboard too.
    return (
        f'<div class="scroll" tabindex="0"><table><tr>{cells(head, "th")}</tr>{body}</table></div>'
    )


_PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
:root {{ color-scheme: light dark; --back: #fff; --text: #222; --muted: #5f5f5f; --line: #ddd; --soft: #eee;
  --note: #8a6100; }}
@media (prefers-color-scheme: dark) {{
  :root {{ --back: #15181c; --text: #e6e8ea; --muted: #a3abb4; --line: #3b424a; --soft: #262b31;
    --note: #e0b040; }} }}
body {{ font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back);
  max-width: {width_rem}rem; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.6rem; overflow-wrap: anywhere; }} h2 {{ font-size: 1.25rem; margin-top: 2.5rem; }}
h3 {{ font-size: 1.05rem; }}
.tiles {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(8rem, 1fr)); gap: .6rem; }}
.tiles div {{ border: 1px solid var(--line); border-radius: .5rem; padding: .6rem .8rem; }}
.tiles b {{ display: block; font-size: 1.3rem; }} .tiles span {{ color: var(--muted); font-size: .85rem; }}
.strip {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(10rem, 1fr)); gap: .5rem; }}
figure {{ margin: 0; min-width: 0; }} figure.own {{ margin-bottom: 1.5rem; }}
.wide {{ width: 100%; border-radius: .3rem; }}
.pair {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); gap: 1.5rem; }}
.note {{ border-left: .3rem solid var(--note); margin: 1rem 0; padding: .5rem 1rem;
  background: var(--soft); overflow-wrap: anywhere; }}
figcaption {{ color: var(--muted); font-size: .85rem; }}
.scroll {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ text-align: right; padding: .2rem .7rem; }} th.text, td.text {{ text-align: left; }}
td {{ border-bottom: 1px solid var(--soft); }} td:not(.text) {{ white-space: nowrap; }}
</style></head><body><main>
<h1>{title}</h1>
{body}
</main></body></html>
"""
