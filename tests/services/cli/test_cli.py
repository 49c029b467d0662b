"""What every command has in common: its help, and errors as one line with the promised exit status."""

import errno
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from services.cli import main as cli
from services.cli.options import Simulator, feature_flags
from services.kit.errors import UsageError
from services.kit.process import EXIT_FAILED
from services.kit.version import program_version
from services.kit.zenoh_session import open_client
from smal.features import FeatureSettings
from smal.model import Model
from tests import corridor
from tests.services.cli.conftest import ROOT, Mistake, Smal


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_command_prints_help_with_an_example_when_asked(name: str, smal: Smal) -> None:
    status, out, err = smal(name, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"Usage: smal {name} ")
    assert f"Example: smal {name}" in out
    assert len(cli.COMMANDS[name][1]) <= 55, "one line of a terminal"


@pytest.mark.parametrize("words", ["learn", "run", "match", "topic info", "model show", "world"])
def test_bare_command_shows_its_usage(words: str, smal: Smal) -> None:
    status, out, err = smal(*words.split())
    assert (status, out) == (2, "")
    assert err.startswith(f"Usage: smal {words} ")
    assert "Example: smal " in err


def test_camera_is_small_by_default() -> None:
    given = Simulator().flags("campus")
    assert given[given.index("--camera-width") :][:4] == (
        "--camera-width", "320", "--camera-height", "240"
    )  # fmt: skip


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for a missing router for a tenth of a second only."""
    monkeypatch.setattr(
        "services.kit.bus.open_client", lambda *where, **_: open_client(*where[:2], patience_s=0.1)
    )


@pytest.mark.zenoh
@pytest.mark.usefixtures("impatient")
def test_run_warns_when_the_model_is_of_another_world(smal: Smal, tmp_path: Path) -> None:
    file = corridor.save_model(tmp_path / "way.smal")
    run = ("run", "--model", file, "--connect", "tcp/127.0.0.1:9", "--world")
    replace(Model.load(file), world="campus").save(file)
    assert "taught in campus, and the robot is in yard" in smal(*run, "yard")[2]
    assert "taught in" not in smal(*run, "campus")[2]


def test_help_and_version_load_no_command(smal: Smal) -> None:
    status, out, _ = smal("--help")
    assert status == 0
    assert all(f"  {name} " in out for name in cli.COMMANDS)
    program = (
        "import sys; from services.cli.main import main; sys.argv = ['smal', '--version']\n"
        "try: main()\n"
        "finally: print([name for name in ('numpy', 'pydantic', 'cv2', 'zenoh') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == f"smal {program_version()}\n[]\n"


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/data/x.json"), EXIT_FAILED,
         "smal: /data/x.json: No space left on device\n"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "/data/x.json"), EXIT_FAILED,
         "smal: /data/x.json: No such file or directory\n"),
        (TimeoutError(), EXIT_FAILED, "smal: TimeoutError\n"),
        (KeyboardInterrupt(), 130, "smal: interrupted\n"),
    ],
)  # fmt: skip
def test_every_error_is_one_line(
    raised: BaseException,
    status: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(**_: object) -> None:
        raise raised

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert (ended.value.code, capsys.readouterr().err) == (status, line)


@pytest.mark.zenoh
@pytest.mark.usefixtures("impatient")
def test_a_router_that_cannot_be_there(mistake: Mistake, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = mistake(EXIT_FAILED, "up", "--world", "yard", "--router", f"tcp/127.0.0.1:{port}")
        assert f"{port}" in said
        assert "in use" in said
    demonstrate = ("demonstrate", "--world", "yard", "--out", str(tmp_path))
    assert "127.0.0.1:9" in mistake(EXIT_FAILED, *demonstrate, "--connect", "tcp/127.0.0.1:9")
    for command in (
        ("up", "--world", "yard", "--router"),
        ("topic", "hz", "--router"),
        (*demonstrate, "--connect"),
    ):
        assert "'memory/test': expected tcp/<host>:<port>" in mistake(
            EXIT_FAILED, *command, "memory/test"
        )


def test_network_runs_only_when_its_file_is_given(tmp_path: Path) -> None:
    named = FeatureSettings.of(("color", f"onnx:{'ab' * 32}:4"))
    with pytest.raises(UsageError, match="is run only where its file is given, as onnx:FILE"):
        feature_flags(None, named)
    onnx = pytest.importorskip("tests.smal.test_onnx_features", exc_type=ImportError)
    text = f"color,{onnx.network(tmp_path / 'mix.onnx')}"
    given = FeatureSettings.parse(text)
    assert feature_flags(given, FeatureSettings.parse(text)) == ("--modalities", text)
    with pytest.raises(UsageError, match=r"the model was learned on color,onnx:abab"):
        feature_flags(given, named)
