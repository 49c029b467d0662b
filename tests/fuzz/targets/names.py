"""Names of files below the root of a service: any text is refused in one line, or leads to nothing outside of it."""

from __future__ import annotations

import os
import random
from functools import cache
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from schemas.codec import describe
from schemas.rpc import FolderName
from services.kit.root import below, name_below, open_below
from tests.fuzz.targets import check_line, scratch

_NAME: TypeAdapter[str] = TypeAdapter(FolderName)
_PARTS = ("a", "b.smal", "in", "up", "etc", "fifo", "loop", ".", "..", "...", "", " ", "~", "ä", "x" * 300, "\0", "\\")


@cache
def root() -> Path:
    """Return a folder with files, a FIFO, and links in it and out of it."""
    made = (scratch.folder() / "root").resolve()
    (made / "a").mkdir(parents=True)
    for file in (made / "b.smal", made / "a" / "b.smal", made.parent / "b.smal"):
        file.write_bytes(b"x")
    os.mkfifo(made / "fifo")
    for link, target in (("in", "a"), ("up", ".."), ("etc", "/etc"), ("loop", "loop")):
        (made / link).symlink_to(target)
    return made


def seeds() -> list[bytes]:
    texts = ("b.smal", "in/b.smal", "up/b.smal", "etc/passwd", "fifo", "loop", "", "../b.smal", "/etc/passwd", "a\0")
    return [text.encode() for text in texts]


def run(data: bytes) -> bool:
    try:
        name = _NAME.validate_json(data if data[:1] == b'"' else _quoted(data))
    except ValidationError as error:
        check_line(describe(error))
        return False
    try:
        path = below(root(), name)
    except OSError:
        return False
    assert path.is_relative_to(root())
    again = name_below(root(), path)
    assert again is not None
    assert below(root(), again) == path
    try:
        with open_below(root(), name) as file:
            assert file.read() == b"x"
    except OSError:
        return False
    return True


def _quoted(data: bytes) -> bytes:
    return b'"' + data + b'"'


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Put a name together out of parts that mean something."""
    if rng.random() < 0.3:
        return None
    return "/".join(rng.choices(_PARTS, k=rng.randrange(1, 6))).encode()
