"""Messages to bytes and back, with every limit checked before memory is spent."""

from __future__ import annotations

from typing import Final, TypeVar

import msgpack
from pydantic import ValidationError

from schemas.base import Message

ENCODING_PREFIX: Final = "application/vnd.msgpack;"


M = TypeVar("M", bound=Message)


class DecodeError(ValueError):
    """A payload that is not the message it should be; the text says why in one line."""


def encoding_of(message: type[Message]) -> str:
    """Return the encoding that goes with a message class, for example ``application/vnd.msgpack;smal.State/1``."""
    return ENCODING_PREFIX + message.schema_name()


def encode(message: Message) -> bytes:
    """Pack a message as msgpack.

    Returns
    -------
    bytes
        A map from field name to value; the same message always gives the same bytes.
    """
    packed: bytes = msgpack.packb(message.model_dump(), use_bin_type=True)
    return packed


def decode(cls: type[M], payload: bytes, encoding: str) -> M:
    """Unpack and validate one message.

    Parameters
    ----------
    cls
        The message class that the topic carries.
    payload
        The bytes received.
    encoding
        The encoding received; name and version must be those of ``cls``.

    Raises
    ------
    DecodeError
        For any payload that is not a valid message; no other exception leaves this function.
    """
    if encoding != encoding_of(cls):
        raise DecodeError(f"expected {encoding_of(cls)}, got {encoding[:80]!r}")
    if len(payload) > cls.max_bytes:
        raise DecodeError(f"{cls.schema_name()}: {len(payload)} bytes, at most {cls.max_bytes} allowed")
    try:
        # Small limits on containers: four megabytes of empty maps would otherwise cost 1 s and 280 MB.
        fields = msgpack.unpackb(
            payload,
            use_list=False,
            max_str_len=4096,
            max_bin_len=cls.max_bytes,
            max_array_len=1024,
            max_map_len=64,
            max_ext_len=0,
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise DecodeError(f"{cls.schema_name()}: not msgpack: {_first_line(error)}") from None
    try:
        return cls.model_validate(fields)
    except ValidationError as error:
        raise DecodeError(f"{cls.schema_name()}: {describe(error)}") from None


def describe(error: ValidationError) -> str:
    """Say in one line what is wrong with the first bad field, and how many others there are."""
    first, *others = error.errors(include_url=False, include_context=False, include_input=False)
    where = ".".join(str(part) for part in first["loc"]) or "message"
    more = f" (and {len(others)} more)" if others else ""
    return f"{where}: {first['msg']}{more}"


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]
