"""A folder of images as a traverse: what is a frame, in which order, and what becomes of files that cannot be read."""

import os
import random
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.experiments.engine import Engine
from services.experiments.matching.sources import natural_key, open_source, read_color, read_depth
from services.experiments.matching.traverse import describe_frames
from services.kit.errors import JobError, UsageError
from smal.features import FeatureSettings
from tests.services.kit.test_pixels import with_orientation

FEATURES = FeatureSettings.of(["color"])
LOSSLESS = (".png", ".bmp", ".tif", ".webp", ".ppm", ".jp2", ".ras")
FORMATS = (*LOSSLESS, ".jpg", ".gif", ".avif")


def picture(seed: int = 0, rows: int = 60, columns: int = 80) -> np.ndarray:
    """Return a smooth RGB image, which lossy formats keep well."""
    coarse = np.random.default_rng(seed).integers(0, 256, (5, 6, 3), dtype=np.uint8)
    return cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)


def encoded(image: np.ndarray, suffix: str) -> bytes:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
    quality = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000] if suffix == ".jp2" else quality
    done, data = cv2.imencode(suffix, bgr, quality)
    assert done
    return data.tobytes()


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(image, path.suffix))
    return path


@given(
    st.lists(
        st.tuples(
            st.integers(0, 10**40), st.integers(0, 3), st.sampled_from(["img", "IMG", "Img"])
        ),
        max_size=20,
    ),
    st.randoms(use_true_random=False),
)
def test_names_sort_by_the_value_of_their_numbers(
    frames: list[tuple[int, int, str]], shuffler: random.Random
) -> None:
    values = {f"{prefix}{'0' * zeros}{number}-b.png": number for number, zeros, prefix in frames}
    names = list(values)
    shuffler.shuffle(names)
    ordered = sorted(names, key=natural_key)
    assert [values[name] for name in ordered] == sorted(values.values())
    assert ordered == sorted(sorted(names), key=natural_key)


def test_grey_alpha_and_16_bits(tmp_path: Path) -> None:
    image = picture()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    read = read_color(write(tmp_path / "grey.png", grey))
    np.testing.assert_array_equal(read, np.repeat(grey[..., None], 3, axis=2))

    deep = image.astype(np.uint16) * 256 + 77
    for suffix in (".png", ".tif"):
        read = read_color(write(tmp_path / f"deep{suffix}", deep))
        assert read.dtype == np.uint8
        np.testing.assert_allclose(read.astype(int), image, atol=1)  # codecs round or cut off

    transparent = np.dstack(
        [cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.full(image.shape[:2], 9, np.uint8)]
    )
    (tmp_path / "alpha.png").write_bytes(cv2.imencode(".png", transparent)[1].tobytes())
    read = read_color(tmp_path / "alpha.png")
    np.testing.assert_array_equal(read, image)


def test_traverse_stands_upright_by_its_orientation(tmp_path: Path) -> None:
    lying = np.ascontiguousarray(np.rot90(picture()))
    (tmp_path / "phone.jpg").write_bytes(with_orientation(encoded(lying, ".jpg"), 6))
    upright = read_color(tmp_path / "phone.jpg")
    assert upright.shape == (60, 80, 3)
    assert np.abs(upright.astype(int) - picture()).mean() < 3.0


def test_depth_is_16_bit_and_of_one_channel(tmp_path: Path) -> None:
    depth_mm = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) * 20
    read = read_depth(write(tmp_path / "depth.png", depth_mm))
    np.testing.assert_array_equal(read, depth_mm)
    assert read_depth(write(tmp_path / "eight.png", (depth_mm // 256).astype(np.uint8))) is None
    assert read_depth(write(tmp_path / "colour.png", picture().astype(np.uint16))) is None
    assert read_depth(tmp_path / "missing.png") is None


def test_folder_lists_image_files_as_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in (1, 2, 10):
        write(tmp_path / f"img{number}.png", picture(number))
    write(tmp_path / "img0.png", picture()).rename(
        tmp_path / "IMG3"
    )  # an image without an extension
    (tmp_path / "img4.jpg").write_bytes(b"no image")
    (tmp_path / "img5.png").symlink_to(tmp_path / "nowhere.png")
    (tmp_path / "truth.csv").write_text("query,reference_first,reference_last\n")
    (tmp_path / "notes.txt").touch()
    write(tmp_path / ".hidden.png", picture())
    write(tmp_path / "deeper.png" / "img6.png", picture())
    os.mkfifo(tmp_path / "pipe.png")
    folder = open_source(tmp_path, "QUERY_DIR")
    assert folder.frames == ("img1.png", "img2.png", "IMG3", "img4.jpg", "img5.png", "img10.png")
    assert folder.others == ("notes.txt", "truth.csv")

    described = describe_frames(folder, FEATURES, None, "reading", Engine(None))
    assert described.numbers.tolist() == [0, 1, 2, 5]
    assert described.unreadable == ["img4.jpg", "img5.png"]
    described.say_skipped()
    assert capsys.readouterr().err.splitlines() == [
        f"smal: {tmp_path}: skipped 2, no images: notes.txt, truth.csv",
        f"smal: {tmp_path}: skipped 2, unreadable (numbers kept): img4.jpg, img5.png",
    ]


def test_the_command_limits_pixels_before_opencv_is_loaded() -> None:
    environment = {
        name: value for name, value in os.environ.items() if name != "OPENCV_IO_MAX_IMAGE_PIXELS"
    }
    done = subprocess.run(
        [sys.executable, "-c", "import os, services.cli; print(os.environ['OPENCV_IO_MAX_IMAGE_PIXELS'])"],
        cwd=Path(__file__).parents[4], env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert (
        10**7 <= int(done.stdout) <= 10**8
    )  # the camera's images pass, and three bytes a pixel fit into memory


def test_source_is_rejected_when_it_has_no_frames(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").touch()
    for name, problem in (
        ("missing", "No such file or directory"),
        (
            "notes/a.txt",
            "neither a folder of images, nor a recording, nor a readable video",
        ),
        ("empty", r"no image in this folder \(files: 0\)"),
        ("notes", r"no image in this folder \(files: 1\)"),
    ):
        with pytest.raises(
            (UsageError, JobError), match=f"^REFERENCE_DIR {tmp_path / name}: {problem}"
        ):
            open_source(tmp_path / name, "REFERENCE_DIR")
    (tmp_path / "notes" / "b.jpg").write_bytes(encoded(picture(), ".jpg")[:-30])
    with pytest.raises(JobError, match=r"no readable image: b\.jpg"):
        describe_frames(
            open_source(tmp_path / "notes", "QUERY_DIR"), FEATURES, None, "reading", Engine(None)
        )
