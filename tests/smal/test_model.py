"""A model survives its file, and a damaged file is refused."""

import dataclasses
import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smal.files import container
from smal.files.container import ModelError, replacing
from smal.files.stored import FORMAT_VERSION
from smal.keyframes import MapConfig
from smal.model import Model
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import PaperModel
from tests import corridor as visual_corridor
from tests.smal.worlds import COLOR, corridor, drive


@pytest.fixture(scope="module")
def model() -> PaperModel:
    views = corridor(30)
    drives = [drive(views, start, seed=start, name=f"drive {start}") for start in range(2)]
    return learn(
        [*drives, drive(views, 3, 9, name="ü", end=11)],
        LearningSettings(features=COLOR, sequence_length=3),
    )


@pytest.fixture
def saved(model: PaperModel, tmp_path: Path) -> Path:
    path = tmp_path / "x.smal"
    model.save(path)
    return path


def assert_same(one: object, other: object) -> None:
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    elif isinstance(one, tuple):
        assert isinstance(other, tuple)
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


def harmed(part: Any, name: str, harm: Callable[[Any], Any]) -> Any:
    return dataclasses.replace(part, **{name: harm(getattr(part, name))})


def test_round_trip(model: PaperModel, saved: Path) -> None:
    assert_same(PaperModel.load(saved), model)
    assert list(saved.parent.iterdir()) == [saved]


@pytest.mark.parametrize(
    ("name", "harm"),
    [
        ("templates", lambda model: np.full_like(model.templates, np.nan)),
        ("templates", lambda model: 1e38 * model.templates),
        ("policy", lambda model: np.full_like(model.policy, -7)),
        ("policy", lambda model: model.policy[:-1]),
        ("atoms", lambda model: tuple(atoms[:-3] for atoms in model.atoms)),
        ("transitions", lambda model: harmed(model.transitions, "goals", lambda one: one[None])),
        ("transitions", lambda model: harmed(model.transitions, "state", lambda one: one + 10**9)),
        ("transitions", lambda model: harmed(model.transitions, "offsets", lambda one: one[::-1])),
    ],
)
def test_model_is_refused_when_a_part_is_impossible(
    model: PaperModel, name: str, harm: Callable[[PaperModel], Any]
) -> None:
    with pytest.raises(ValueError, match="streams" if name == "atoms" else name):
        dataclasses.replace(model, **{name: harm(model)})


def test_saving_replaces_atomically(
    model: PaperModel, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = saved.read_bytes()
    monkeypatch.setattr(
        container.os, "fsync", lambda _: (_ for _ in ()).throw(OSError("disk full"))
    )
    with pytest.raises(OSError, match="disk full"):
        model.save(saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_model_file_is_refused_when_any_byte_is_altered(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    for at in [
        *range(200),
        *range(200, len(content), 997),
        *range(len(content) - 64, len(content)),
    ]:
        content[at] ^= 1
        saved.write_bytes(content)
        with pytest.raises(ModelError):
            PaperModel.load(saved)
        content[at] ^= 1


def test_header_of_a_file_is_read_alone(model: PaperModel, saved: Path) -> None:
    content = saved.read_bytes()
    path = saved.with_name("part.smal")
    end = 20 + struct.unpack_from("<Q", content, 12)[0]
    for size in range(0, end, end // 50):
        path.write_bytes(content[:size])
        with path.open("rb") as file, pytest.raises(ModelError, match=r"\Apart: .*\Z"):
            container.read_meta(file, "part", FORMAT_VERSION)
    for size in (end, len(content)):
        path.write_bytes(content[:size])
        with path.open("rb") as file:
            assert container.read_meta(file, "part", FORMAT_VERSION)["states"] == model.states
    for meta in (b"[]", b"{}", b'{"meta": []}', b"[" * 100_000, b"\xff"):
        path.write_bytes(struct.pack("<8sIQ", container.MAGIC, FORMAT_VERSION, len(meta)) + meta)
        with (
            path.open("rb") as file,
            pytest.raises(ModelError, match="part: the header does not describe a model"),
        ):
            container.read_meta(file, "part", FORMAT_VERSION)
    path.write_bytes(struct.pack("<8sIQ", container.MAGIC, FORMAT_VERSION, 2**40))
    with path.open("rb") as file, pytest.raises(ModelError, match="at most"):
        container.read_meta(file, "part", FORMAT_VERSION)


def test_model_file_is_refused_when_it_is_missing_or_newer(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[8:12] = struct.pack("<I", FORMAT_VERSION + 1)
    saved.write_bytes(content)
    with pytest.raises(
        ModelError, match=f"format {FORMAT_VERSION + 1}.*reads format {FORMAT_VERSION}"
    ):
        PaperModel.load(saved)
    with pytest.raises(ModelError, match="No such file"):
        PaperModel.load(saved.parent / "none")


def test_features_computed_differently_are_refused(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smal.features.settings.DESCRIPTOR_VERSION", 0)
    with pytest.raises(ModelError, match="learn it again"):
        PaperModel.load(saved)


def test_link_is_kept_when_its_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    link = tmp_path / "link"
    target = tmp_path / "there" / "target"
    link.symlink_to(target)
    for content in (b"first", b"second"):
        with replacing(link) as file:
            file.write(content)
        assert link.is_symlink()
        assert target.read_bytes() == content
    assert [path.name for path in target.parent.iterdir()] == ["target"]


def test_oversized_model_is_not_written(
    model: PaperModel, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = saved.read_bytes()
    monkeypatch.setattr(container, "LARGEST", container.LARGEST_HEADER + len(before) // 2)
    with pytest.raises(ModelError, match="learn fewer drives"):
        model.save(saved)
    assert saved.read_bytes() == before


def test_model_file_keeps_the_map_config(tmp_path: Path) -> None:
    taught = visual_corridor.model()
    config = MapConfig(most_variants=2, hidden=0.2)
    path = tmp_path / "map.smal"
    dataclasses.replace(taught, mapped=dataclasses.replace(taught.mapped, config=config)).save(path)
    assert Model.load(path).mapped.config == config


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("most_variants", 0),
        ("most_variants", 2.5),
        ("hidden", math.nan),
        ("hidden", 1.0),
        ("usual", 1.0),
        ("reference", 10**9),
        ("leading", "64"),
    ],
)
def test_map_config_refuses_numbers_that_shape_no_map(name: str, number: object) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be above 0, at most [0-9.e+]+, got "):
        MapConfig(**{name: number})  # type: ignore[arg-type]


def test_map_config_refuses_fewer_views_than_a_length() -> None:
    with pytest.raises(ValueError, match=r"^looked_at must be at least views_a_length, 5, got 4$"):
        MapConfig(looked_at=4)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda mapped: mapped.pop("config"), "missing 'config'"),
        (lambda mapped: mapped.update(config=[1]), "config of the map must be a mapping"),
        (lambda mapped: mapped["config"].pop("hidden"), "config of the map lacks hidden"),
        (lambda mapped: mapped["config"].update(unknown_number=1), "unknown_number"),
    ],
    ids=["missing", "list", "incomplete", "unknown"],
)
def test_model_file_is_refused_when_its_config_is_invalid(
    damage: Callable[[dict[str, Any]], object], expected: str, tmp_path: Path
) -> None:
    meta, arrays = visual_corridor.model()._header()
    damaged = json.loads(json.dumps(meta))
    damage(damaged["map"])
    path = tmp_path / "map.smal"
    container.write(path, FORMAT_VERSION, damaged, arrays)
    with pytest.raises(ModelError, match=expected):
        Model.load(path)
