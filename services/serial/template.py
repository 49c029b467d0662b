"""Template of a line of text with numbers, to write the line and to read it.

``{name*factor:format}`` is a number: the text holds the value of ``name`` times the factor (by
default 1), in a format of Python (by default .6f). A line that is read can have any format. All
other braces are text, so JSON needs no escapes. When a line is read, ``*`` stands for any text.
"""

import math
import re
from collections.abc import Collection, Mapping
from typing import Final

# Without an exponent: parseFloat of Arduino reads -5.55e-17 as -5.55.
_DEFAULT: Final = ".6f"
_FIELD: Final = re.compile(r"\{([a-z][a-z0-9_]*)(?:\*([^:{}]+))?(?::([^{}]*))?\}")
_OPENED: Final = re.compile(r"\{([a-z][a-z0-9_]*)")
_NUMBER: Final = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"


class Template:
    """A template whose names are among the ``known`` ones; ValueError if it is invalid."""

    def __init__(self, text: str, known: Collection[str]) -> None:
        self.names = tuple(match[1] for match in _FIELD.finditer(text))
        self._parts = _FIELD.split(text)[:: _FIELD.groups + 1]
        self._factors = []
        self._formats = []
        for name, factor, spec in _FIELD.findall(text):
            if name not in known:
                raise ValueError(f"unknown {{{name}}}; known: {', '.join(sorted(known))}")
            self._factors.append(_factor(factor))
            self._formats.append(_format(spec or _DEFAULT))
        for part in self._parts:
            if (opened := _OPENED.search(part)) and opened[1] in known:
                raise ValueError(f"{part[opened.start() :]!r} lacks its closing brace")
        anything = [r".*?".join(map(re.escape, part.split("*"))) for part in self._parts]
        self._pattern = re.compile(_NUMBER.join(anything) + r"\s*")

    def write(self, values: Mapping[str, float]) -> str:
        """Return the line with these values."""
        line = self._parts[0]
        for name, factor, spec, after in zip(
            self.names, self._factors, self._formats, self._parts[1:], strict=True
        ):
            line += format(values[name] * factor, spec) + after
        return line

    def read(self, line: str) -> dict[str, float] | None:
        """Return the values of a line; None for a line of another form."""
        match = self._pattern.fullmatch(line)
        if match is None:
            return None
        numbers = zip(self.names, match.groups(), self._factors, strict=True)
        values = {name: float(text) / factor for name, text, factor in numbers}
        return values if all(map(math.isfinite, values.values())) else None


def _factor(text: str) -> float:
    try:
        factor = float(text or 1.0)
    except ValueError:
        factor = 0.0
    if not 0.0 < abs(factor) < math.inf:
        raise ValueError(f"factor {text!r}: must be a finite number other than 0")
    return factor


def _format(spec: str) -> str:
    try:
        format(1.0, spec)
    except ValueError:
        raise ValueError(
            f"invalid format {spec!r}; use for example .3f, or .0f for a whole number"
        ) from None
    return spec
