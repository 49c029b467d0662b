"""Colours of figures and pages in the light; `templates/base.html` replaces them in the dark."""

from typing import Final

TEXT: Final = "#222222"
MUTED: Final = "#5f5f5f"
LINE: Final = "#dddddd"
BACK: Final = "#ffffff"
#: Colours of lines, which people with colour blindness can tell apart.
COLOURS: Final = ("#0b5fa5", "#c2410c", "#1a7f37", "#7b1fa2", "#8a6100", "#0e7490")
#: Variables of a page for the colours.
PAGE_COLOURS: Final = {
    TEXT: "--text", MUTED: "--muted", LINE: "--line", BACK: "--back",
    **{colour: f"--line{number}" for number, colour in enumerate(COLOURS, 1)},
}  # fmt: skip
