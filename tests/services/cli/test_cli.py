"""What every command has in common: its help, and mistakes as one line with the promised exit status."""

import errno
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from services.cli import main as cli
from services.cli.options import feature_flags
from services.kit.errors import UsageError
from services.kit.process import EXIT_FAILED, EXIT_USAGE
from services.kit.version import program_version
from services.kit.zenoh_session import open_client
from smal.features import FeatureSettings
from smal.files.stored import FORMAT_VERSION
from tests import corridor
from tests.services.chain import LENGTH, save_model
from tests.services.cli.conftest import ROOT, Mistake, Smal


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_every_command_of_the_list_explains_itself_with_an_example(name: str, smal: Smal) -> None:
    status, out, err = smal(name, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"Usage: smal {name} ")
    assert f"Example: smal {name}" in out
    assert len(cli.COMMANDS[name][1]) <= 55, "one line of a terminal"


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


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/data/x.json"), EXIT_FAILED,
         "smal: /data/x.json: No space left on device\n"),
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


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("nonsense",),
        ("run", "--model", "x", "--episodes", "0"),
        ("demonstrate", "--camera", "big"),
        ("demonstrate", "--shake", "nan"),
        ("demonstrate", "--goal", "\n"),
        ("demonstrate", "--modalities", "smell"),
        ("demonstrate", "--camera", "160x120", "--connect", "tcp/127.0.0.1:9"),
        ("up", "--robot", "A B"),
        ("up", "--model", "none.smal"),
        ("up", "--robots", "33"),
        ("up", "--robot", "r" * 31, "--robots", "2"),
        ("secure", "init", "keys", "--robot", "r" * 31, "--robots", "2"),
        ("up", "--scale", "recorder=2"),
        ("up", "--scale", "recognition=00"),
        ("up", "--scale", "recognition=10"),
        ("run", "--model", "x", "--scheme", "dream"),
    ],
)
def test_bad_use_names_the_last_option(mistake: Mistake, arguments: tuple[str, ...]) -> None:
    said = mistake(EXIT_USAGE, *arguments)
    named = [one for one in arguments if one.startswith("--") and one != "--connect"]
    assert not named or named[-1] in said or arguments[-1] in said


def test_a_world_that_is_none_is_named_beside_those_that_are(mistake: Mistake) -> None:
    said = mistake(EXIT_USAGE, "demonstrate", "--world", "atlantis")
    assert "atlantis" in said
    assert "campus" in said


@pytest.mark.zenoh
def test_a_router_that_cannot_be_there(mistake: Mistake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.kit.bus.open_client", lambda *where, **_: open_client(*where[:2], patience_s=0.1))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = mistake(EXIT_FAILED, "up", "--world", "yard", "--router", f"tcp/127.0.0.1:{port}")
        assert f"{port}" in said
        assert "in use" in said
    demonstrate = ("demonstrate", "--world", "yard", "--out", str(tmp_path))
    assert "127.0.0.1:9" in mistake(EXIT_FAILED, *demonstrate, "--connect", "tcp/127.0.0.1:9")
    for command in (("up", "--world", "yard", "--router"), ("topic", "hz", "--router"), (*demonstrate, "--connect")):
        assert "'memory/test': expected tcp/<host>:<port>" in mistake(EXIT_FAILED, *command, "memory/test")


# -- models -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a folder with a model of each scheme, and files that are none."""
    folder = tmp_path_factory.mktemp("models")
    save_model(folder / "corridor.smal")
    content = bytearray(corridor.save_model(folder / "mapped.smal").read_bytes())
    content[8:12] = struct.pack("<I", FORMAT_VERSION + 1)
    (folder / "newer.smal").write_bytes(content)
    for name, text in (("text.smal", b"not a model"),):
        (folder / name).write_bytes(text)
    return folder


@pytest.mark.parametrize("command", ["run", "up"])
@pytest.mark.parametrize(
    ("name", "flags", "line"),
    [
        ("none", (), "No such file"),
        ("text", (), "text.smal"),
        ("newer", (), f"format {FORMAT_VERSION + 1}"),
        ("mapped", ("--stride", "2"), "stride 2: the filter decides at every frame; for a stride"),
        ("mapped", ("--scheme", "paper"), "it was learned for the scheme 'filter', not 'paper'"),
        ("mapped", ("--goal", "office"), "the model has no goal 'office'; it has victim"),
        ("mapped", ("--modalities", "color"), "--modalities color: the model was learned on"),
        ("corridor", ("--scheme", "filter"), "it was learned for the scheme 'paper', not 'filter'"),
        ("corridor", ("--stride", "4"), f"stride must be 1 to the sequence length {LENGTH}, got 4"),
        ("corridor", ("--goal", "victim"), "goal 'victim': the paper's scheme goes to the nearest goal"),
    ],
)
def test_a_model_that_cannot_be_used_so_is_bad_use(
    command: str, name: str, flags: tuple[str, ...], line: str, models: Path, mistake: Mistake
) -> None:
    assert line in mistake(EXIT_USAGE, command, "--world", "yard", "--model", str(models / f"{name}.smal"), *flags)


def test_what_a_model_says_makes_no_network_run(tmp_path: Path) -> None:
    named = FeatureSettings.of(("color", f"onnx:{'ab' * 32}:4"))
    with pytest.raises(UsageError, match="is run only where its file is given, as onnx:FILE"):
        feature_flags(None, named)
    onnx = pytest.importorskip("tests.smal.test_onnx_features", exc_type=ImportError)
    text = f"color,{onnx.network(tmp_path / 'mix.onnx')}"
    given = FeatureSettings.parse(text)
    assert feature_flags(given, FeatureSettings.parse(text)) == ("--modalities", text)
    with pytest.raises(UsageError, match=r"the model was learned on color,onnx:abab"):
        feature_flags(given, named)


def test_places_for_results_are_checked_before_the_stack_starts(mistake: Mistake, models: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    model = models / "mapped.smal"
    for option, value in (
        ("--json", tmp_path / "none" / "runs.json"),
        ("--json", tmp_path),
        ("--json", model),
        ("--report", tmp_path / "file"),
        ("--record", tmp_path / "file" / "deeper"),
    ):
        said = mistake(EXIT_USAGE, "run", "--model", str(model), "--world", "yard", option, str(value))
        assert f"{option} {value}" in said
    assert "--out" in mistake(EXIT_USAGE, "demonstrate", "--world", "yard", "--out", str(tmp_path / "file"))
