"""Tables that hold no algorithm, as TOML: what tags of maps stand for, conditions of light, bodies of robots."""

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

T = TypeVar("T")


def table(name: str, kind: type[T]) -> T:
    """Return the table of that name, checked by what it is to be, for pydantic."""
    text = (Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8")
    return TypeAdapter(kind).validate_python(tomllib.loads(text))
