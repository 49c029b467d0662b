"""Camera images as JPEG."""

import cv2
import numpy as np
import pytest

from services.kit.jpeg import decode_jpeg, encode_jpeg

ROWS, COLUMNS = np.mgrid[0:96, 0:128]
SMOOTH = np.stack([COLUMNS, ROWS, (COLUMNS + ROWS) // 2], axis=2).astype(np.uint8)


def test_an_image_comes_back_almost_as_it_was_colours_in_their_order() -> None:
    back = decode_jpeg(encode_jpeg(SMOOTH))
    assert back.shape == SMOOTH.shape
    assert np.abs(back.astype(int) - SMOOTH).mean() < 1.5


def test_a_progressive_jpeg_of_another_program_is_read() -> None:
    _, data = cv2.imencode(".jpg", SMOOTH[:, :, ::-1], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert decode_jpeg(data.tobytes()).shape == SMOOTH.shape


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xd9",
        b"no image at all",
        encode_jpeg(SMOOTH)[:100],
        b"\x89PNG\r\n\x1a\n" + bytes(40),
    ],
    ids=["empty", "start", "start and end", "text", "cut in its header", "another format"],
)
def test_what_is_no_jpeg_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"^not a JPEG image"):
        decode_jpeg(data)


def test_a_small_file_that_claims_an_enormous_image_costs_nothing() -> None:
    data = encode_jpeg(SMOOTH)
    at = data.index(b"\xff\xc0") + 5
    with pytest.raises(ValueError, match=r"of a size that a camera has$"):
        decode_jpeg(data[:at] + (32_700).to_bytes(2, "big") * 2 + data[at + 4 :])


def test_what_jpeg_cannot_hold_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^OpenCV cannot encode a 65536x1 image as JPEG$"):
        encode_jpeg(np.zeros((1, 65536, 3), np.uint8))
