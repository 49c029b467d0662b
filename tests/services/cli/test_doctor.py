"""``smal doctor``: each check finds what works, and names what does not in words that help."""

import socket
import sys
from collections.abc import Iterator

import pytest

from services.cli.doctor import check_port, check_rendering, check_served
from services.kit.errors import JobError
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from tests.services.cli.conftest import Smal
from tests.services.conftest import RunNode


def printing(text: str, ending: str = "") -> tuple[str, ...]:
    """Return a command that prints a text, in place of the renderer's probe."""
    return (sys.executable, "-c", f"print({text!r}); {ending}")


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (printing('{"error": "no Vulkan driver found"}'), "no Vulkan driver found"),
        (
            printing("", "import os; os.kill(os.getpid(), 11)"),
            "the Vulkan driver crashed (SIGSEGV)",
        ),
        (
            printing("", "raise SystemExit('no module sapien')"),
            "the renderer failed: no module sap",
        ),
        (printing("", "raise SystemExit(3)"), "the renderer failed: no output; install with"),
        (printing("[1]"), "the renderer failed: "),
    ],
    ids=["named", "crash", "exception", "silence", "nonsense"],
)
def test_rendering_that_fails(command: tuple[str, ...], text: str) -> None:
    with pytest.raises(JobError) as caught:
        check_rendering(command)
    assert str(caught.value).startswith(text)


def test_no_vulkan_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    with pytest.raises(JobError, match=r"nonexistent\.json not found; unset it, or install Mesa"):
        check_rendering()


@pytest.mark.rendering
def test_rendering_for_real() -> None:
    assert "first frame after" in check_rendering()


@pytest.mark.zenoh
def test_a_port_of_a_running_stack(
    router_endpoint: str, settings: ServiceSettings, run_node: RunNode
) -> None:
    run_node(Node("robot", settings))
    found = check_port(ServiceSettings(router=router_endpoint))
    assert found.endswith(
        "is used by the running stack of rescuebot, for anyone who can reach it: robot"
    )


@pytest.fixture
def stranger() -> Iterator[str]:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield f"tcp/127.0.0.1:{listening.getsockname()[1]}"


def test_a_problem_is_one_line_and_exit_status_1(
    stranger: str, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VK_ICD_FILENAMES", "/no/such/driver.json")
    status, out, err = smal("doctor", "--router", stranger)
    assert (status, err) == (1, "")
    lines = out.splitlines()
    assert [line.split()[1] for line in lines] == ["python", "disk", "zenoh", "port", "rendering"]
    assert [line.split()[0] for line in lines] == ["ok", "ok", "ok", "problem", "problem"]
    assert "/no/such/driver.json" in lines[-1]


def test_doctor_names_a_robot_that_no_instance_serves() -> None:
    shared = {
        "features": {"0123abcd-2": ["rescuebot", "rescuebot-2"]},
        "policy": {"89abcdef-2": ["rescuebot"]},
    }
    check_served(["rescuebot"], shared)
    with pytest.raises(JobError, match="rescuebot-2 by no instance of policy"):
        check_served(["rescuebot", "rescuebot-2"], shared)
