"""The README is true where a test can tell."""

from __future__ import annotations

import re
from pathlib import Path

from typer.testing import CliRunner

from services.cli import app

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
