"""Tables without algorithms, as TOML: meanings of map tags, lighting conditions, robot bodies."""

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

T = TypeVar("T")


def table(name: str, kind: type[T]) -> T:
    """Read a table, validated by pydantic as `kind`."""
    text = (Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8")
    return TypeAdapter(kind).validate_python(tomllib.loads(text))
