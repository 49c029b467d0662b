"""Networks as modalities: values, names, and files that are refused."""

import os
import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smal.features import FeatureSettings, extract, modality_named
from smal.features import onnx as onnx_features
from smal.files import container
from smal.files.container import ModelError
from smal.files.stored import FORMAT_VERSION
from smal.paper.model import PaperModel
from tests.fuzz.inputs import smallest_model

pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")
helper = onnx.helper
numpy_helper = onnx.numpy_helper
FLOAT = onnx.TensorProto.FLOAT

MEAN = np.array([0.485, 0.456, 0.406])
STD = np.array([0.229, 0.224, 0.225])
KERNEL = np.random.default_rng(5).standard_normal((4, 3, 1, 1)).astype(np.float32)
ANY: list[Any] = ["batch", 3, "height", "width"]


def network(
    path: Path,
    shape: list[Any] = ANY,
    kernel: np.ndarray = KERNEL,
    meta: dict[str, str] | None = None,
    kind: int = FLOAT,
    inputs: int = 1,
    op: str = "Conv",
    **save: Any,
) -> str:
    """Write a network that mixes the channels of every pixel (or does `op`), and return its modality's name."""
    nodes = [helper.make_node(op, ["x0", "kernel"] if op == "Conv" else ["x0"], ["y"])]
    given = [helper.make_tensor_value_info(f"x{number}", kind, shape) for number in range(inputs)]
    nodes += [
        helper.make_node("Identity", [f"x{number}"], [f"z{number}"]) for number in range(1, inputs)
    ]
    made = [helper.make_tensor_value_info("y", kind, None)]
    made += [helper.make_tensor_value_info(f"z{number}", kind, None) for number in range(1, inputs)]
    weights = [numpy_helper.from_array(kernel, "kernel")] if op == "Conv" else []
    graph = helper.make_graph(nodes, "mix", given, made, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, meta or {})
    onnx.save_model(model, str(path), **save)
    return f"onnx:{path}"


def given(text: str) -> str:
    """Have this process run a network that a user names, and return its own name."""
    (name,) = FeatureSettings.parse(text).modalities
    return name


def picture(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


def mixed(image: np.ndarray, mean: np.ndarray = MEAN, std: np.ndarray = STD) -> np.ndarray:
    """Return the mean over the image of the mixed channels: a linear map of the mean colour."""
    colour = ((image.reshape(-1, 3) / 255.0 - mean) / std).mean(axis=0)
    vector = KERNEL[:, :, 0, 0].astype(float) @ colour
    return np.asarray(vector / np.linalg.norm(vector))


def test_network_output_is_averaged_over_the_image(tmp_path: Path) -> None:
    modality = modality_named(given(network(tmp_path / "mix.onnx")))
    image = picture(224, 224)
    vector = modality.describe(image)
    assert (modality.size, modality.needs) == (4, "color")
    assert (vector.dtype, vector.shape) == (np.float32, (4,))
    np.testing.assert_allclose(vector, mixed(image), atol=1e-5)


def test_network_works_beside_other_modalities(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = network(tmp_path / "mix.onnx")
    name = given(text)
    chosen = FeatureSettings.parse(f"hog,{text}")
    image = picture(60, 80)
    assert (chosen.modalities, chosen.size, chosen.needs) == (("hog", name), 5944, {"color"})
    vector = extract(image, chosen)
    np.testing.assert_array_equal(vector[chosen.slices[0]], modality_named("hog").describe(image))
    np.testing.assert_array_equal(vector[chosen.slices[1]], modality_named(name).describe(image))
    # Another process knows no network, and reads the file that the user gave.
    travelling = pickle.dumps(chosen)
    monkeypatch.setattr(onnx_features, "_given", {})
    onnx_features.open_network.cache_clear()
    np.testing.assert_array_equal(extract(image, pickle.loads(travelling)), vector)  # noqa: S301


def refusal(name: str) -> str:
    with pytest.raises(ValueError, match=r"\A[^\n]+\Z") as caught:
        FeatureSettings.parse(f"color,{name}")
    return str(caught.value)


@pytest.mark.parametrize(
    ("how", "has"),
    [
        ({"shape": [1, 1, 64, 64], "kernel": KERNEL[:, :1]}, "has tensor(float) (1, 1, 64, 64)"),
        ({"shape": [8, 3, 64, 64]}, "has tensor(float) (8, 3, 64, 64)"),
        ({"shape": [1, "c", 64, 64]}, "has tensor(float) (1, 'c', 64, 64)"),
        ({"kind": onnx.TensorProto.DOUBLE, "op": "Flatten"}, "has tensor(double)"),
        ({"shape": [1, 3, 64], "op": "Flatten"}, "has tensor(float) (1, 3, 64)"),
        ({"inputs": 2}, "and has tensor(float) ('batch', 3, 'height', 'width') and tensor(float)"),
        ({"meta": {"mean": "0.5,0.5"}}, "mean as three numbers separated by commas, got '0.5,0.5'"),
        ({"meta": {"std": "a,b,c"}}, "std as three numbers separated by commas, got 'a,b,c'"),
        ({"meta": {"std": "1,0,1"}}, "std = '1,0,1', which is not positive"),
        ({"kernel": KERNEL * np.float32(np.inf)}, "first output contains NaN or infinity"),
        ({"shape": [1, 3, 64, 64], "kernel": np.ones((4, 3, 65, 65), dtype=np.float32)}, ""),
    ],
)
def test_network_is_refused_in_one_line_when_it_does_not_fit(
    tmp_path: Path, how: dict[str, Any], has: str
) -> None:
    line = refusal(network(tmp_path / "other.onnx", **how))
    assert line.startswith(f"{tmp_path / 'other.onnx'}: ")
    assert has in line


def test_file_is_refused_in_one_line_when_it_is_no_network(tmp_path: Path) -> None:
    network(tmp_path / "whole")
    whole = (tmp_path / "whole").read_bytes()
    for content in (b"version https://git-lfs.github.com/spec/v1\n", b"", whole[:-40]):
        (tmp_path / "other").write_bytes(content)
        line = refusal(f"onnx:{tmp_path}/other")
        assert line.startswith(f"{tmp_path}/other: no ONNX network that can be used: ")
    os.mkfifo(tmp_path / "fifo")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**31 + 1)
    for name, line in {
        "none": "there is no such file",
        ".": "cannot read the network's file: Is a directory",
        "fifo": "cannot read the network's file: Not a regular file",
        "large": "too large for a network: 2147483649 bytes, at most 2147483648",
    }.items():
        assert refusal(f"onnx:{tmp_path / name}").startswith(f"{tmp_path / name}: {line}")
    assert refusal("onnx:") == "the feature modality 'onnx:' names no file; write onnx:FILE"


def test_network_is_refused_when_its_weights_are_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = network(
        tmp_path / "mix.onnx", save_as_external_data=True, location="mix.data", size_threshold=0
    )
    assert (tmp_path / "mix.data").is_file()
    # Not even where onnxruntime would find them by itself.
    monkeypatch.chdir(tmp_path)
    assert refusal(name).endswith(
        "its weights are in another file; save them inside (torch.onnx.export: external_data=False)"
    )


# -- names from other people ---------------------------------------------------------------------------

STRANGE = f"onnx:{'0123456789abcdef' * 4}:4"


def test_unknown_network_can_be_named_but_not_run() -> None:
    named = FeatureSettings((STRANGE,))
    assert (named.size, named.needs) == (4, {"color"})
    line = f"the network {STRANGE} is run only where its file is given, as onnx:FILE"
    for use in (
        lambda: extract(picture(48, 64), named),
        lambda: FeatureSettings.parse(STRANGE),
        lambda: named.text,
    ):
        with pytest.raises(ValueError, match=f"^{line}$"):
            use()


NO_NAMES = ("onnx:", "onnx:FILE", "onnx:/dev/zero", "onnx", f"{STRANGE}/..", STRANGE.upper())


@pytest.mark.parametrize("name", [*NO_NAMES, STRANGE[:-1] + "00", STRANGE + "\n"])
def test_network_name_is_refused_when_it_is_malformed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    network(tmp_path / "FILE")
    with pytest.raises(
        ValueError, match=r"\A(a network is named by its contents|unknown feature modality)[^\n]+\Z"
    ):
        FeatureSettings((name,))


def test_model_opens_no_file_and_runs_no_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = network(tmp_path / "mix.onnx")
    path = tmp_path / "x.smal"
    seed = smallest_model()
    settings = FeatureSettings.parse(text)
    replace(
        seed,
        feature_settings=settings,
        mean=np.zeros(4, np.float32),
        templates=np.zeros((4, 2), np.float32),
    ).save(path)
    assert str(tmp_path).encode() not in path.read_bytes()
    monkeypatch.setattr(onnx_features, "_given", {})
    monkeypatch.setattr("onnxruntime.InferenceSession", None)
    (tmp_path / "mix.onnx").unlink()
    model = PaperModel.load(path)
    assert model.feature_settings == settings
    os.mkfifo(tmp_path / "fifo")
    for named in (f"onnx:{tmp_path}/fifo", "onnx:/dev/zero", text):
        with path.open("rb") as file:
            meta, arrays, _ = container.read(file, "x", FORMAT_VERSION)
        container.write(path, FORMAT_VERSION, meta | {"modalities": [named]}, arrays)
        with pytest.raises(
            ModelError, match="a network is named by its contents, onnx:SHA-256:SIZE, not 'onnx:/"
        ):
            PaperModel.load(path)


def test_network_output_keeps_its_order_when_it_is_flat(tmp_path: Path) -> None:
    name = given(network(tmp_path / "flat.onnx", [1, 3, 24, 32], op="Flatten"))
    image = picture(24, 32)
    vector = modality_named(name).describe(image)
    expected = ((image / 255.0 - MEAN) / STD).transpose(2, 0, 1).ravel()
    np.testing.assert_allclose(vector, expected / np.linalg.norm(expected), atol=1e-6)


def test_features_are_not_computable_when_the_network_is_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = FeatureSettings.of((given(network(tmp_path / "mix.onnx")), "color"))
    assert settings.computable
    monkeypatch.setattr("smal.features.onnx._given", {})
    assert not settings.computable


def test_missing_onnxruntime_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = network(tmp_path / "mix.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    line = refusal(name)
    assert line.startswith(f"{name}: needs the package onnxruntime")
    assert line.endswith("pip install -e '.[onnx]'")
    # The refusal is not remembered once it is installed.
    monkeypatch.undo()
    assert modality_named(given(name)).size == 4


# -- work without an end ----------------------------------------------------------------------------------------------


def computed(path: Path, nodes: list[Any], *constants: Any) -> str:
    """Write a network of a few nodes from `x` to `y`, and return its modality's name."""
    given = [helper.make_tensor_value_info("x", FLOAT, ANY)]
    graph = helper.make_graph(
        nodes, "g", given, [helper.make_tensor_value_info("y", FLOAT, None)], constants
    )
    onnx.save_model(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8),
        str(path),
    )
    return f"onnx:{path}"


def loop(path: Path, *before: Any) -> str:
    """Write a network that loops `times` times, or without an end if no node computes `times`."""
    value = helper.make_tensor_value_info
    flag = onnx.TensorProto.BOOL
    body = helper.make_graph(
        [helper.make_node("Identity", [x], [y]) for x, y in (("on", "still"), ("v", "w"))],
        "body",
        [value("i", onnx.TensorProto.INT64, []), value("on", flag, []), value("v", FLOAT, None)],
        [value("still", flag, []), value("w", FLOAT, None)],
    )
    endless = [] if before else [helper.make_tensor("times", onnx.TensorProto.INT64, [], [2**62])]
    return computed(
        path, [*before, helper.make_node("Loop", ["times", "", "x"], ["y"], body=body)], *endless
    )


def test_network_is_refused_when_an_image_takes_too_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_features, "LONGEST_S", 0.5)
    line = refusal(loop(tmp_path / "loop.onnx"))
    assert line.startswith(f"{tmp_path}/loop.onnx: ")
    assert re.search(r"an image( of it)? takes more than", line)


def test_network_is_refused_when_it_takes_all_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_features, "MOST_MEMORY", 2**30)
    size = helper.make_tensor("size", onnx.TensorProto.INT64, [2], [20_000, 20_000])
    nodes = [
        helper.make_node("ConstantOfShape", ["size"], ["matrix"]),
        helper.make_node("ReduceMean", ["matrix"], ["mean"], keepdims=0),
        helper.make_node("Add", ["x", "mean"], ["y"]),
    ]
    line = refusal(computed(tmp_path / "huge.onnx", nodes, size))
    assert line.startswith(f"{tmp_path}/huge.onnx: the network does not run: ")


def test_image_is_refused_when_it_makes_the_network_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Only a picture that is white all over makes it loop: a blank one and noise have a dark pixel.
    nodes = [
        helper.make_node("ReduceMin", ["x"], ["darkest"], keepdims=0),
        helper.make_node("Relu", ["darkest"], ["above"]),
        helper.make_node("Mul", ["above", "many"], ["so"]),
        helper.make_node("Cast", ["so"], ["count"], to=onnx.TensorProto.INT64),
        helper.make_node("Add", ["count", "one"], ["times"]),
    ]
    path = tmp_path / "white.onnx"
    loop(path, *nodes)
    model = onnx.load(str(path))
    model.graph.initializer.extend([
        helper.make_tensor("many", FLOAT, [], [1e15]), helper.make_tensor("one", onnx.TensorProto.INT64, [], [1]),
    ])  # fmt: skip
    onnx.save_model(model, str(path))
    modality = modality_named(given(f"onnx:{path}"))
    modality.describe(picture(224, 224))
    monkeypatch.setattr(onnx_features, "_LONGEST_WAIT_S", 0.5)
    with pytest.raises(ValueError, match=r"white.onnx: an image takes more than 0.5 s"):
        modality.describe(np.full((224, 224, 3), 255, dtype=np.uint8))
