"""The README is true where a test can tell."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import smal
from services.cli import app
from smal import Atom

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_topic_table_is_the_generated_one() -> None:
    result = CliRunner().invoke(app, ["topic", "list", "--markdown"])
    assert result.exit_code == 0
    shown = README.split("<!-- topics -->")[1].split("<!-- /topics -->")[0]
    assert shown.strip() == result.stdout.strip()


def test_every_path_that_it_names_exists() -> None:
    named = re.findall(r"`((?:smal|schemas|services|deploy|tests)/[\w./-]*)`", README)
    assert len(named) > 20
    assert not [path for path in named if not (ROOT / path).exists()]


def test_every_command_that_it_names_exists() -> None:
    commands = set(re.findall(r"^ {4}smal (\w+)", README, re.MULTILINE))
    assert commands >= {"doctor", "demonstrate", "learn", "run", "up", "teleop", "topic"}
    for command in commands:
        assert CliRunner().invoke(app, [command, "--help"]).exit_code == 0


def test_the_example_of_the_library_finds_its_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run along a wall that is taught twice; the third time the program of the README moves as was taught."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(0, 256, (6, 60, 3), dtype=np.uint8), (1440, 48))

    def drive() -> list[np.ndarray]:
        views = (wall[:, 16 * place : 16 * place + 64].astype(float) for place in range(60))
        return [np.clip(view + rng.normal(0, 8, view.shape), 0, 255).astype(np.uint8) for view in views]

    taught = np.array([Atom.LEFT if place % 20 < 5 else Atom.FORWARD for place in range(60)], dtype=np.int8)
    moves: list[Atom] = []
    known = {"recordings": [(drive(), taught), (drive(), taught)], "camera": drive(), "move": moves.append}
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(example, "README.md", "exec"), known)  # noqa: S102 - our own
    assert Path("campus.smal").stat().st_size > 0
    assert np.mean(np.array(moves[4:55]) == taught[4:55]) > 0.9


def test_every_name_that_the_library_exports_is_there() -> None:
    assert sorted(smal.__all__) == smal.__all__ == dir(smal)
    for name in smal.__all__:
        assert getattr(smal, name).__module__.startswith("smal.")
