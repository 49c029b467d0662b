"""Who gets in: names, origins, tokens; and what the page may not do."""

from __future__ import annotations

import os
import re
import socket
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing
from http.client import HTTPConnection, HTTPSConnection
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from services.console.config import ConsoleSettings
from services.console.folder import PREFIX, Folder, remove_left_over
from services.console.guard import COOKIE
from services.console.library import Library
from services.console.newest_content import Board
from services.console.web import PAGE, WebServer
from services.console.who_drives import LEASE_S
from services.kit.bus import BusError
from services.kit.node import ServiceError
from tests.services.console.page import Page
from tests.services.waiting import eventually

OpenPage = Callable[[], Page]
TOKEN = "correct horse battery"  # noqa: S105 - of a test
#: Apart from pictures.
MOST_BYTES = 300_000


class Nobody:
    """A person who does nothing."""

    learned = None

    def __init__(self, root: Path) -> None:
        self.library = Library(root)
        self.maps: list[tuple[str, bytes]] = []

    def hold(self, atom: object, sent_s: float) -> Future[None]:
        return self.stop()

    def let_go(self) -> Future[None]:
        return self.stop()

    def leave(self) -> Future[None]:
        return self.stop()

    def stop(self) -> Future[None]:
        done: Future[None] = Future()
        done.set_result(None)
        return done

    def ask(self, ask: object, until_s: float) -> Future[None]:
        return self.stop()

    def make_world(self, name: str, osm_map: Path, folder: Folder) -> Future[None]:
        with closing(folder):
            self.maps.append((name, osm_map.read_bytes()))
        return self.stop()


@pytest.fixture
def nobody(tmp_path: Path) -> Nobody:
    return Nobody(tmp_path)


@pytest.fixture
def page(nobody: Nobody, tmp_path: Path) -> Iterator[Page]:
    """Give a page that is open to this machine, without a bus."""
    server = WebServer(nobody, Board(), ConsoleSettings(root=tmp_path, console="127.0.0.1:0"))
    page = Page(server)
    yield page
    page.close()
    server.close()


@pytest.fixture
def seated(page: Page) -> Page:
    """Give a page whose person drives."""
    page.take()
    eventually(lambda: page.word)
    return page


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example:8080", "evil.example:127", "[::1].evil", "", "127.0.0.2"]
)
def test_a_foreign_name_is_refused(page: Page, host: str) -> None:
    """A name of somebody else's may be made to lead here: then their page would be of our origin."""
    status, said = page.get("/", Host=host)
    assert (status, b"<html" in said) == (421, False)


def test_a_foreign_name_that_leads_here_opens_no_socket(page: Page) -> None:
    name, port = page.address.split(":")
    with (
        socket.create_connection((name, int(port))) as there,
        pytest.raises(InvalidStatus, match="403"),
        connect("ws://evil.example/watch", origin="http://evil.example", sock=there),
    ):
        pass


@pytest.mark.parametrize("host", ["localhost:1", "LOCALHOST", "[::1]:8080", "127.0.0.1"])
def test_names_of_this_machine_are_taken(page: Page, host: str) -> None:
    """Whatever the port: a container's is another one outside."""
    assert page.get("/", Host=host)[0] == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://{}", "http://{}.evil", "http://localhost", None]
)
@pytest.mark.parametrize("path", ["watch", "drive"])
def test_sockets_are_for_the_page_alone(page: Page, path: str, origin: str | None) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        page.open(path, origin=origin and origin.format(page.address))


def test_a_foreign_page_is_answered_nothing(page: Page) -> None:
    assert page.get("/", Origin="http://evil.example")[0] == 403
    assert page.get("/../config.py")[0] == 404
    assert page.get("/..%2f..%2fconfig.py")[0] == 404
    assert page.get("/taught/0123456789abcdef/0")[0] == 404


@pytest.mark.parametrize("of", ["", "..%2f..%2fetc%2fpasswd", "%00", "a" * 3000])
def test_pictures_are_of_what_is_listed(page: Page, of: str) -> None:
    assert page.get(f"/thumbnail?of={of}&k=0")[0] == 404


def test_a_number_of_any_length_is_a_picture_that_is_not_there(page: Page) -> None:
    """Python refuses to read one of more than 4,300 digits, with an exception."""
    assert page.get(f"/taught/0123456789abcdef/{'9' * 5000}")[0] == 404
    assert page.get(f"/thumbnail?of=x&k={'9' * 5000}")[0] == 404


def test_rubbish_does_not_fill_the_log(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    name, port = page.address.split(":")
    for _ in range(100):
        with socket.create_connection((name, int(port)), timeout=5.0) as there:
            there.sendall(b"rubbish\r\n\r\n")
            assert b"400" in there.recv(100)
    assert len([one for one in caplog.records if one.name == "uvicorn.error"]) <= 3


def test_pings_whose_answers_nobody_takes_fill_no_memory(page: Page) -> None:
    name, port = page.address.split(":")
    ping = bytes((0x89, 0x80 | 125, 0, 0, 0, 0)) + bytes(125)
    with socket.socket() as there:
        there.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        there.settimeout(30.0)
        there.connect((name, int(port)))
        there.sendall(
            f"GET /watch HTTP/1.1\r\nHost: {page.address}\r\nOrigin: http://{page.address}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            "Sec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        assert b"101" in there.recv(1000)
        for _ in range(300):
            there.sendall(ping * 1000)  # 39 MB in all
        there.sendall(bytes((0x88, 0x80, 0, 0, 0, 0)))  # the end
        answered = 0
        while got := there.recv(1 << 20):
            answered += len(got)
    assert answered < 20e6


def test_a_watcher_says_once_of_each_message_that_it_was_seen(page: Page) -> None:
    watch = page.open("watch")
    assert "now" in str(watch.recv(5.0))
    watch.send('{"do": "seen"}')
    watch.send('{"do": "seen"}')
    with pytest.raises(ConnectionClosed, match=r"4003.*nothing more to be seen"):
        list(watch)


@pytest.mark.parametrize(
    ("opcode", "said"), [(0x1, b'{"do":"stop"}'), (0x9, b""), (0xA, b"")], ids=["stop", "ping", "pong"]
)
def test_whoever_floods_a_socket_leaves_its_turn_to_who_drives(
    seated: Page, nobody: Nobody, monkeypatch: pytest.MonkeyPatch, opcode: int, said: bytes
) -> None:
    """The robot misses a driver who is not heard for LEASE_S."""
    heard_s: list[float] = []

    def hold(_atom: object, _sent_s: float) -> Future[None]:
        heard_s.append(time.monotonic())
        return nobody.stop()

    monkeypatch.setattr(nobody, "hold", hold)
    frame = bytes((0x80 | opcode, 0x80 | len(said), 0, 0, 0, 0)) + said
    eventually(lambda: heard_s)
    with closing(seated.open("watch")) as watch:
        for _ in range(10):
            watch.socket.sendall(frame * 20_000)
    assert max(np.diff([*heard_s, time.monotonic()])) < LEASE_S


def test_every_answer_forbids_foreign_code(page: Page) -> None:
    for path in ("/", "/main.js", "/none", "/thumbnail"):
        connection_headers = _headers(page, path)
        policy = connection_headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "require-trusted-types-for 'script'" in policy
        assert connection_headers["cross-origin-resource-policy"] == "same-origin"
        assert "access-control-allow-origin" not in connection_headers


def _headers(page: Page, path: str) -> dict[str, str]:
    connection = HTTPConnection(page.address, timeout=5.0)
    connection.request("GET", path)
    return {name.lower(): value for name, value in connection.getresponse().getheaders()}


def test_the_page_has_no_inline_code_and_makes_no_markup_of_text() -> None:
    files = {path.name: path.read_text() for path in PAGE.iterdir()}
    assert not re.search(r"\son\w+=|style=|<script(?! type=\"module\" src=)", files["index.html"])
    for name, text in files.items():
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b", text), name
        assert not re.search(r"https?://(?!www\.w3)", text), f"{name} names another place"
    assert sum(path.stat().st_size for path in PAGE.iterdir()) < MOST_BYTES


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


def settings(keys: Path, console: str = "127.0.0.1:0", **others: object) -> ConsoleSettings:
    given = {"console_cert": keys / "cert.pem", "console_key": keys / "key.pem", "console_token": keys / "token"}
    return ConsoleSettings.model_validate({"root": keys, "console": console} | given | others)


def test_elsewhere_only_who_knows_the_token_gets_in_and_all_is_encrypted(keys: Path) -> None:
    server = WebServer(Nobody(keys), Board(), settings(keys))
    try:
        trusted = ssl.create_default_context(cafile=str(keys / "cert.pem"))
        address = server.address.removeprefix("https://").replace("127.0.0.1", "localhost")

        def get(path: str, **headers: str) -> tuple[int, str | None]:
            connection = HTTPSConnection(address, timeout=5.0, context=trusted)
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.getheader("set-cookie")

        assert get("/") == (401, None)
        assert get("/?token=wrong") == (401, None)
        assert get("/", Cookie=f"{COOKIE}=wrong") == (401, None)
        status, cookie = get(f"/?token={TOKEN.replace(' ', '+')}")
        assert status == 303
        assert cookie is not None
        assert all(part in cookie for part in ("HttpOnly", "Secure", "SameSite=strict"))
        # Whoever has no token does not keep the loop busy, which an emergency stop may wait for.
        began_s = time.monotonic()
        assert get("/", Cookie=f'{COOKIE}="' + "\\" * 15_000 + '"')[0] == 401
        assert time.monotonic() - began_s < 2.0, "unquoting it with the square of its length takes 5 s"
        known = cookie.partition(";")[0]
        assert get("/", Cookie=known)[0] == 200
        own = {"origin": f"https://{address}", "ssl": trusted}
        with pytest.raises(InvalidStatus, match="403"), connect(f"wss://{address}/watch", **own):
            pass
        with connect(f"wss://{address}/watch", additional_headers={"Cookie": known}, **own) as watch:
            assert "now" in str(watch.recv(5.0))
    finally:
        server.close()


def test_a_certificate_that_is_of_no_use_is_said_before_anything_is_served(keys: Path) -> None:
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", "key.pem"], cwd=keys, check=True)
    with pytest.raises(ServiceError, match="are of no use"):
        WebServer(Nobody(keys), Board(), settings(keys))
    (keys / "key.pem").chmod(0o644)
    with pytest.raises(BusError, match=r"key.pem can be read by others"):
        WebServer(Nobody(keys), Board(), settings(keys))


@pytest.mark.parametrize(
    ("console", "others", "why"),
    [
        ("0.0.0.0:0", {"console_token": None, "console_cert": None, "console_key": None}, "other machines reach it"),
        ("0.0.0.0:0", {"console_token": None}, "other machines reach it"),
        ("127.0.0.1:0", {"console_token": None}, "go together"),
        ("127.0.0.1:0", {"console_key": None}, "go together"),
        ("127.0.0.1:99999", {}, "no such port"),
    ],
)
def test_a_page_that_would_be_open_to_others_is_not_served(
    keys: Path, console: str, others: dict[str, object], why: str
) -> None:
    with pytest.raises(ServiceError, match=why):
        WebServer(Nobody(keys), Board(), settings(keys, console, **others))


def test_a_token_that_others_can_read_or_guess_is_refused(keys: Path) -> None:
    (keys / "token").write_text("short\n")
    with pytest.raises(ServiceError, match="5 letters"):
        WebServer(Nobody(keys), Board(), settings(keys))
    (keys / "token").chmod(0o644)
    with pytest.raises(BusError, match="can be read by others"):
        WebServer(Nobody(keys), Board(), settings(keys))


def test_a_port_that_is_taken_is_named(page: Page, tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match=r"cannot listen on 127.0.0.1:\d+: Address already in use"):
        WebServer(Nobody(tmp_path), Board(), ConsoleSettings(root=tmp_path, console=page.address))


# -- maps ------------------------------------------------------------------------------------------------------------


def left_over() -> set[Path]:
    return set(Path(tempfile.gettempdir()).glob(f"{PREFIX}*"))


def test_a_map_of_whoever_drives_is_taken_whole(seated: Page, nobody: Nobody) -> None:
    sent = os.urandom(300_000)
    assert seated.post("/map?name=My+town", sent) == (202, "taken\n")
    assert nobody.maps == [("My town", sent)]


@pytest.mark.parametrize(
    ("path", "headers", "status", "why"),
    [
        ("/map?name=town", {"Smal-Seat": "guess"}, 403, "only who drives"),
        ("/map?name=town", {"Smal-Seat": ""}, 403, "only who drives"),
        ("/map?name=town", {"Origin": "http://evil.example"}, 403, "only the console's own page"),
        ("/map?name=..%2Ftown", {}, 400, "the world's name"),
        ("/map", {}, 400, "the world's name"),
        ("/", {}, 405, "nothing is changed this way"),
        ("/thumbnail", {}, 405, "nothing is changed this way"),
    ],
)
def test_a_map_that_may_not_be_taken_is_not(
    seated: Page, nobody: Nobody, path: str, headers: dict[str, str], status: int, why: str
) -> None:
    before = left_over()
    answer, said = seated.post(path, b"<osm/>", **headers)
    assert (answer, why in said, said.count("\n")) == (status, True, 1)
    assert nobody.maps == []
    assert left_over() <= before


def test_a_map_without_an_origin_is_not_taken(seated: Page, nobody: Nobody) -> None:
    connection = HTTPConnection(seated.address, timeout=5.0)
    connection.request("POST", "/map?name=town", b"<osm/>", {"Smal-Seat": seated.word})
    assert connection.getresponse().status == 403
    assert nobody.maps == []


def test_a_map_that_is_too_large_ends_early(seated: Page, nobody: Nobody, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.console.maps._LARGEST_MAP", 1_000_000)
    before = left_over()
    status, why = seated.post("/map?name=town", bytes(1_000_001))
    assert (status, why) == (413, "a map has at most 1 MB; cut it smaller\n")
    assert (nobody.maps, left_over() <= before) == ([], True)


def test_whoever_stands_up_sends_no_further(seated: Page, nobody: Nobody) -> None:
    """The word of a seat is of no use to anybody later."""
    before = left_over()
    with socket.create_connection(seated.address.split(":"), timeout=10.0) as sending:  # type: ignore[arg-type]
        head = f"POST /map?name=town HTTP/1.1\r\nHost: {seated.address}\r\nOrigin: http://{seated.address}\r\n"
        sending.sendall(f"{head}Smal-Seat: {seated.word}\r\nContent-Length: 20\r\n\r\nfirst half".encode())
        eventually(lambda: left_over() - before)
        seated.say(do="leave")
        eventually(lambda: not seated.state.get("taken"))
        sending.sendall(b"other half")
        assert b" 403 " in sending.recv(100)
    assert seated.post("/map?name=town", b"<osm/>")[0] == 403
    assert nobody.maps == []
    eventually(lambda: left_over() <= before)


def head(page: Page, name: str, *lines: str) -> bytes:
    """Give how a map is begun to be sent."""
    own = f"POST /map?name={name} HTTP/1.1", f"Host: {page.address}", f"Origin: http://{page.address}"
    return "\r\n".join((*own, *lines, "", "")).encode()


def connected(page: Page) -> socket.socket:
    host, port = page.address.split(":")
    return socket.create_connection((host, int(port)), timeout=10.0)


def test_a_stranger_who_begins_to_send_leaves_nothing(seated: Page) -> None:
    before = left_over()
    with connected(seated) as sending:
        sending.sendall(head(seated, "town", "Content-Length: 20"))
        assert b" 403 " in sending.recv(100)
        assert left_over() <= before


@pytest.mark.parametrize("how", ["by length", "by chunks"])
def test_a_map_that_is_cut_off_is_no_map(
    seated: Page, nobody: Nobody, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    before = left_over()
    with connected(seated) as sending:
        length = "Content-Length: 20" if how == "by length" else "Transfer-Encoding: chunked"
        sending.sendall(head(seated, "town", f"Smal-Seat: {seated.word}", length) + b"5\r\nfirst\r\n")
        eventually(lambda: left_over() - before)
    eventually(lambda: left_over() <= before)
    assert nobody.maps == []
    seated.get("/")
    assert caplog.records == []


def test_of_two_maps_the_one_that_was_sent_last_is_taken(seated: Page, nobody: Nobody) -> None:
    """One that has come to a standstill is in nobody's way, and however many are sent, one is being taken."""
    before = left_over()
    with connected(seated) as sending:
        sending.sendall(head(seated, "town", f"Smal-Seat: {seated.word}", "Content-Length: 20") + b"first half")
        eventually(lambda: left_over() - before)
        assert seated.post("/map?name=town", b"<osm/>") == (202, "taken\n")
        sending.sendall(b"other half")
        assert b" 409 " in sending.recv(100)
    assert nobody.maps == [("town", b"<osm/>")]
    eventually(lambda: left_over() <= before)


def test_a_map_for_which_there_is_no_room_is_refused(
    seated: Page, nobody: Nobody, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    status, why = seated.post("/map?name=town", b"<osm/>")
    assert (status, why) == (507, "the map cannot be kept: No such file or directory\n")
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(Path, "open", lambda *_: open("/dev/full", "wb", buffering=0))  # noqa: SIM115, PTH123
    status, why = seated.post("/map?name=town", b"<osm/>")
    assert (status, why) == (507, "the map cannot be kept: No space left on device\n")
    assert nobody.maps == []


@pytest.mark.parametrize(("letters", "status"), [(50, 202), (51, 400), (64, 400)])
def test_a_name_for_which_no_file_has_room_is_refused(seated: Page, nobody: Nobody, letters: int, status: int) -> None:
    answer, said = seated.post(f"/map?name={quote('𠀀') * letters}", b"<osm/>")
    assert (answer, len(nobody.maps)) == (status, int(status == 202))
    assert status == 202 or "at most 200 bytes" in said


def test_the_map_of_a_console_that_was_killed_goes_when_nobody_uses_it_any_more() -> None:
    """Not while what makes a world of it still reads it; nor one that another console has."""
    making = "import sys, time; print('reading', flush=True); sys.stdin.read()"
    console = f"""if True:
        import subprocess, sys, time
        from services.console.folder import Folder
        folder = Folder()
        subprocess.Popen([sys.executable, "-c", {making!r}], pass_fds=(folder.lock,))
        print(folder.path, flush=True)
        time.sleep(60)
    """
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with closing(Folder()) as other, subprocess.Popen([sys.executable, "-c", console], text=True, **pipes) as killed:
        assert killed.stdout is not None
        told = {killed.stdout.readline().strip() for _ in range(2)}
        (path,) = (Path(one) for one in told - {"reading"})
        killed.kill()
        killed.wait()
        remove_left_over()
        assert path.exists(), "it is read"
        assert killed.stdin is not None
        killed.stdin.close()  # its end
        eventually(lambda: remove_left_over() or not path.exists())
        assert other.path.exists()
    assert not other.path.exists()
