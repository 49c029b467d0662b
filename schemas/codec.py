"""Encode messages as bytes and decode them, with every limit checked before memory is spent."""

from functools import cache
from typing import Final, TypeVar

import msgpack
from pydantic import ValidationError

from schemas.base import Message

ENCODING_PREFIX: Final = "application/vnd.msgpack;"

M = TypeVar("M", bound=Message)


class DecodeError(ValueError):
    """Payload that is not the expected message; the text gives the reason in one line."""


@cache
def encoding_of(message: type[Message]) -> str:
    """Return the encoding of a message class: ``application/vnd.msgpack;smal.State/1``."""
    return ENCODING_PREFIX + message.schema_name()


def misfit(message: type[Message], encoding: str, size: int) -> str | None:
    """Return why a payload of this encoding and size is not the message, or None."""
    if encoding != encoding_of(message):
        return f"expected {encoding_of(message)}, got {encoding[:80]!r}"
    if size > message.max_bytes:
        return f"{message.schema_name()}: too large ({size} bytes > maximum {message.max_bytes})"
    return None


def encode(message: Message) -> bytes:
    """Encode a message as msgpack, a map from field name to value. The bytes are deterministic."""
    packed: bytes = msgpack.packb(message.model_dump(), use_bin_type=True)
    return packed


def decode(cls: type[M], payload: bytes, encoding: str) -> M:
    """Decode and validate a message; DecodeError is the only exception for a bad payload."""
    if (why := misfit(cls, encoding, len(payload))) is not None:
        raise DecodeError(why)
    try:
        # Without a limit, four megabytes of empty maps cost 1 s and 280 MB.
        count = _ContainerCount(cls.max_containers)
        fields = msgpack.unpackb(
            payload,
            use_list=False,
            list_hook=count,
            object_hook=count,
            max_str_len=4096,
            max_bin_len=cls.max_bytes,
            max_array_len=1024,
            max_map_len=64,
            max_ext_len=0,
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise DecodeError(
            f"{cls.schema_name()}: not msgpack: {printable(str(error) or type(error).__name__)}"
        ) from None
    try:
        return cls.model_validate(fields)
    except ValidationError as error:
        raise DecodeError(f"{cls.schema_name()}: {describe(error)}") from None


def describe(error: ValueError) -> str:
    """Describe an invalid value in one line.

    An error of pydantic names the first invalid field and its valid values, and counts the others.
    """
    if not isinstance(error, ValidationError):
        return str(error)
    first, *others = error.errors(include_url=False, include_context=False)
    where = ".".join(str(part) for part in first["loc"]) or "message"
    more = f" (and {len(others)} more)" if others else ""
    # The prefix names one of Python's error classes, which means little to a user.
    what = first["msg"].removeprefix("Value error, ")
    given = first["input"]
    subject, should, allowed = what.partition(" should ")
    if subject in ("Input", "String") and should and isinstance(given, str | int | float):
        what = f"{(given[:40] if isinstance(given, str) else given)!r} must {allowed.partition(', unable to parse')[0]}"
    what = what.replace("less than or equal to", "at most").replace(
        "greater than or equal to", "at least"
    )
    return f"{printable(where)}: {printable(what)}{more}"


class _ContainerCount:
    """Hook for every finished map and array in msgpack, which limits their number."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._seen = 0

    def __call__(self, container: object) -> object:
        self._seen += 1
        if self._seen > self._most:
            raise ValueError(f"more than {self._most} maps and arrays")
        return container


def printable(text: str, most: int = 200) -> str:
    """Return the beginning of an untrusted text, without characters that control a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:most])
