"""``smal tune``: folders in; settings, how sure they are, and a command line that works out."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from services.experiments.tuning import problem as tune_problem
from tests.services.cli.conftest import Smal

FRAMES = 60
FAST = ("--modalities", "color,thumbnail")
#: A wall that a camera passes; what is seen at a place is where it is.
WALL = cv2.resize(np.random.default_rng(3).integers(0, 256, (6, 180, 3), dtype=np.uint8), (2160, 72))


def view(place: float) -> np.ndarray:
    left = int(32 * place)
    return np.ascontiguousarray(WALL[:, left : left + 96])


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Make two traverses of the wall, the second dark with some frames of noise, and a slow one. Work beside them."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for name, share in (("ref", 1.0), ("query", 0.5)):
        Path(name).mkdir()
        for place in range(FRAMES):
            image = share * view(place)
            if name == "query" and place % 3 == 0:
                image = rng.uniform(0, 120, image.shape)
            cv2.imwrite(f"{name}/img{place}.png", image.astype(np.uint8))
    Path("slow").mkdir()
    for place in range(FRAMES):
        cv2.imwrite(f"slow/img{place}.png", view(place / 4))
    write_truth(range(FRAMES))
    yield tmp_path
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []  # no half-written file


def write_truth(queries: range) -> None:
    lines = [f"{query},{max(0, query - 1)},{min(FRAMES - 1, query + 1)}" for query in queries]
    Path("truth.csv").write_text("\n".join(["query,reference_first,reference_last", *lines]) + "\n")


def tuned(smal: Smal, *arguments: str) -> tuple[dict[str, Any], str]:
    status, out, _ = smal("tune", *arguments, "--json", "out.json")
    assert status == 0
    return json.loads(Path("out.json").read_text()), out


def labelled(smal: Smal, *arguments: str) -> tuple[dict[str, Any], str]:
    return tuned(smal, "ref", "query", "--truth", "truth.csv", *arguments)


def test_the_command_line_that_it_names_does_what_it_says(folders: Path, smal: Smal) -> None:
    found, out = labelled(smal, *FAST, "--length", "2")
    assert out.splitlines()[-1] == found["match_command"]
    tau = repr(found["threshold"]["tau"])
    assert f"--tau {tau} leaves out what is not sure" in out
    words = shlex.split(found["match_command"])
    assert words[:4] == ["smal", "match", "ref", "query"]
    status, _, _ = smal(*words[1:], "--tau", tau, "--truth", "truth.csv", "--json", "matches.json")
    assert status == 0
    matches = json.loads(Path("matches.json").read_text())
    recommended = found["recommended"]
    assert [matches[name] for name in ("modalities", "weights", "length", "penalty")] == [
        recommended[name] for name in ("modalities", "weights", "length", "penalty")
    ]
    # All that is above tau is right, and as much as was said of the queries with a window.
    answers = [row for row in matches["matches"] if row["reference"] is not None]
    assert all(abs(row["reference"] - row["query"]) <= 1 for row in answers)
    share = sum(row["query"] >= 1 for row in answers) / (FRAMES - 1)
    assert share == pytest.approx(found["threshold"]["recall"], abs=0.02)
    assert found["threshold"]["precision"] == 1.0


def test_held_out_figures_and_every_setting_are_written(folders: Path, smal: Smal) -> None:
    found, out = labelled(smal, *FAST, "--method", "nearest", "--length", "1")
    held_out = found["held_out"]
    for name in ("default", "tuned", "difference"):
        low, high = held_out[name]["interval"]
        assert low <= held_out[name]["value"] <= high
    assert held_out["difference"]["value"] == pytest.approx(held_out["tuned"]["value"] - held_out["default"]["value"])
    areas = [one["auc"] for one in found["tried"]]
    assert areas == sorted(areas, reverse=True)
    assert {tuple(one["modalities"]) for one in found["alone"]} == {("color",), ("thumbnail",)}
    assert found["recommended"]["tuned"] is (held_out["difference"]["interval"][0] > 0)
    assert found["tuned"] == {name: found["tried"][0][name] for name in found["tuned"]}
    assert found["recommended"]["penalty"] is None
    assert "--penalty" not in found["match_command"]
    assert f"{held_out['default']['value']:.3f}" in out
    assert "equal weights" in out


def test_without_labels_the_degradation_is_declared(folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tune_problem, "_STRENGTHS", (0.1, 1.0, 2.0))
    found, out = tuned(smal, "slow", *FAST, "--length", "8")
    assert found["labels"] is False
    assert len(found["conditions"]) == 2
    said = " ".join(out.split())
    assert all(condition.startswith("strength ") and condition in said for condition in found["conditions"])
    assert max(map(len, out.splitlines()[:12])) <= 100
    assert not found["conditions"][0].startswith("strength 0.1:")  # at which nothing was hard
    assert {one["length"] for one in found["tried"]} == {1}
    assert found["recommended"]["length"] == 8
    words = shlex.split(found["match_command"])
    assert words[:4] == ["smal", "match", "slow", "QUERY_DIR"]
    assert words[words.index("--length") + 1] == "8"
    words[3] = "query"
    assert smal(*words[1:])[0] == 0


def test_without_labels_the_same_seed_gives_the_same_answer(folders: Path, smal: Smal) -> None:
    first, second = (tuned(smal, "slow", *FAST, "--method", "nearest", "--seed", "3")[0] for _ in range(2))
    other = tuned(smal, "slow", *FAST, "--method", "nearest", "--seed", "4")[0]
    for found in (first, second, other):
        del found["seconds"]
    assert first == second
    assert first != other


def test_the_paper_s_method_answers_for_learning(folders: Path, smal: Smal) -> None:
    found, out = labelled(smal, "--modalities", "color", "--method", "paper", "--length", "4", "--precision", "0.5")
    scale = found["recommended"]["penalty"]
    assert found["lambda1"] == found["lambda2"] == pytest.approx(scale * math.sqrt(4))
    words = shlex.split(found["learn_command"])
    assert out.splitlines()[-1] == found["learn_command"]
    flags = dict(zip(words[3::2], words[4::2], strict=True))
    assert float(flags["--lambda1"]) == pytest.approx(found["lambda1"], rel=1e-3)
    assert f"--tau {found['threshold']['tau']!r}" in out
    assert flags["--length"] == "4"
    status, _, error = smal(*(word if word != "RECORDINGS" else "none.mcap" for word in words[1:]))
    assert (status, "none.mcap" in error) == (2, True)  # all its flags are understood


def test_damaged_frames_do_not_move_the_truth(folders: Path, smal: Smal) -> None:
    whole = labelled(smal, *FAST, "--method", "image", "--length", "1")[0]["held_out"]["default"]["value"]
    for name in ("ref/img0.png", "ref/img1.png", "ref/img30.png", "query/img2.png", "query/img40.png"):
        Path(name).write_bytes(b"damaged")
    status, _, err = smal(
        "tune", "ref", "query", "--truth", "truth.csv", *FAST, "--method", "image", "--json", "o.json"
    )
    assert status == 0
    assert "skipped 3 unreadable images" in err
    left = json.loads(Path("o.json").read_text())["held_out"]["default"]["value"]
    assert left > whole - 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ref", "--truth", "truth.csv"], "--truth truth.csv: is about queries; give QUERY_DIR as well"),
        (["ref", "query"], "QUERY_DIR query: needs --truth; without labels give REFERENCE_DIR alone"),
        (["ref", "--method", "seqslam"],
         "--method seqslam: has nothing to tune; known are smal, image, nearest, paper"),
        (["ref", "--method", "best"], "--method best: unknown; known are smal, image, nearest, paper"),
        (["ref", "--method", "image", "--length", "3"], "--length 3: the method image is made for 1"),
        (["ref", "--modalities", "hog,depth"],
         "--modalities hog,depth: depth cannot be tuned; give modalities of colour images"),
        (["ref", "--precision", "0"], "--precision 0: must be above 0 and at most 1"),
        (["ref", "--precision", "nan"], "--precision nan: must be above 0 and at most 1"),
        (["nowhere"], "REFERENCE_DIR nowhere: No such file or directory"),
        (["ref", "query", "--truth", "nowhere.csv"], "--truth nowhere.csv: cannot be read: No such file or directory"),
        (["ref", "--json", "nowhere/out.json"], "--json nowhere/out.json: no folder nowhere"),
    ],
)  # fmt: skip
def test_bad_use_is_one_line(folders: Path, smal: Smal, arguments: list[str], message: str) -> None:
    status, out, err = smal("tune", *arguments)
    assert (status, out) == (2, "")
    assert err.splitlines() == [f"smal: {message}"]


def test_too_little_to_tune_on_is_one_line(folders: Path, smal: Smal) -> None:
    write_truth(range(40))
    status, _, err = smal("tune", "ref", "query", "--truth", "truth.csv", *FAST, "--length", "10")
    assert status == 1
    assert err.splitlines() == [
        "smal: query: 40 judged queries and 60 references are too few for windows of 10 frames; with --length L it "
        "takes 5 L queries and 2 L references"
    ]
    for place in range(50, FRAMES):
        Path(f"ref/img{place}.png").unlink()
    status, _, err = smal("tune", "ref", *FAST)
    assert status == 1
    assert err.splitlines() == [
        "smal: ref: 50 images are too few to tune without labels for windows of 10: it takes 60"
    ]
