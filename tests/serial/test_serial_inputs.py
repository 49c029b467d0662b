"""The camera and the odometry of a base without ROS."""

import errno
import json
import os
import pty
import socket
import struct
import termios
import time
from collections.abc import Callable
from contextlib import closing, suppress
from itertools import chain, repeat
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest

from schemas.base import Velocity
from schemas.rpc import ResetRequest
from services.kit.node import ServiceError
from services.robot.clock import SILENCE_S, now_s
from services.robot.gate import MAX_AGE_S
from services.serial.body import STARTS_S, SerialBody
from services.serial.camera import Arrivals, Picture, VideoSource
from services.serial.config import CameraConfig, SerialConfig, read_config
from services.serial.link import LineLink
from services.serial.odometry import LineOdometry
from tests.command import run_smal
from tests.serial.fake_base import TICKS_PER_M, TRACK_M
from tests.serial.rig import FakeBase, Proxy, config_of
from tests.services.real_base import until

PACE_S = 1 / 15
LINK = "services.serial.link"


def arrivals_of(*gaps_s: float) -> list[float]:
    """Return how old pictures count that arrive with these gaps, after a second at the usual pace."""
    arrivals = Arrivals()
    now_s = 100.0
    for _ in range(15):
        now_s += PACE_S
        arrivals.made_s(now_s)
    ages = []
    for gap_s in gaps_s:
        now_s += gap_s
        ages.append(now_s - arrivals.made_s(now_s))
    return ages


def test_picture_is_new_when_it_comes_at_the_usual_pace() -> None:
    assert arrivals_of(PACE_S, 0.8 * PACE_S, 1.3 * PACE_S, 2 * PACE_S, 0.1 * PACE_S) == [0.0] * 5


def test_pictures_are_old_when_they_waited_for_the_link() -> None:
    ages = arrivals_of(3.0, 0.003, 0.003, 0.003, PACE_S)
    assert all(age > 2.5 for age in ages[:4])
    assert ages[4] == 0.0


def file_config(folder: Path, **camera: Any) -> SerialConfig:
    """Return a configuration whose camera is a video of two seconds."""
    video = folder / "drive.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (320, 240))
    for k in range(40):
        writer.write(np.full((240, 320, 3), 5 * k, dtype=np.uint8))
    writer.release()
    told = config_of(FakeCamera, "tcp://127.0.0.1:9", odometry=None)
    path = folder / "mine.yaml"
    path.write_text(
        json.dumps(told | {"camera": {"source": str(video), "latency_s": 0.0} | camera})
    )
    return read_config(path)


class FakeCamera:
    """A base without a camera."""

    camera = ""


def test_video_file_plays_as_a_camera_and_begins_again(tmp_path: Path) -> None:
    config = file_config(tmp_path)
    with closing(VideoSource(config.camera)) as camera:
        seen: list[tuple[float, int]] = []

        def twice() -> bool:
            picture = camera.picture
            if picture is not None:
                seen.append((picture.captured_s, int(picture.image.mean())))
            return len(seen) > 1 and seen[-1][1] < max(grey for _, grey in seen) - 50

        until(twice)
    first_s = seen[0][0]
    last_s = max(at for at, grey in seen if grey > 180)
    assert 1.0 < last_s - first_s < 5.0  # Its own speed, not that of the disk.


def test_picture_is_upright_and_of_the_wished_width(tmp_path: Path) -> None:
    config = file_config(tmp_path, width=160, rotate=90)
    with closing(VideoSource(config.camera)) as camera:
        until(lambda: camera.picture is not None)
        assert camera.picture.image.shape == (160, 120, 3)


@pytest.mark.parametrize(
    ("source", "why"),
    [
        (77, "camera 77: not found; is it plugged in?"),
        ("/dev/video77", "camera /dev/video77: not found; is it plugged in?"),
        ("http://127.0.0.1:9/", "camera http://127.0.0.1:9/: no video stream; does its address op"),
    ],
)
def test_camera_names_what_is_missing(source: int | str, why: str) -> None:
    with closing(VideoSource(CameraConfig(source=source))) as camera:
        until(lambda: "not open yet" not in (camera.lacks() or ""))
        assert (camera.lacks() or "").startswith(why)


class Still:
    """A camera whose picture the test sets."""

    def __init__(self) -> None:
        self.arrivals = Arrivals()
        self.repeats = 0
        self.changed_s = 0.0
        self.picture = Picture(np.zeros((24, 32, 3), dtype=np.uint8), 0.0)
        self.missing: str | None = None

    def lacks(self) -> str | None:
        return self.missing


class Sent:
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.missing: str | None = None

    def send(self, text: str) -> None:
        self.lines.append(text)

    def lacks(self) -> str | None:
        return self.missing


class Rig:
    """A body whose inputs and clock the test sets."""

    def __init__(self, folder: Path, **more: Any) -> None:
        path = folder / "mine.yaml"
        path.write_text(json.dumps(config_of(FakeCamera, "tcp://127.0.0.1:9", **more)))
        self.config = read_config(path)
        self.camera = Still()
        self.link = Sent()
        self.odometer = LineOdometry(self.config)
        self.now_s = 50.0
        self.body = SerialBody(
            self.config, self.camera, self.odometer, self.link, lambda: self.now_s
        )


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path, odometry=None)


def test_body_stands_when_the_picture_repeats_while_it_drives(rig: Rig) -> None:
    rig.camera.changed_s = rig.now_s
    rig.camera.repeats = 20
    assert rig.body.drive(Velocity(1.0, 0.0)) == Velocity(1.0, 0.0)  # It stood until now.
    rig.now_s += STARTS_S + SILENCE_S + 0.01
    with pytest.raises(ServiceError, match="shows the same picture while the robot drives"):
        rig.body.drive(Velocity(1.0, 0.0))
    assert rig.link.lines[-1] == "v 0.000 0.000\n"


def pulses(rig: Rig, count: int) -> None:
    """Drive in pulses of 0.2 s."""
    for _ in range(count):
        for _ in range(11):
            rig.body.drive(Velocity(1.0, 0.0))
            rig.now_s += 0.02
        rig.body.stand()
        rig.now_s += 10.0


def test_body_stands_when_the_picture_repeats_over_pulses(rig: Rig) -> None:
    rig.camera.repeats = 20
    pulses(rig, 2)
    with pytest.raises(ServiceError, match="shows the same picture while the robot drives"):
        pulses(rig, 1)
    pulses(rig, 1)  # It is armed, and starts as at first.


def test_body_drives_in_pulses_when_pictures_change(rig: Rig) -> None:
    rig.camera.repeats = 20
    for _ in range(5):
        pulses(rig, 1)
        rig.camera.changed_s = rig.now_s - 9.0


@pytest.mark.parametrize("part", ["camera", "link"])
def test_body_stands_while_an_input_is_missing(rig: Rig, part: str) -> None:
    getattr(rig, part).missing = "unplugged"
    assert rig.body.drive(Velocity(1.0, 0.0)) == Velocity(0.0, 0.0)
    assert rig.link.lines == ["v 0.000 0.000\n"]
    assert rig.body.look(1).captured_s <= rig.now_s - MAX_AGE_S
    with pytest.raises(ServiceError, match="unplugged; smal doctor --robot-config FILE checks"):
        rig.body.begin(ResetRequest(seed=1))
    getattr(rig, part).missing = None
    rig.body.begin(ResetRequest(seed=1))
    assert rig.body.drive(Velocity(1.0, 0.0)) == Velocity(1.0, 0.0)


def test_body_knows_its_camera_when_its_field_is_configured(tmp_path: Path) -> None:
    wide = Rig(tmp_path, camera={"source": 0, "field_deg": 90.0}).body.camera
    assert wide is not None
    assert wide.field_deg == pytest.approx(90.0)


LINES = [
    ("{x_m*1000} {y_m*1000} {heading_rad*57.29578}", ["5 5 90", "5 105 90", "5 205 90"]),
    (f"{{left_m*{TICKS_PER_M}}} {{right_m*{TICKS_PER_M}}}", ["7 7", "507 507", "1007 1007"]),
    ("{left_m_s} {right_m_s}", ["0 0", "1 1", "1 1"]),
    ("{linear_m_s},{angular_rad_s}", ["0,0", "1,0", "1,0"]),
]


@pytest.mark.parametrize(("template", "lines"), LINES)
def test_odometry_of_every_form_gives_the_way_ahead(
    template: str, lines: list[str], tmp_path: Path
) -> None:
    rig = Rig(tmp_path, odometry={"line": template})
    track = rig.odometer.track
    rig.odometer.take(lines[0], 10.0)
    track.begin(10.0)
    rig.odometer.take("noise", 10.05)
    rig.odometer.take(lines[1], 10.1)
    rig.odometer.take(lines[2], 10.2)
    reading = track.reading(10.2)
    assert reading is not None
    assert (reading.x_m, reading.y_m) == pytest.approx((0.2, 0.0), abs=1e-6)


def test_odometry_turns_left_when_the_right_wheel_drives(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for k in range(3):
        rig.odometer.take(f"o {-100 * k} {100 * k}", 10.0 + 0.1 * k)
        if k == 0:
            rig.odometer.track.begin(10.0)
    reading = rig.odometer.track.reading(10.2)
    assert reading is not None
    assert reading.heading_rad == pytest.approx(400 / TICKS_PER_M / TRACK_M)


def link_of(
    folder: Path, address: str, take: Callable[[str, float], None] = lambda _line, _at_s: None
) -> LineLink:
    """Return a link to an address."""
    path = folder / "mine.yaml"
    path.write_text(json.dumps(config_of(FakeCamera, address)))
    return LineLink(read_config(path), take)


def test_link_reaches_a_base_by_udp(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as base:
        base.bind(("127.0.0.1", 0))
        base.settimeout(30.0)
        lines: list[str] = []
        rig = Rig(tmp_path)
        address = f"udp://127.0.0.1:{base.getsockname()[1]}"
        link = link_of(tmp_path, address, lambda line, _at_s: lines.append(line))
        with closing(link):
            until(lambda: link.lacks() is None)
            link.send(rig.config.command(Velocity(1.0, 0.0)))
            data, sender = base.recvfrom(100)
            assert data == b"v 0.400 0.400\n"
            base.sendto(b"o 1 2\no 3 4\r\n", sender)
            until(lambda: lines == ["o 1 2", "o 3 4"])
            # A silent actuator stops the base.
            assert base.recvfrom(100)[0] == b"v 0.000 0.000\n"


def test_link_takes_whole_lines_when_much_arrives_at_once(tmp_path: Path) -> None:
    lines: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as base:
        base.bind(("127.0.0.1", 0))
        base.settimeout(30.0)
        address = f"udp://127.0.0.1:{base.getsockname()[1]}"
        with closing(link_of(tmp_path, address, lambda line, _at_s: lines.append(line))):
            sender = base.recvfrom(100)[1]
            for data in (b"o 12345678", b"90 6\n" + b"o 7 8\n" * 681, b"9" * 4000, b"9 9\no 1 2\n"):
                base.sendto(data, sender)
            until(lambda: "o 1 2" in lines)
    assert lines == ["o 1234567890 6", *["o 7 8"] * 681, "o 1 2"]


def test_link_drops_a_velocity_when_the_earlier_one_waits(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        told = config_of(FakeCamera, f"tcp://127.0.0.1:{server.getsockname()[1]}")
        told["base"]["velocity"] = "v {left_m_s:.3f} {right_m_s:.3f} " + "x" * 4000
        (tmp_path / "mine.yaml").write_text(json.dumps(told))
        config = read_config(tmp_path / "mine.yaml")
        link = LineLink(config, lambda _line, _at_s: None)
        with closing(link):
            until(lambda: link.lacks() is None)
            connection, _ = server.accept()
            with connection:

                def stuck() -> bool:
                    link.send(config.command(Velocity(1.0, 0.0)))
                    time.sleep(0.005)
                    return link.lacks() is not None

                until(stuck)
                assert "takes no data for 0.25 s" in str(link.lacks())


def test_link_ends_with_a_stop_when_earlier_lines_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = chain([0, 70, 35], repeat(0))  # Bytes that have not left a slow serial port.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as base:
        base.bind(("127.0.0.1", 0))
        base.setblocking(False)
        link = link_of(tmp_path, f"udp://127.0.0.1:{base.getsockname()[1]}")
        until(lambda: link.lacks() is None)
        monkeypatch.setattr(f"{LINK}._ON_THEIR_WAY", 1)
        monkeypatch.setattr(f"{LINK}.fcntl.ioctl", lambda *_: struct.pack("i", next(waiting)))
        link.send("v 1 1\n")
        link.close()
        lines = []
        with suppress(BlockingIOError):
            while True:
                lines.append(base.recv(100))
    assert lines[-1] == b"v 0.000 0.000\n"


def test_link_closes_when_its_thread_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    released = Event()
    hangs = Event()

    def opened(*_: object) -> None:
        hangs.set()
        released.wait()
        raise TimeoutError

    monkeypatch.setattr(f"{LINK}.opened", opened)
    monkeypatch.setattr(f"{LINK}._CONNECT_S", 0.1)
    link = link_of(tmp_path, "tcp://robot:9")
    hangs.wait()
    link.close()  # Returns.
    released.set()


def test_link_names_the_fault_when_a_port_has_no_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr("termios.tcsetattr", fails)
    master, slave = pty.openpty()
    address = os.ttyname(slave)
    os.close(slave)
    with closing(link_of(tmp_path, address)) as link:
        until(lambda: "not open yet" not in str(link.lacks()))
        assert link.lacks() == f"{address}: Input/output error"
    os.close(master)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_link_names_the_fault_when_the_address_is_no_port(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "port"
    path.touch() if kind == "file" else path.mkdir()
    with closing(link_of(tmp_path, str(path))) as link:
        until(lambda: "not open yet" not in str(link.lacks()))
        assert link.lacks() == f"{path}: not a serial port"


@pytest.mark.system
def test_doctor_checks_each_input_of_a_base(tmp_path: Path) -> None:
    base = FakeBase(tmp_path, "pty")
    path = tmp_path / "mine.yaml"
    try:
        path.write_text(json.dumps(config_of(base, base.address)))
        done = run_smal("doctor", "--robot-config", path)
        assert "ok       camera     160x120 pixels, " in done.stdout
        picture = cv2.imread(done.stdout.split("look at ")[1].split()[0])
        assert picture.shape == (120, 160, 3)
        assert f"ok       base       sent 'v 0.000 0.000\\n' to {base.address}; odo" in done.stdout
        more = {"odometry": {"line": "pose {x_m} {y_m} {heading_rad}"}, "camera": {"source": 77}}
        path.write_text(json.dumps(config_of(base, base.address, **more)))
        done = run_smal("doctor", "--robot-config", path)
        assert done.returncode == 1
        assert "problem  camera     camera 77: not found; is it plugged in?" in done.stdout
        assert "no line of the base fits odometry.line: the last line is 'o 0 0'" in done.stdout
    finally:
        base.close()


@pytest.mark.system
def test_pictures_that_waited_for_the_link_are_old(tmp_path: Path) -> None:
    base = FakeBase(tmp_path, "tcp")
    proxy = Proxy(base.camera.removesuffix("/stream"))
    proxy.latency_s = 0.02
    config = CameraConfig(source=f"http://127.0.0.1:{proxy.port}/stream", latency_s=0.02)
    try:
        with closing(VideoSource(config)) as camera:
            until(lambda: camera.lacks() is None)
            proxy.cut = True
            until(lambda: "old" in (camera.lacks() or ""))
            time.sleep(0.5)
            last = camera.picture
            back_s = now_s()
            proxy.cut = False
            until(lambda: camera.picture is not last)
            assert camera.picture.captured_s < back_s - 0.5
            until(lambda: camera.picture.captured_s > back_s)
            assert camera.lacks() is None
    finally:
        base.close()
