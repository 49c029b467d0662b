"""Messages in an MCAP file: images as JPEG for every viewer, other messages as JSON with a schema.

The topic is the message's Zenoh key. The channel's metadata contain robot and episode, so that
episodes stay separate in merged recordings. The record's sequence number is the tick.
"""

import json
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, cast

import foxglove_schemas_protobuf.CompressedImage_pb2 as foxglove
import numpy as np
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError as ProtobufDecodeError
from google.protobuf.message import Message as ProtobufMessage
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from schemas.base import Message
from schemas.camera import CompressedImage
from services.kit.jpeg import decode_jpeg

#: Frame of the camera, for viewers: x to the right in the image, y down, z into it.
CAMERA_FRAME: Final = "camera"


@dataclass(frozen=True)
class ChannelFormat:
    """Encoding of the messages of a class, by names of the MCAP registry."""

    schema_name: str
    schema_encoding: str
    message_encoding: str
    schema: bytes


@cache
def format_of(message: type[Message]) -> ChannelFormat:
    """Return the encoding of the messages of a class."""
    if issubclass(message, CompressedImage):
        return protobuf_format(foxglove.CompressedImage)
    schema = json.dumps(plain_json_schema(message)).encode()
    return ChannelFormat(message.schema_name(), "jsonschema", "json", schema)


def payload_of(message: Message) -> bytes:
    """Return the bytes of a message in the file."""
    if not isinstance(message, CompressedImage):
        return message.model_dump_json().encode()
    packed = foxglove.CompressedImage(
        timestamp=timestamp(message.stamp_ns),
        frame_id=CAMERA_FRAME,
        data=message.data,
        format=message.format,
    )
    return packed.SerializeToString()


def timestamp(stamp_ns: int) -> Timestamp:
    """Convert a stamp to protobuf."""
    return Timestamp(seconds=stamp_ns // 1_000_000_000, nanos=stamp_ns % 1_000_000_000)


def decode_image(payload: bytes) -> NDArray[np.uint8]:
    """Return the RGB pixels (height, width, 3) of a recorded image; raise ValueError if it is invalid."""
    return decode_jpeg(stamped_jpeg(payload)[1])


def stamped_jpeg(payload: bytes) -> tuple[int, bytes]:
    """Return the stamp (ns) and the JPEG of an image; raise ValueError if it is invalid."""
    try:
        image = foxglove.CompressedImage.FromString(payload)
    except ProtobufDecodeError:
        raise ValueError("not a foxglove.CompressedImage") from None
    return image.timestamp.seconds * 1_000_000_000 + image.timestamp.nanos, image.data


@cache
def protobuf_format(message: type[ProtobufMessage]) -> ChannelFormat:
    """Return the encoding of a protobuf class, with its descriptor and imports."""
    files: dict[str, FileDescriptor] = {}

    def collect(file: FileDescriptor) -> None:
        for imported in file.dependencies:
            collect(imported)
        files.setdefault(file.name, file)

    collect(cast("FileDescriptor", message.DESCRIPTOR.file))
    descriptors = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(descriptors.file.add())
    return ChannelFormat(
        message.DESCRIPTOR.full_name, "protobuf", "protobuf", descriptors.SerializeToString()
    )


def plain_json_schema(message: type[Message]) -> dict[str, Any]:
    """Return a message's JSON Schema in the plain form that viewers read.

    Foxglove needs a ``type`` in every field, and supports neither ``$ref`` nor ``anyOf`` nor
    ``prefixItems``. References are expanded. A nullable field has the type of its other values, and
    so do the values of a tuple.
    """
    schema = message.model_json_schema()
    definitions = schema.pop("$defs", {})
    return cast("dict[str, Any]", _plain(schema, definitions))


def _plain(node: Any, definitions: dict[str, Any]) -> Any:  # noqa: ANN401 - any JSON value
    if isinstance(node, list):
        return [_plain(item, definitions) for item in node]
    if not isinstance(node, dict):
        return node
    resolved = _resolved(node, definitions)
    return {key: _plain(value, definitions) for key, value in resolved.items()}


def _resolved(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return a node without ``anyOf``, ``$ref`` and ``prefixItems`` of its own."""
    match node:
        case {"anyOf": options, **rest}:
            (other,) = [option for option in options if option.get("type") != "null"]
            rest.pop("default", None)
            return _resolved(other | rest, definitions)
        case {"$ref": name, **rest}:
            return _resolved(definitions[name.removeprefix("#/$defs/")] | rest, definitions)
        case {"prefixItems": [first, *others], **rest} if others.count(first) == len(others):
            return rest | {"items": first}
        case _:
            return node
