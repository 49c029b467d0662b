"""Network modality: the embedding of an image by any network in an ONNX file, or what a network draws boxes round.

A user gives the file, as ``onnx:FILE``, of a detector as ``boxes:FILE`` (`smal.features.detectors.of_boxes` says what
it gives; its embedding has the size 0). Everything else, models above all, names the network by what it is:
``onnx:``, the SHA-256 of the file, ``:`` and the size of the embedding. Such a name opens no file: the network runs
only in a process that was given its file.

The file needs one input, float32 (1 or any, 3, height, width), for RGB: values 0 to 1, less the mean and divided by
the standard deviation of each channel. These two are those of ImageNet, of a detector 0 and 1, unless the metadata of
the file has `mean` and `std`, each three numbers separated by commas. Weights must be inside the file.
"""

import hashlib
import os
import re
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from smal.arrays import Float32s, Uint8s
from smal.features.detectors import Detection, of_boxes
from smal.features.modality import Modality, detector, unit_length
from smal.features.resizing import resized
from smal.files.confined import ConfinedError, Work, WorkLimits, confined
from smal.files.container import open_regular

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

PREFIX = "onnx:"
BOXES = "boxes:"
# Of a network that takes any height or width.
SIDE = 224
LARGEST = 2**31  # Most bytes of a file: the format, protobuf, ends there.
MOST_MEMORY = 4 * 2**30  # Bytes that a network may take beside its weights.
_COPIES = 4  # How often its weights may be in memory while it is opened.
LONGEST_S = 5.0  # Processor time of an image, seconds. A robot sees ten a second; evaluating a drive can be slower.
_LONGEST_WAIT_S = 4 * LONGEST_S  # The same by the clock, on a machine with much to do.
# No embedding has more entries than a raw image.
_NAME = re.compile(r"onnx:([0-9a-f]{64}):(0|[1-9][0-9]{0,6})")
Channels = tuple[float, float, float]
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
ZEROS = (0.0, 0.0, 0.0)
ONES = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Network:
    """A network that embeds images of some rows and columns, less the mean and divided by the std of channels, (3,).

    The name of its file is for errors.
    """

    file: str
    session: "InferenceSession"
    rows: int
    columns: int
    mean: Float32s
    std: Float32s

    def describe(self, image: Uint8s) -> Float32s:
        """Describe an RGB image, brought to the size of the network's input, by its embedding.

        That is the first output of the network, of unit length; of a map of features (1, channels, height, width) the
        mean over height and width. ValueError where the network does not run, or its output is not finite.
        """
        output = self._run(image)
        pooled = output.mean(axis=(2, 3)) if output.ndim == 4 else output
        return unit_length(pooled)

    def detect(self, image: Uint8s) -> list[Detection]:
        """Return what the network draws boxes round; ValueError as of `describe`, or as of `of_boxes`."""
        return of_boxes(self.file, self._run(image), self.rows, self.columns)

    def _run(self, image: Uint8s) -> Float32s:
        small = resized(image, self.rows, self.columns).astype(np.float32)
        scaled = (small / np.float32(255.0) - self.mean) / self.std
        batch = np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])
        run = _onnxruntime(self.file).RunOptions()
        # How long a loop goes on can depend on the image.
        end = threading.Timer(_LONGEST_WAIT_S, setattr, (run, "terminate", True))
        end.daemon = True
        end.start()
        try:
            found = self.session.run(None, {self.session.get_inputs()[0].name: batch}, run)
            output = np.asarray(found[0], dtype=np.float32)
        except Exception as error:
            if run.terminate:
                raise ValueError(
                    f"{self.file}: an image takes more than {_LONGEST_WAIT_S:g} s"
                ) from error
            raise ValueError(
                f"{self.file}: the network does not run: {_one_line(error)}"
            ) from error
        finally:
            end.cancel()
        if output.size == 0:
            raise ValueError(f"{self.file}: the network's first output is empty")
        if not np.isfinite(output).all():
            raise ValueError(f"{self.file}: the network's first output contains NaN or infinity")
        return output


_given: dict[str, Network] = {}  # The networks that the user gave to this process, by their names.


@cache
def open_network(file: str, kind: str = PREFIX) -> str:
    """Read a network's file, as it is the first time; return the name of its modality.

    ValueError says in one line that onnxruntime is not installed, or the file is missing or none that fits (see above).
    """
    if not file:
        raise ValueError(f"the feature modality {kind!r} names no file; write {kind}FILE")
    try:
        with os.fdopen(open_regular(Path(file)), "rb") as opened:
            size = os.fstat(opened.fileno()).st_size
            if size > LARGEST:
                raise ValueError(
                    f"{file}: too large for a network: {size} bytes, at most {LARGEST}"
                )
            data = opened.read(size)
    except FileNotFoundError:
        raise ValueError(
            f"{file}: there is no such file for the feature modality {kind}FILE"
        ) from None
    except OSError as error:
        raise ValueError(
            f"{file}: cannot read the network's file: {error.strerror or error}"
        ) from error
    _onnxruntime(file)
    size = _proven(file, kind, data)
    name = f"{PREFIX}{hashlib.sha256(data).hexdigest()}:{size}"
    _given[name] = _opened(file, kind, data)
    return name


def _proven(file: str, kind: str, data: bytes) -> int:
    """Run a network in a child process with limits; return the size of its embedding, or raise ValueError.

    A few bytes can describe a loop without an end, or a matrix that fills all memory.
    """
    request = {
        "file": str(Path(file).absolute()),
        "called": file,
        "kind": kind,
        "longest_s": LONGEST_S,
    }
    limits = WorkLimits.of_size(len(data), MOST_MEMORY + _COPIES * len(data))
    try:
        proven = confined("smal.features.onnx:prove", request, limits, file)
    except ConfinedError as error:
        raise ValueError(str(error)) from None
    if proven["digest"] != hashlib.sha256(data).hexdigest():
        raise ValueError(f"{file}: the network's file was changed while it was read; try again")
    return int(proven["size"])


def prove(request: dict[str, Any], work: Work) -> dict[str, Any]:
    """Run a network, in a child process, on a blank image and on noise; ConfinedError where it is of no use."""
    file = request["called"]
    kind = request["kind"]
    data = Path(request["file"]).read_bytes()
    try:
        network = _opened(file, kind, data)
        work.step("an image", request["longest_s"])
        shape = (network.rows, network.columns, 3)
        # Only running it tells the size of an output whose shape depends on that of the input.
        size = _run_once(network, kind, np.zeros(shape, dtype=np.uint8))
    except ValueError as error:
        raise ConfinedError(str(error)) from None
    work.step("an image", request["longest_s"])
    with suppress(
        ValueError
    ):  # Noise is no picture: how long the network takes is all that counts.
        _run_once(network, kind, np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))
    return {"digest": hashlib.sha256(data).hexdigest(), "size": size}


def _run_once(network: Network, kind: str, image: Uint8s) -> int:
    """Run a network on an image; return the size of the embedding, 0 of a detector."""
    if kind == PREFIX:
        return network.describe(image).size
    network.detect(image)
    return 0


def _opened(file: str, kind: str, data: bytes) -> Network:
    mean, std = (IMAGENET_MEAN, IMAGENET_STD) if kind == PREFIX else (ZEROS, ONES)
    return _network(file, _session(file, data), mean, std)


def given_as(name: str) -> str:
    """Return how the user gave a network to this process, ``onnx:FILE``; ValueError where nobody did."""
    kind = PREFIX if _parts(name)[1] else BOXES
    if name not in _given:
        raise ValueError(f"the network {name} is run only where its file is given, as {kind}FILE")
    return f"{kind}{_given[name].file}"


def said(name: str) -> str:
    """Return how the user gave a network to this process; of anything else its name."""
    return given_as(name) if name in _given else name


def is_digest(name: str) -> bool:
    """Whether a name is that of a network by its contents."""
    return _NAME.fullmatch(name) is not None


def onnx_modality(name: str) -> Modality:
    """Return the modality of a network by its contents; without its file it can be named, and describes nothing.

    ValueError says in one line that this is no such name.
    """
    digest, size = _parts(name)

    def describe(image: Uint8s) -> Float32s:
        given_as(name)
        return _given[name].describe(image)

    def detect(image: Uint8s) -> list[Detection]:
        given_as(name)
        return _given[name].detect(image)

    return (
        Modality(f"{PREFIX}{digest}", size, "color", describe)
        if size
        else detector(f"{BOXES}{digest}", detect)
    )


def _parts(name: str) -> tuple[str, int]:
    match = _NAME.fullmatch(name)
    if match is None:
        raise ValueError(
            f"a network is named by its contents, {PREFIX}SHA-256:SIZE, not {name[:100]!r}"
        )
    return match[1], int(match[2])


def _onnxruntime(file: str) -> Any:  # noqa: ANN401 - of a package that may be missing
    try:
        import onnxruntime  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ValueError(
            f"{PREFIX}{file}: needs the package onnxruntime, which is not installed: pip install -e '.[onnx]'"
        ) from error
    return onnxruntime


def _session(file: str, data: bytes) -> "InferenceSession":
    onnxruntime = _onnxruntime(file)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    # Its errors are raised as well; on standard error they would be said twice.
    options.log_severity_level = 4
    # Weights beside the file would escape its fingerprint: nothing lies in a folder of the name of a file.
    options.add_session_config_entry(
        "session.model_external_initializers_file_folder_path", str(Path(file).absolute())
    )
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        line = _one_line(error)
        if "external data" in line.lower():
            line = "its weights are in another file; save them inside (torch.onnx.export: external_data=False)"
        raise ValueError(f"{file}: no ONNX network that can be used: {line}") from error


def _network(file: str, session: "InferenceSession", mean: Channels, std: Channels) -> Network:
    inputs = session.get_inputs()
    rows, columns = _input_size(file, [(one.type, one.shape) for one in inputs])
    meta = session.get_modelmeta().custom_metadata_map
    less = _channels(file, meta, "mean", mean)
    over = _channels(file, meta, "std", std)
    if not (over > 0.0).all():
        raise ValueError(f"{file}: its metadata says std = {meta['std']!r}, which is not positive")
    return Network(file, session, rows, columns, less, over)


def _input_size(file: str, inputs: Sequence[tuple[str, Sequence[Any]]]) -> tuple[int, int]:
    """Return rows and columns of the only input; a dimension that is no number may have any."""
    for kind, shape in inputs if len(inputs) == 1 else ():
        lengths = [length if isinstance(length, int) else None for length in shape]
        match (kind, lengths):
            case ("tensor(float)", [1 | None, 3, rows, columns]) if 0 not in (rows, columns):
                return rows or SIDE, columns or SIDE
    has = " and ".join(f"{kind} {tuple(shape)}" for kind, shape in inputs) or "no input"
    raise ValueError(
        f"{file}: the network must have one input, float32 (1, 3, height, width), and has {has}"
    )


def _channels(file: str, meta: Mapping[str, str], key: str, usual: Channels) -> Float32s:
    if key not in meta:
        return np.array(usual, dtype=np.float32)
    try:
        numbers = np.array(
            [float(part) for part in re.split(r"[\s,]+", meta[key].strip(" []()"))],
            dtype=np.float32,
        )
    except ValueError:
        numbers = np.zeros(0, dtype=np.float32)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"{file}: its metadata must say {key} as three numbers separated by commas, got {meta[key]!r}"
        )
    return numbers


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
