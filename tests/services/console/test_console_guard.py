"""Access to the page: host names, origins, tokens, and its content security policy."""

import ssl
import subprocess
import time
from contextlib import closing
from http.client import HTTPConnection, HTTPSConnection
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from services.console.config import ConsoleSettings
from services.console.guard import COOKIE
from services.console.newest_content import Board
from services.console.server import WebServer
from services.console.who_drives import LEASE_S
from services.kit.bus import BusError
from services.kit.node import ServiceError
from tests.services.console.conftest import Nobody
from tests.services.console.page import Page, connected
from tests.services.waiting import DEADLINE_S, Lost, eventually

TOKEN = "correct horse battery"  # noqa: S105 - of a test


def test_a_foreign_name_is_refused(page: Page) -> None:
    """Another name of this host would give a foreign page our origin."""
    for host in ("evil.example", "127.0.0.1.evil.example:8080", "[::1].evil", "", "127.0.0.2"):
        answered, said = page.get("/", Host=host)
        assert (answered, b"<html" in said) == (421, False), host
        if host:
            with (
                connected(page) as there,
                pytest.raises(InvalidStatus, match="403"),
                connect(f"ws://{host}/watch", origin=f"http://{host}", sock=there),
            ):
                pass
    # Whatever the port: a container's is another one outside.
    for host in ("localhost:1", "LOCALHOST", "[::1]:8080", "127.0.0.1"):
        answered, said = page.get("/", Host=host)
        assert (answered, b"<html" in said) == (200, True), host


def test_sockets_are_for_the_page_alone(page: Page) -> None:
    for path in ("watch", "drive"):
        for origin in ("http://evil.example", "null", f"http://{page.address}.evil", None):
            with pytest.raises(InvalidStatus, match="403"):
                page.open(path, origin=origin)


def test_server_answers_only_the_paths_of_the_page(page: Page) -> None:
    # Python refuses to read a number of more than 4,300 digits, with an exception.
    numbered = [f"/taught/0123456789abcdef/{number}" for number in ("0", "9" * 5000)]
    for path in ("/../config.py", "/..%2f..%2fconfig.py", *numbered):
        assert page.get(path)[0] == 404, path
        assert page.get(path, Origin="http://evil.example")[0] == 403, path


@pytest.mark.parametrize(
    ("opcode", "said"), [(0x1, b'{"do":"stop"}'), (0x9, b"")], ids=["stop", "ping"]
)
def test_flood_of_a_watcher_does_not_delay_the_driver(
    seated: Page,
    nobody: Nobody,
    monkeypatch: pytest.MonkeyPatch,
    lost_s: Lost,
    opcode: int,
    said: bytes,
) -> None:
    heard_s: list[float] = []
    monkeypatch.setattr(nobody, "hold", lambda _atom, _sent_s: heard_s.append(time.monotonic()))
    frame = bytes((0x80 | opcode, 0x80 | len(said), 0, 0, 0, 0)) + said
    eventually(lambda: heard_s)
    with closing(seated.open("watch")) as watch:
        for _ in range(5):
            watch.socket.sendall(frame * 20_000)
    assert max(np.diff([*heard_s, time.monotonic()])) < LEASE_S + lost_s(heard_s[0])


@pytest.mark.parametrize("path", ["/", "/none"])
def test_every_answer_forbids_foreign_code(page: Page, path: str) -> None:
    connection = HTTPConnection(page.address, timeout=DEADLINE_S)
    connection.request("GET", path)
    headers = {name.lower(): value for name, value in connection.getresponse().getheaders()}
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "require-trusted-types-for 'script'" in policy
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "access-control-allow-origin" not in headers


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Make a certificate of localhost, and a token."""
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "1",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost", "-keyout", "key.pem", "-out", "cert.pem"],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    (tmp_path / "token").write_text(TOKEN + "\n")
    for name in ("token", "key.pem"):
        (tmp_path / name).chmod(0o600)
    return tmp_path


def serve(keys: Path, console: str = "127.0.0.1:0", **others: object) -> WebServer:
    given = {
        "console_cert": keys / "cert.pem",
        "console_key": keys / "key.pem",
        "console_token": keys / "token",
    }
    settings = ConsoleSettings.model_validate({"root": keys, "console": console} | given | others)
    return WebServer(Nobody(keys), Board(), settings)


def test_remote_page_needs_the_token_over_tls(keys: Path) -> None:
    with closing(serve(keys)) as server:
        trusted = ssl.create_default_context(cafile=str(keys / "cert.pem"))
        address = server.address.removeprefix("https://").replace("127.0.0.1", "localhost")

        def get(path: str, **headers: str) -> tuple[int, str | None]:
            connection = HTTPSConnection(address, timeout=DEADLINE_S, context=trusted)
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.getheader("set-cookie")

        assert get("/") == (401, None)
        assert get("/?token=wrong") == (401, None)
        assert get("/", Cookie=f"{COOKIE}=wrong") == (401, None)
        status, cookie = get(f"/?token={TOKEN.replace(' ', '+')}")
        assert status == 303
        assert all(part in cookie for part in ("HttpOnly", "Secure", "SameSite=strict"))
        # Whoever has no token does not keep the loop busy, which an emergency stop may wait for.
        began_s = time.process_time()
        assert get("/", Cookie=f'{COOKIE}="' + "\\" * 15_000 + '"')[0] == 401
        assert time.process_time() - began_s < 2.0, (
            "unquoting it with the square of its length takes 5 s"
        )
        known = cookie.partition(";")[0]
        assert get("/", Cookie=known)[0] == 200
        own = {"origin": f"https://{address}", "ssl": trusted}
        with pytest.raises(InvalidStatus, match="403"), connect(f"wss://{address}/watch", **own):
            pass
        with connect(
            f"wss://{address}/watch", additional_headers={"Cookie": known}, **own
        ) as watch:
            assert "now" in str(watch.recv(5.0))


def test_console_does_not_start_when_its_certificate_is_invalid(keys: Path) -> None:
    subprocess.run(
        ["openssl", "genpkey", "-algorithm", "ed25519", "-out", "key.pem"], cwd=keys, check=True
    )
    with pytest.raises(ServiceError, match="invalid certificate or key"):
        serve(keys)


@pytest.mark.parametrize(
    ("console", "others", "why"),
    [
        (
            "0.0.0.0:0",
            {"console_token": None, "console_cert": None, "console_key": None},
            "reachable by other machines",
        ),
        ("0.0.0.0:0", {"console_token": None}, "reachable by other machines"),
        ("127.0.0.1:0", {"console_token": None}, "required together"),
        ("127.0.0.1:0", {"console_key": None}, "required together"),
        ("127.0.0.1:99999", {}, "invalid port"),
    ],
)
def test_a_page_that_would_be_open_to_others_is_not_served(
    keys: Path, console: str, others: dict[str, object], why: str
) -> None:
    with pytest.raises(ServiceError, match=why):
        serve(keys, console, **others)


def test_a_secret_that_others_can_read_or_guess_is_refused(keys: Path) -> None:
    (keys / "token").write_text("short\n")
    with pytest.raises(ServiceError, match="5 letters"):
        serve(keys)
    for name in ("token", "key.pem"):
        (keys / name).chmod(0o644)
        with pytest.raises(BusError, match=f"{name} can be read by others"):
            serve(keys)
        (keys / name).chmod(0o600)
