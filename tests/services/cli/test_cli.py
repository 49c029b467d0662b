"""Whatever a command raises is one line and the promised exit status; and what `smal up` gives its services."""

from __future__ import annotations

import errno
import re
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.rpc import ResetRequest
from services.cli import main as cli
from services.cli.up import _chain_flags
from services.kit.errors import UsageError
from services.kit.process import EXIT_FAILED, EXIT_USAGE
from services.kit.version import program_version
from tests import corridor
from tests.services.chain import FEATURES, LENGTH, save_model
from tests.services.cli.conftest import ROOT, Smal


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/data/x.json"), EXIT_FAILED,
         "smal: /data/x.json: No space left on device\n"),
        (OSError("the disk is gone"), EXIT_FAILED, "smal: the disk is gone\n"),
        (TimeoutError(), EXIT_FAILED, "smal: TimeoutError\n"),
        (KeyboardInterrupt(), 130, "smal: interrupted\n"),
    ],
)  # fmt: skip
def test_every_error_is_one_line(
    raised: BaseException, status: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(**_: object) -> None:
        raise raised

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert (ended.value.code, capsys.readouterr().err) == (status, line)


def test_a_value_that_no_message_can_carry_is_bad_use(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "app", lambda **_: ResetRequest(seed=-1))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().err
    assert ended.value.code == EXIT_USAGE
    assert said.startswith("smal: seed: ")
    assert said.count("\n") == 1


def test_recognition_and_policy_have_their_model_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model, mapped = save_model(tmp_path / "corridor.smal"), corridor.save_model(tmp_path / "mapped.smal")
    paper, own = ("--model", str(model)), ("--model", str(mapped))
    assert _chain_flags(None, None, None, None) == ((), None)
    assert _chain_flags(Path("corridor.smal"), None, 2, None) == ((*paper, "--stride", "2"), FEATURES)
    assert _chain_flags(Path("corridor.smal"), "paper", None, None) == ((*paper, "--scheme", "paper"), FEATURES)
    assert _chain_flags(Path("mapped.smal"), None, None, None) == (own, corridor.FEATURES)
    named = _chain_flags(Path("mapped.smal"), None, None, "victim")
    assert named == ((*own, "--goal", "victim"), corridor.FEATURES)
    for path, scheme, stride, goal, line in (
        (None, "paper", None, None, "--scheme paper: needs --model"),
        (None, None, 2, None, "--stride 2: needs --model"),
        (None, None, None, "office", "--goal office: needs --model"),
        (tmp_path / "none", None, None, None, "No such file"),
        (mapped, None, None, "office", "the model has no goal 'office'; it has victim"),
        (model, None, None, "victim", "goal 'victim': the paper's scheme goes to the nearest goal"),
        (model, "paper", LENGTH + 1, None, f"stride must be 1 to the sequence length {LENGTH}, got {LENGTH + 1}"),
        (model, "filter", None, None, "it was learned for the scheme 'paper', not 'filter': smal learn --scheme"),
        (mapped, None, 2, None, "only the paper's scheme has a stride"),
    ):
        with pytest.raises(UsageError, match=line):
            _chain_flags(path, scheme, stride, goal)


@pytest.mark.parametrize("command", ["run", "up"])
@pytest.mark.parametrize(
    ("name", "flags", "line"),
    [
        ("mapped", ("--stride", "2"), "stride 2: the filter decides at every frame; only the paper"),
        ("mapped", ("--scheme", "paper"), "it was learned for the scheme 'filter', not 'paper'"),
        ("corridor", ("--scheme", "filter"), "it was learned for the scheme 'paper', not 'filter'"),
        ("corridor", ("--stride", "4"), f"stride must be 1 to the sequence length {LENGTH}, got 4"),
        ("mapped", ("--scheme", "dream"), "'dream' is not one of 'filter', 'paper'"),
    ],
)
def test_a_scheme_that_does_not_go_with_the_model_is_bad_use(
    command: str, name: str, flags: tuple[str, ...], line: str, tmp_path: Path, smal: Smal
) -> None:
    save_model(tmp_path / "corridor.smal")
    corridor.save_model(tmp_path / "mapped.smal")
    status, _, said = smal(command, "--world", "yard", "--model", str(tmp_path / f"{name}.smal"), *flags)
    assert status == EXIT_USAGE
    assert said.startswith("smal: ")
    assert line in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    "command",
    [
        ("up", "--world", "yard", "--router", "memory/test"),
        ("topic", "hz", "--router", "memory/test"),
        ("demonstrate", "--world", "yard", "--out", "drives", "--connect", "memory/test"),
    ],
    ids=lambda command: command[0],
)
def test_a_router_in_memory_is_for_no_command(
    command: tuple[str, ...], smal: Smal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, _, said = smal(*command)
    assert status == EXIT_FAILED
    assert re.fullmatch(r"smal: .*'memory/test': .*expected tcp/<host>:<port>.*\n", said)


@pytest.mark.parametrize(
    ("console", "status", "said"),
    [
        ("0.0.0.0:0", EXIT_FAILED, "other machines reach it"),
        ("127.0.0.1:70000", EXIT_FAILED, "no such port"),
        ("8080", EXIT_USAGE, "console: String should match pattern"),
    ],
)
def test_a_page_that_cannot_be_served_is_said_before_anything_starts(
    smal: Smal, free_endpoint: str, console: str, status: int, said: str
) -> None:
    got, _, line = smal("up", "--world", "yard", "--router", free_endpoint, "--console", console)
    assert (got, line.count("\n")) == (status, 1)
    assert said in line


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_every_command_of_the_list_explains_itself(name: str, smal: Smal) -> None:
    """In its help, with an example, and in one line of a terminal."""
    status, out, err = smal(name, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"Usage: smal {name} ")
    assert f"Example: smal {name}" in out
    assert len(cli.COMMANDS[name][1]) <= 55


def test_help_and_version_load_no_command(smal: Smal) -> None:
    status, out, _ = smal("--help")
    assert status == 0
    assert all(f"  {name} " in out for name in cli.COMMANDS)
    program = (
        "import sys; from services.cli.main import main; sys.argv = ['smal', '--version']\n"
        "try: main()\n"
        "finally: print([name for name in ('numpy', 'pydantic', 'cv2', 'zenoh') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == f"smal {program_version()}\n[]\n"


def test_a_command_that_is_none_is_named_and_another_suggested(smal: Smal) -> None:
    assert smal("mach") == (2, "", "smal: No such command 'mach'. Did you mean 'match'?\n")
