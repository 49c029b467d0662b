"""Connected lanes that carry nothing: health reports them, and the process ends."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from schemas.topics import LANES, echo_key
from services.cli.stack import free_endpoint
from services.kit import echo
from services.kit.bus import Bus, BusError, Router
from services.kit.credentials import credentials_in
from services.kit.group import Group
from services.kit.node import Node
from services.kit.settings import FleetSettings, ServiceSettings
from tests.benchmarks.faults.proxy import Link, link
from tests.services.kit.test_routers import linked
from tests.services.secured import make_keys, open_session, secured_router
from tests.services.waiting import eventually, health

pytestmark = pytest.mark.zenoh


@pytest.fixture
def way(router_endpoint: str) -> Iterator[Link]:
    with link(router_endpoint, batches=True) as way:
        yield way


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count a lane as deaf after 3 s."""
    monkeypatch.setattr(echo, "SILENT_S", 2.0)
    monkeypatch.setattr(echo, "DEAF_S", 1.0)


def is_proved(bus: Bus) -> bool:
    """Whether every lane has echoed since the bus was opened."""
    began_s = time.monotonic()
    eventually(lambda: bus.echo_age_s(*LANES) < time.monotonic() - began_s)
    return bus.connected()


def test_every_lane_echoes_with_a_certificate(free_endpoint: str, tmp_path: Path) -> None:
    keys = make_keys(tmp_path)
    endpoint = free_endpoint.replace("tcp/127.0.0.1", "tls/localhost")
    with secured_router(endpoint, keys):
        for role in ("robot", "watcher"):
            with closing(
                Bus("rescuebot", endpoint, credentials=credentials_in(keys, role), role=role)
            ) as bus:
                assert is_proved(bus)


def test_a_sample_of_another_size_is_no_echo(
    client: Bus,
    router_endpoint: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("services.kit.echo.secrets.token_hex", lambda _size: "known")
    with closing(Bus("rescuebot", router_endpoint)) as bus:
        key = echo_key("operator", "known", "urgent", "stop")
        client.sessions["urgent"].put(key, b"\xff" * 4096)
        assert is_proved(bus)
    assert "callback error" not in caplog.text


@pytest.mark.system
def test_echo_passes_between_linked_routers(tmp_path: Path) -> None:
    """The lanes of a process may be at two routers for a while."""
    key = echo_key("robot", "p", "urgent", "stop")
    heard = list[bytes]()
    with linked(tmp_path, secure=True) as stack:
        credentials = credentials_in(tmp_path / "keys", "robot")
        here, there = (open_session(at, credentials) for at in stack._routers.values())
        with closing(here), closing(there):
            there.declare_subscriber(key, lambda sample: heard.append(sample.payload.to_bytes()))

            def arrives() -> bool:
                here.put(key, b"x")
                return bool(heard)

            eventually(arrives)


@pytest.mark.usefixtures("soon")
def test_process_ends_when_its_lane_stays_deaf(settings: ServiceSettings, way: Link) -> None:
    with Node("tracker", settings.model_copy(update={"router": way.address})) as node:
        assert is_proved(node.bus)
        way.harm("deafen", "ordinary")
        with pytest.raises(BusError, match=r"^lane ordinary: no echo .* must be started again$"):
            node.spin(timeout_s=100.0)
        assert node.status().silent == ("ordinary",)


@pytest.mark.usefixtures("soon")
def test_group_without_a_robot_ends_when_a_lane_stays_deaf(way: Link) -> None:
    group = Group("tracker", FleetSettings(router=way.address), lambda *_: None)
    group.robots = ()

    def harm() -> None:
        eventually(lambda: group._here)
        way.harm("cut", "stop")

    threading.Thread(target=harm, daemon=True).start()
    with pytest.raises(BusError, match=r"^lane stop: no echo"):
        group.run()


def test_process_waits_when_the_whole_router_is_gone(
    free_endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(echo, "SILENT_S", 0.5)
    monkeypatch.setattr(echo, "DEAF_S", 0.5)
    router = Router(free_endpoint)
    with closing(Bus("rescuebot", free_endpoint)) as bus:
        assert is_proved(bus)
        router.close()
        eventually(lambda: bus.silent() == LANES)
        gone_s = time.monotonic()
        eventually(lambda: time.monotonic() - gone_s > 2.0)
        bus.check()
        monkeypatch.undo()  # The lanes reach the router again one after another.
        with closing(Router(free_endpoint)):
            bus.wait_connected(100.0)
            bus.check()


#: Run a service for which a lane is deaf within 3 s.
SOON_DEAF = """
import runpy, sys
from services.kit import echo
echo.SILENT_S, echo.DEAF_S = 2.0, 1.0
runpy.run_module(sys.argv.pop(1), run_name="__main__")
"""


@pytest.mark.system
def test_service_reports_and_fails_when_its_stop_lane_is_deaf(way: Link) -> None:
    http = free_endpoint().removeprefix("tcp/")
    module = ("services.recorder", "--router", way.address, "--http", http)
    command = [sys.executable, "-c", SOON_DEAF, *module]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        try:
            eventually(lambda: health(http) == "ok\n")
            way.harm("deafen", "stop")
            eventually(lambda: health(http) == "no echo from the router by lane stop\n")
            _, log = running.communicate(timeout=100.0)
        finally:
            running.kill()
    assert running.returncode == 1
    (line,) = [line for line in log.splitlines() if "ERROR" in line]
    assert "lane stop: no echo for " in line
