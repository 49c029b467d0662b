"""``decode_image`` of a recorded image."""

from __future__ import annotations

import random

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.message import DecodeError

from services.recordings.encoding import decode_image
from tests.fuzz.targets import check_line, mcap_bytes

#: Where a JPEG says how large it is: after the marker of its frame, the length of that and the bits of a sample.
_FRAME_MARKERS = (b"\xff\xc0", b"\xff\xc2")
_SIZE_AT = 5


def seeds() -> list[bytes]:
    # The last one is small, and says that it has 32,700 rows and columns: 3 GB of pixels.
    return [mcap_bytes.image_payload(), mcap_bytes.image_payload(0), _of_size(32_700)]


def _of_size(pixels: int) -> bytes:
    message = CompressedImage.FromString(mcap_bytes.image_payload())
    at = message.data.index(_FRAME_MARKERS[0]) + _SIZE_AT
    message.data = message.data[:at] + pixels.to_bytes(2, "big") * 2 + message.data[at + 4 :]
    return bytes(message.SerializeToString())


def run(data: bytes) -> bool:
    try:
        pixels = decode_image(data)
    except ValueError as error:
        check_line(error)
        return False
    assert pixels.ndim == 3
    assert pixels.shape[2] == 3
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Change the JPEG inside, most of all what it says of its size."""
    try:
        message = CompressedImage.FromString(data)
    except DecodeError:
        return None
    jpeg = bytearray(message.data)
    frame = max(jpeg.find(marker) for marker in _FRAME_MARKERS)
    if len(jpeg) < 20 or rng.random() < 0.2:
        return None
    if 0 <= frame < len(jpeg) - 10 and rng.random() < 0.3:
        jpeg[frame + _SIZE_AT + rng.randrange(4)] = rng.choice((0, 1, 16, 255))
    else:
        jpeg[rng.randrange(len(jpeg))] = rng.randrange(256)
    message.data = bytes(jpeg)
    return bytes(message.SerializeToString())
