"""The loop that every service shares: good and bad messages, failing handlers, calls, timers, signals."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import pytest

from schemas import topics
from schemas.base import Message
from schemas.codec import encode, encoding_of
from schemas.command import Command
from schemas.motion import TruePose
from schemas.rpc import EndRequest, Nothing
from schemas.topics import Topic
from services.kit import process as service_process
from services.kit.bus import Bus, BusError, RpcError
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from tests.services.chain import command
from tests.services.conftest import RunNode
from tests.services.kit.conftest import status
from tests.services.waiting import (
    collected,
    eventually,
    introduce,
    ready,
    send_as_stranger,
    status_of,
)

ROOT = Path(__file__).parents[3]
TELEOP = topics.COMMANDS["teleop"]


def send_raw(node: Node, topic: Topic, payload: bytes, encoding: str) -> None:
    """Hand over a sample as Zenoh's thread does."""
    node._inbox.put(topic.name, (payload, encoding), len(payload))


def test_a_message_is_handled_and_its_answers_are_published(
    node: Node, run_node: RunNode, client: Bus
) -> None:
    def answer(received: Command) -> Iterator[Message]:
        yield TruePose.after(received, x_m=1.0, y_m=2.0, heading_rad=0.0)
        yield Command.after(received, source="policy", atom="right")

    poses = collected(client, topics.POSE)
    node.subscribe(TELEOP, answer)
    run_node(node)
    introduce(client, "sample", command(3))
    eventually(lambda: poses)
    assert (poses[0].tick, poses[0].x_m) == (3, 1.0)
    counts = eventually(lambda: s if (s := status(client)).published else None)
    assert counts.published == {
        "pose/truth": counts.received[TELEOP.name],
        "command/policy": counts.received[TELEOP.name],
    }


@pytest.mark.parametrize(
    ("payload", "encoding", "reason"),
    [
        (b"\xc1", encoding_of(Command), "not msgpack"),
        (b"", encoding_of(Command), "not msgpack"),
        (b"\x80", encoding_of(Command), "robot: Field required"),
        (encode(command(1)), "", "expected application/vnd.msgpack;smal.Command/1"),
        (encode(command(1, robot="stranger")), encoding_of(Command), "message of stranger/comma"),
        (encode(command(1, source="policy")), encoding_of(Command), "message of rescuebot/comma"),
    ],
    ids=["garbage", "empty", "no fields", "no encoding", "another robot", "another source"],
)
def test_a_malformed_message_is_logged_once_counted_and_dropped(
    node: Node,
    run_node: RunNode,
    client: Bus,
    caplog: pytest.LogCaptureFixture,
    payload: bytes,
    encoding: str,
    reason: str,
) -> None:
    handled: list[int] = []
    node.subscribe(TELEOP, lambda received: handled.append(received.tick))
    for _ in range(5):
        send_raw(node, TELEOP, payload, encoding)
    run_node(node)
    send_raw(node, TELEOP, encode(command(7)), encoding_of(Command))
    eventually(lambda: handled)
    assert handled == [7]
    assert status(client).bad == {TELEOP.name: 5}
    lines = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(lines) == 1, "a broken sender must not fill the log"
    assert lines[0].startswith("dropped an invalid message on command/teleop (1 in total): ")
    assert reason in lines[0]


def test_a_slow_handler_sees_the_newest_and_the_rest_is_counted(
    node: Node, run_node: RunNode, client: Bus
) -> None:
    handled: list[int] = []
    node.subscribe(TELEOP, lambda received: handled.append(received.tick), depth=3)
    for tick in range(10):
        send_raw(node, TELEOP, encode(command(tick)), encoding_of(Command))
    run_node(node)
    eventually(lambda: len(handled) == 3)
    assert handled == [7, 8, 9]
    assert status(client).dropped == {TELEOP.name: 7}


def serve_end(node: Node) -> None:
    def end(request: EndRequest) -> EndRequest | None:
        if request.episode == "gone":
            raise ServiceError("episode gone is not running")
        if request.episode == "bug":
            raise KeyError("a bug")
        return None if request.episode == "quiet" else request

    node.serve("end", EndRequest, end)


def test_calls(
    node: Node, run_node: RunNode, client: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    serve_end(node)
    run_node(node)
    ready(client, "sample")
    assert client.call("sample", "end", EndRequest(episode="e"), EndRequest) == EndRequest(
        episode="e"
    )
    assert client.call("sample", "end", EndRequest(episode="quiet"), Nothing) == Nothing()
    with pytest.raises(RpcError, match=r"^sample end: episode gone is not running$"):
        client.call("sample", "end", EndRequest(episode="gone"), Nothing)
    with pytest.raises(RpcError, match=r"^sample end: internal error; see the log of sample$"):
        client.call("sample", "end", EndRequest(episode="bug"), Nothing)
    with pytest.raises(RpcError, match=r"^sample end: episode: Field required$"):
        client.call("sample", "end", Nothing(), Nothing)
    eventually(lambda: status(client).failed == 1)
    assert "end refused: episode gone is not running" in caplog.text
    assert "KeyError: 'a bug'" in caplog.text
    assert client.call("sample", "end", EndRequest(episode="e"), EndRequest) == EndRequest(
        episode="e"
    )


def test_status_is_answered_while_a_handler_is_busy(
    node: Node, run_node: RunNode, client: Bus
) -> None:
    begun = threading.Event()
    finish = threading.Event()

    def work(_received: Command) -> None:
        begun.set()
        finish.wait()

    node.subscribe(TELEOP, work)
    node.detail = lambda: {"model": "campus"}
    run_node(node)
    send_raw(node, TELEOP, encode(command(1)), encoding_of(Command))
    assert begun.wait(100.0)
    try:
        assert status(client).detail == {"model": "campus"}
    finally:
        finish.set()


def test_timers_run_and_survive_failures(node: Node) -> None:
    calls: list[float] = []

    def tick() -> None:
        calls.append(time.monotonic())
        if len(calls) == 2:
            raise RuntimeError("a bug")

    with node:
        node.every(0.005, tick)
        assert node.spin(until=lambda: len(calls) >= 5, timeout_s=100.0)
        assert node.status().failed == 1


def test_periods_missed_while_busy_are_not_made_up(node: Node) -> None:
    calls: list[float] = []

    def busy() -> None:
        calls.append(time.monotonic())
        if len(calls) == 1:
            assert not threading.Event().wait(0.1)

    with node:
        node.every(0.02, busy)
        node.spin(until=lambda: len(calls) >= 4, timeout_s=100.0)
    assert calls[3] - calls[1] >= 0.015, "the five missed calls did not come at once"


def test_soon_runs_once_and_counts_as_no_message(node: Node) -> None:
    done: list[int] = []
    soon = node.soon(lambda: done.append(1))
    other = node.soon(lambda: done.append(2))
    for _ in range(5):
        soon()
    other()
    assert node.status().waiting == {}
    assert node.spin(lambda: 2 in done, timeout_s=100.0)
    assert done == [1, 2]
    soon()
    assert node.spin(lambda: len(done) == 3, timeout_s=100.0)
    assert node.status().dropped == {}, "nothing is lost where nothing was said"


def test_node_ends_when_its_thread_hangs(
    node: Node, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("services.kit.node._LAST_WORK_S", 0.05)
    hangs = threading.Event()
    release = threading.Event()

    def hang() -> None:
        hangs.set()
        release.wait()

    node.apart(0.001, hang)
    assert hangs.wait(100.0)
    node.close()
    release.set()
    assert caplog.messages == ["the thread 'sample, hang' did not end within 0.05 s"]


def test_a_signal_just_before_the_loop_waits_ends_it(
    node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait = node._inbox.take
    before = [
        (one, signal.getsignal(one)) for one in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    ]
    monkeypatch.setattr(
        node._inbox, "take", lambda s: (signal.raise_signal(signal.SIGTERM), wait(s))[1]
    )
    node.stop_on_signals()
    assert not node.spin()
    for handled in before:
        signal.signal(*handled)


SERVICE = """
from services.kit.settings import ServiceSettings
from services.kit.process import run_node
def serve(node, settings):
    node.log.info("serving")
    node.spin()
    node.log.info("stopped with %s", node.status().state)
run_node("sample", ServiceSettings, serve)
"""


def start(*flags: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SERVICE, *flags],
        cwd=ROOT,
        env=os.environ | environment,
        stderr=subprocess.PIPE,
        text=True,
        # Under nohup the signal is ignored, here and in every child, which is what a service respects.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # noqa: PLW1509 - one thread, one call
    )


def wait_for(log: TextIO, text: str) -> None:
    for line in log:
        if text in line:
            return
    pytest.fail(f"the log ended without {text!r}")


@pytest.mark.zenoh
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_stops_a_process_cleanly(
    router_endpoint: str, client: Bus, number: signal.Signals
) -> None:
    process = start("--router", router_endpoint)
    with process:
        wait_for(process.stderr, "serving")
        assert ready(client, "sample").pid == process.pid
        process.send_signal(number)
        rest = process.stderr.read()
        assert process.wait(100.0) == 0
    assert f"{number.name}: stopping" in rest
    assert "stopped with stopping" in rest
    assert "Traceback" not in rest
    assert status_of(client, "sample") is None


@pytest.mark.parametrize(
    ("flags", "status", "line"),
    [
        (("--robot", "Bad Robot"), 2, "sample: robot: 'Bad Robot' must match pattern"),
        (("--router", "nonsense"), 1, "invalid router address 'nonsense': expected tcp/<host>:"),
    ],
)
def test_bad_settings_are_one_line(flags: tuple[str, ...], status: int, line: str) -> None:
    process = start(*flags)
    _, error = process.communicate(timeout=100.0)
    assert process.returncode == status
    assert line in error
    assert len(error.strip().splitlines()) == 1


def test_unknown_flag_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sample", "--colour", "red"])
    with pytest.raises(SystemExit) as ended:
        service_process.run_node("sample", ServiceSettings, lambda *_: None)
    assert ended.value.code == 2
    assert "--colour" in capsys.readouterr().err


@pytest.mark.parametrize("error", [ServiceError("no such model"), BusError("no router")])
def test_a_service_that_cannot_start_says_why(
    error: Exception,
    caplog: pytest.LogCaptureFixture,
    router_endpoint: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def serve(_node: Node, _settings: ServiceSettings) -> None:
        raise error

    monkeypatch.setattr(sys, "argv", ["sample", "--router", router_endpoint])
    monkeypatch.setattr(Node, "stop_on_signals", lambda _: None)
    monkeypatch.setattr(service_process, "configure_logging", lambda _: None)
    with pytest.raises(SystemExit) as ended:
        service_process.run_node("sample", ServiceSettings, serve)
    assert ended.value.code == 1
    assert caplog.messages == [str(error)]


def test_emergency_stop_is_handled_at_once_when_the_node_is_busy(
    node: Node, run_node: RunNode, client: Bus
) -> None:
    stop = topics.COMMANDS["emergency_stop"]
    stopped = threading.Event()
    busy = threading.Event()
    release = threading.Event()

    def work(_: Nothing) -> None:
        busy.set()
        release.wait()

    node.serve("work", Nothing, work)
    node.at_once(stop, lambda _: stopped.set())
    run_node(node)
    ready(client, "sample")

    def ask() -> None:
        with suppress(RpcError):  # of too many calls the oldest are not answered
            client.call("sample", "work", Nothing(), Nothing, 100.0)

    calls = [threading.Thread(target=ask, daemon=True) for _ in range(64)]
    for call in calls:
        call.start()
    assert busy.wait(100.0)
    try:
        for _ in range(100):
            send_as_stranger(client, stop, b"\xc1", encoding_of(stop.message))
        eventually(
            lambda: (client.publish(command(0, source="emergency_stop")), stopped.is_set())[1]
        )
        eventually(
            lambda: status(client).bad[stop.name] == 100
        )  # two senders: the stop may overtake the junk
        assert status(client).busy_s > 0.0
    finally:
        release.set()
    for call in calls:
        call.join(100.0)
