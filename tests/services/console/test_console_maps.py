"""Maps that a page sends: only the driver may send them, and failed uploads leave nothing behind."""

import os
import tempfile
from contextlib import suppress
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.services.console.conftest import Nobody
from tests.services.console.page import Page, connected
from tests.services.waiting import DEADLINE_S, eventually


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Have maps lie in a folder of the test's own, while somebody has them open: they have no name there."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def kept() -> int:
    """Count the maps that this process has open."""
    files = []
    for one in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # closed just now
            files.append(str(one.readlink()))
    return sum(file.startswith(f"{tempfile.gettempdir()}/#") for file in files)


def test_map_of_the_driver_is_taken_whole(seated: Page, nobody: Nobody) -> None:
    sent = os.urandom(300_000)
    assert seated.post("/map?name=My+town", sent) == (202, "taken\n")
    assert (nobody.maps, kept()) == ([("My town", sent)], 0)


def test_a_map_that_may_not_be_taken_is_not(seated: Page, nobody: Nobody) -> None:
    for path, headers, status, why in (
        ("/map?name=town", {"Smal-Seat": "guess"}, 403, "permission denied: take control"),
        ("/map?name=town", {"Origin": "http://evil.example"}, 403, "only the console's own page"),
        ("/map?name=..%2Ftown", {}, 400, "the world's name"),
        (f"/map?name={quote('𠀀') * 51}", {}, 400, "204 bytes > maximum 200"),
        ("/", {}, 405, "unsupported method"),
    ):
        answer, said = seated.post(path, b"<osm/>", **headers)
        assert (answer, why in said, said.count("\n")) == (status, True, 1), said
        assert (nobody.maps, kept()) == ([], 0)
    # Nor is one without any origin.
    connection = HTTPConnection(seated.address, timeout=DEADLINE_S)
    connection.request("POST", "/map?name=town", b"<osm/>", {"Smal-Seat": seated.word})
    assert connection.getresponse().status == 403
    assert nobody.maps == []


def test_a_map_that_is_too_large_ends_early(
    seated: Page, nobody: Nobody, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.kit.world_files.LARGEST_MAP", 1_000_000)
    monkeypatch.setattr("services.kit.world_files.LARGEST_SCAN", 2_000_000)
    too_large = 413, "map too large (maximum 1 MB); cut it smaller\n"
    assert seated.post("/map?name=town", bytes(1_000_001)) == too_large
    assert (nobody.maps, kept()) == ([], 0)
    scan = b"glTF" + bytes(1_000_001)
    assert seated.post("/map?name=house", scan) == (202, "taken\n")
    too_large = 413, "scan too large (maximum 2 MB); cut it smaller\n"
    assert seated.post("/map?name=house", scan + bytes(1_000_000)) == too_large


def head(page: Page, *lines: str) -> bytes:
    """Give how a map is begun to be sent."""
    own = "POST /map?name=town HTTP/1.1", f"Host: {page.address}", f"Origin: http://{page.address}"
    return "\r\n".join((*own, *lines, "", "")).encode()


def test_map_upload_ends_when_its_sender_leaves_the_seat(seated: Page, nobody: Nobody) -> None:
    with connected(seated) as sending:
        sending.sendall(
            head(seated, f"Smal-Seat: {seated.word}", "Content-Length: 20") + b"first half"
        )
        eventually(kept)
        seated.say(do="leave")
        eventually(lambda: not seated.state.get("taken"))
        sending.sendall(b"other half")
        assert b" 403 " in sending.recv(100)
    assert seated.post("/map?name=town", b"<osm/>")[0] == 403
    assert nobody.maps == []
    eventually(lambda: not kept())


def test_map_upload_of_a_stranger_is_refused_at_once(seated: Page) -> None:
    with connected(seated) as sending:
        sending.sendall(head(seated, "Content-Length: 20"))
        assert b" 403 " in sending.recv(100)


@pytest.mark.parametrize("length", ["Content-Length: 20", "Transfer-Encoding: chunked"])
def test_a_map_that_is_cut_off_is_no_map(
    seated: Page, nobody: Nobody, length: str, caplog: pytest.LogCaptureFixture
) -> None:
    with connected(seated) as sending:
        sending.sendall(head(seated, f"Smal-Seat: {seated.word}", length) + b"5\r\nfirst\r\n")
        eventually(kept)
    eventually(lambda: not kept())
    assert nobody.maps == []
    seated.get("/")
    assert caplog.records == []
