"""The README agrees with the program."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image, ImageSequence
from typer.testing import CliRunner

import smal
from services.cli.main import COMMANDS, app
from smal import Atom
from tests import corridor

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


REPLAYED = "tests/services/recordings/test_replay.py::test_a_stack_without_a_robot_answers_a_replay"
#: The test that runs each command of the README.
RUN_BY = {
    "bash deploy/demo.sh": "tests/system/test_demo.py::test_script_passes_its_options_to_the_demo",
    "bash deploy/demo.sh --browser": "tests/system/test_demo.py::test_demo_opens_the_page_in_the_browser",
    "source .venv/bin/activate": "tests/system/test_demo.py::test_setup_ends_with_the_next_command",
    "smal doctor": "tests/system/test_demo.py::test_demo_finds_the_victim_from_a_wheel",
    "smal up --world": "tests/system/test_demo.py::test_demo_opens_the_page_in_the_browser",
    "smal doctor --robot-config": "tests/serial/test_serial_inputs.py::test_doctor_checks_each_input_of_a_base",
    "smal up --robot-body serial": "tests/serial/test_serial_day.py::test_robot_finds_the_goal_when_it_was_taught_once",
    "smal teleop": "tests/services/teleop/test_teleop_terminal.py::test_hold_to_drive_release_to_stop",
    "smal learn": "tests/serial/test_serial_day.py::test_robot_finds_the_goal_when_it_was_taught_once",
    "smal run --connect": "tests/system/test_loop.py::test_two_robots_find_victims_while_an_instance_is_killed",
    "smal import rosbag2": "tests/services/cli/test_importing.py::test_a_bag_becomes_recordings",
    "smal up --robot-body none": REPLAYED,
    "smal replay": REPLAYED,
}  # fmt: skip


def test_readme_fits_in_700_words() -> None:
    assert len(README.split()) <= 700


def test_moving_picture_takes_eight_seconds() -> None:
    (path,) = re.findall(r"!\[.*?\]\((.*?\.webp)\)", README)
    assert (ROOT / path).stat().st_size < 3e6
    with Image.open(ROOT / path) as film:
        assert film.size[0] > 2 * film.size[1]
        durations_ms = []
        for frame in ImageSequence.Iterator(film):
            frame.load()
            durations_ms.append(frame.info["duration"])
    assert sum(durations_ms) == 8000


def test_every_command_of_the_readme_is_run_by_a_test() -> None:
    lines = re.findall(r"^ {4}((?:bash|source|smal) .*?)(?: {3,}|$)", README, re.MULTILINE)
    of_line = {
        line: max((one for one in RUN_BY if line.startswith(one)), key=len, default=None)
        for line in lines
    }
    assert len(lines) == 14
    assert {*of_line.values()} == {*RUN_BY}
    for test in RUN_BY.values():
        path, name = test.split("::")
        assert f"def {name}(" in (ROOT / path).read_text()


def test_topic_table_is_the_generated_one() -> None:
    result = CliRunner().invoke(app, ["topic", "list", "--markdown"])
    assert result.exit_code == 0
    shown = (
        (ROOT / "schemas" / "README.md")
        .read_text()
        .split("<!-- topics -->")[1]
        .split("<!-- /topics -->")[0]
    )
    assert shown.strip() == result.stdout.strip(), (
        "put what `smal topic list --markdown` prints between the marks"
    )


def test_graph_of_topics_is_the_generated_one() -> None:
    result = CliRunner().invoke(app, ["topic", "graph"])
    assert result.exit_code == 0
    page = (ROOT / "services" / "README.md").read_text()
    shown = page.split("<!-- graph -->\n```mermaid\n")[1].split("```\n<!-- /graph -->")[0]
    assert shown == result.stdout, "put what `smal topic graph` prints between the marks"


PAGES = sorted(
    path for path in ROOT.glob("**/*.md") if not {".venv", ".git", "out"} & set(path.parts)
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_path_exists_when_a_page_names_it(page: Path) -> None:
    text = page.read_text()
    linked = [link for link in re.findall(r"\]\(([^)#\s]+)\)", text) if "://" not in link]
    assert not [link for link in linked if not (page.parent / link).exists()]
    named = re.findall(r"`((?:smal|schemas|services|deploy|tests)/[\w./-]*)`", text)
    # What has changed since is what a changelog tells.
    named = [path for path in named if "NAME" not in path and page.name != "CHANGELOG.md"]
    assert not [path for path in named if not (ROOT / path).exists()]


@pytest.mark.parametrize(
    ("page", "some"),
    [
        ("README.md", {"doctor", "up", "teleop", "learn", "run", "import", "replay"}),
        ("services/README.md", {*COMMANDS}),
        ("SECURITY.md", {"doctor", "run", "up", "init", "check", "renew", "rotate", "retire"}),
    ],
)
def test_command_and_options_exist_when_a_page_names_them(page: str, some: set[str]) -> None:
    lines = re.findall(
        r"(?:^ {4}|`|; )(?:SMAL_\S+ )?smal (.*?)(?:`|;| {3,}|$)",
        (ROOT / page).read_text(),
        re.MULTILINE,
    )
    named: set[str] = set()
    for line in lines:
        words = line.split()
        command: Any = typer.main.get_command(app)
        while hasattr(command, "commands") and words and words[0] != "…":
            named.add(words[0])
            command = command.get_command(None, words.pop(0))
            assert command is not None, line
        known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        passes_on = command.context_settings.get("ignore_unknown_options", False)
        assert passes_on or {word for word in words if word.startswith("-")} <= known, line
    assert named >= some


def test_example_of_the_library_finds_its_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drive along a corridor once; then the program of the README drives there from beside the way."""
    monkeypatch.chdir(tmp_path)
    here: list[corridor.Pose] = [(0.1, 0.3, 0.1)]

    def camera_and_wheels() -> Iterator[tuple[np.ndarray, corridor.Pose]]:
        for _ in range(80):
            yield corridor.view(*here[-1]), here[-1]

    way = [corridor.pose(frame) for frame in range(corridor.FRAMES)]
    known = {
        "images": [corridor.view(*pose) for pose in way],
        "atoms": [Atom.FORWARD] * (corridor.FRAMES - 1) + [Atom.STOP],
        "odometry": way,
        "camera_and_wheels": camera_and_wheels(),
        "drive": lambda *motion: here.append(corridor.moved(here[-1], motion)),
    }
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(example, "README.md", "exec"), known)  # noqa: S102 - our own
    assert Path("campus.smal").stat().st_size > 0
    assert math.dist(here[-1][:2], way[-1][:2]) < 0.6


def test_exported_names_of_the_library_exist() -> None:
    assert sorted(smal.__all__) == smal.__all__ == dir(smal)
    for name in smal.__all__:
        found = getattr(smal, name)
        assert getattr(found, "__module__", found.__name__).startswith("smal.")
        assert isinstance(found, ModuleType) == (name == "recordings")
