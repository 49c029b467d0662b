"""Network modality: the embedding of an image by any network in an ONNX file, or the boxes of a detector network.

Users name the file, as ``onnx:FILE``, or ``boxes:FILE`` for a detector (`smal.features.detectors.of_boxes` describes
its output; its embedding has the size 0). Models and messages name the network by its contents: ``onnx:``, the SHA-256
of the file, ``:`` and the size of the embedding. Such a name opens no file: the network runs only in a process that
was given its file.

The file needs one input, float32 (1 or any, 3, height, width), for RGB: values 0 to 1, less the mean and divided by
the standard deviation of each channel. The defaults are those of ImageNet, for a detector 0 and 1; the metadata `mean`
and `std` of the file, three numbers separated by commas each, override them. Weights must be inside the file.
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
from smal.features.resizing import PIXELS, resized
from smal.files.confined import ConfinedError, Work, WorkLimits, confined
from smal.files.container import open_regular

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

PREFIX = "onnx:"
BOXES = "boxes:"
#: For a network that accepts any height or width.
SIDE = 224
LARGEST = 2**31  # Maximum bytes of a file: the limit of protobuf.
MOST_MEMORY = 4 * 2**30  # Maximum bytes of memory beside the weights.
_COPIES = 4  # Maximum copies of the weights in memory while opening.
LONGEST_S = 5.0  # Processor time of an image, seconds. A robot has ten images a second; evaluations can be slower.
_LONGEST_WAIT_S = 4 * LONGEST_S  # The same by the clock, for a loaded machine.
# No embedding has more entries than a raw image.
_NAME = re.compile(r"onnx:([0-9a-f]{64}):(0|[1-9][0-9]{0,6})")
Channels = tuple[float, float, float]
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
ZEROS = (0.0, 0.0, 0.0)
ONES = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Network:
    """An open network for images of a fixed size, with the mean and std of its channels, (3,).

    The name of its file is for errors.
    """

    file: str
    session: "InferenceSession"
    rows: int
    columns: int
    mean: Float32s
    std: Float32s

    def describe(self, image: Uint8s) -> Float32s:
        """Return the embedding of an RGB image, resized to the network's input.

        It is the first output of the network, of unit length. A feature map (1, channels, height, width) is averaged
        over height and width. ValueError if the network does not run, or its output is not finite.
        """
        output = self._run(image)
        pooled = output.mean(axis=(2, 3)) if output.ndim == 4 else output
        return unit_length(pooled)

    def detect(self, image: Uint8s) -> list[Detection]:
        """Return the detections of the network; ValueError as in `describe` or `of_boxes`."""
        return of_boxes(self.file, self._run(image), self.rows, self.columns)

    def _run(self, image: Uint8s) -> Float32s:
        small = resized(image, self.rows, self.columns).astype(np.float32)
        scaled = (small / np.float32(255.0) - self.mean) / self.std
        batch = np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])
        run = _onnxruntime(self.file).RunOptions()
        # The duration of a loop can depend on the image.
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


#: Networks that were given to this process, by their names.
_given: dict[str, Network] = {}


@cache
def open_network(file: str, kind: str = PREFIX) -> str:
    """Read a network's file on the first call; return the name of its modality.

    ValueError if onnxruntime is not installed, or the file is not found or unsuitable (see the module).
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

    A few bytes can describe an endless loop, or a matrix that fills all memory.
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
    """Run a network, in a child process, on a blank image and on noise; ConfinedError if it is unsuitable."""
    file = request["called"]
    kind = request["kind"]
    data = Path(request["file"]).read_bytes()
    try:
        network = _opened(file, kind, data)
        work.step("an image", request["longest_s"])
        shape = (network.rows, network.columns, 3)
        # The output shape can depend on the input shape, so the network must run.
        size = _run_once(network, kind, np.zeros(shape, dtype=np.uint8))
    except ValueError as error:
        raise ConfinedError(str(error)) from None
    work.step("an image", request["longest_s"])
    noise = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    # Only the time counts here: an error on noise is no reason to reject the network.
    with suppress(ValueError):
        _run_once(network, kind, noise)
    return {"digest": hashlib.sha256(data).hexdigest(), "size": size}


def _run_once(network: Network, kind: str, image: Uint8s) -> int:
    """Run a network on an image; return the size of the embedding, 0 for a detector."""
    if kind == PREFIX:
        return network.describe(image).size
    network.detect(image)
    return 0


def _opened(file: str, kind: str, data: bytes) -> Network:
    mean, std = (IMAGENET_MEAN, IMAGENET_STD) if kind == PREFIX else (ZEROS, ONES)
    return _network(file, _session(file, data), mean, std)


def given_as(name: str) -> str:
    """Return the file of a network in this process, as ``onnx:FILE``; ValueError if it was not given."""
    kind = PREFIX if _parts(name)[1] else BOXES
    if name not in _given:
        raise ValueError(f"the network {name} is run only where its file is given, as {kind}FILE")
    return f"{kind}{_given[name].file}"


def runs_here(name: str) -> bool:
    """Return whether the features of a modality can be computed in this process."""
    return name in _given or not is_digest(name)


def said(name: str) -> str:
    """Return the file of a network in this process; for any other modality its name."""
    return given_as(name) if name in _given else name


def is_digest(name: str) -> bool:
    """Return whether a name identifies a network by its contents."""
    return _NAME.fullmatch(name) is not None


def onnx_modality(name: str) -> Modality:
    """Return the modality of a network by its contents; without its file it can be named, but not run.

    ValueError if the name is invalid.
    """
    digest, size = _parts(name)

    def describe(image: Uint8s) -> Float32s:
        given_as(name)
        return _given[name].describe(image)

    def detect(image: Uint8s) -> list[Detection]:
        given_as(name)
        return _given[name].detect(image)

    if size:
        network = _given.get(name)
        pixels = PIXELS if network is None else (network.rows, network.columns)
        return Modality(f"{PREFIX}{digest}", size, "color", describe, pixels=pixels)
    return detector(f"{BOXES}{digest}", detect)


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
    # Its errors are raised as well; standard error would repeat them.
    options.log_severity_level = 4
    # Weights beside the file would escape its fingerprint. No file lies in a folder with the name of a file.
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
    """Return rows and columns of the only input; a dimension without a number accepts any size."""
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
