"""Forged, altered, oversized and too many messages are refused and counted; others pass."""

import json
import logging
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import pytest
import zenoh

from schemas import topics
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.codec import encode, encoding_of
from schemas.command import Command
from schemas.motion import TruePose
from schemas.rpc import EndRequest, Failure, Nothing
from schemas.state import State
from schemas.topics import COMMANDS, TOPICS, rpc_key
from services.kit.bus import Bus, RpcError
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from services.kit.wire import LARGEST_BYTES, MAX_RPC_BYTES, checksum
from services.kit.zenoh_session import (
    MAX_SESSIONS,
    MOST_CALLS_HZ,
    runtime,
    settings_of,
    zenohd_configuration,
)
from services.table import roles
from tests.schemas.messages import EXAMPLES
from tests.services.chain import command
from tests.services.conftest import RunNode
from tests.services.kit.conftest import status
from tests.services.secured import open_session
from tests.services.waiting import eventually, introduce, ready, send_as_stranger

ROOT = Path(__file__).parents[3]
TELEOP = topics.COMMANDS["teleop"]
KEY = TELEOP.key("rescuebot")
COMMAND = command(1)
ENCODING = encoding_of(Command)
OTHERS = "tcp/0.0.0.0:7447"  # Where Eclipse's router listens, in its container.


def bad(client: Bus, name: str, count: int) -> None:
    """Wait until this number of messages was refused on a topic, and none elsewhere."""
    eventually(lambda: status(client).bad.get(name, 0) >= count)
    assert status(client).bad == {name: count}


@contextmanager
def stranger(*endpoints: str, **settings: object) -> Iterator[zenoh.Session]:
    """Connect as any program with Zenoh can."""
    config = zenoh.Config()
    facts = {
        "mode": "client",
        "connect/endpoints": endpoints,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    for key, value in (facts | settings).items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def plain(node: Node, handled: list[Message]) -> None:
    node.subscribe(TELEOP, handled.append)


def replayed(node: Node, handled: list[Message]) -> None:
    node.subscribe(TELEOP, handled.append, replay=True)


def at_once(node: Node, handled: list[Message]) -> None:
    node.at_once(TELEOP, handled.append)


WAYS = pytest.mark.parametrize(
    "subscribe", [plain, replayed, at_once], ids=lambda way: way.__name__
)


@pytest.mark.zenoh
@WAYS
def test_forged_message_is_refused_and_names_its_sender(
    router_endpoint: str,
    node: Node,
    run_node: RunNode,
    client: Bus,
    subscribe: Callable[[Node, list[Message]], None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    handled: list[Message] = []
    subscribe(node, handled)
    run_node(node)
    introduce(client, "sample", COMMAND)
    eventually(lambda: handled)
    handled.clear()
    with stranger(router_endpoint) as session:
        # One after the other: on the way those to everybody have another priority, and replay drops what is overtaken.
        for count, key in enumerate(
            ("**", "smal/**", "smal/*/command/teleop", KEY.replace("teleop", "*")), start=1
        ):
            session.put(key, encode(COMMAND), encoding=ENCODING)
            bad(client, TELEOP.name, count)
        for count, key in enumerate((KEY, "**"), start=5):
            session.delete(key)
            bad(client, TELEOP.name, count)
        name = str(session.info.zid())
        session.put(KEY, encode(COMMAND), encoding="application/json")
        session.put(KEY, bytes(1025), encoding=ENCODING)
        bad(client, TELEOP.name, 8)
        assert handled == []
        payload = bytes(15_000_000)
        tracemalloc.start()
        try:
            while status(client).bad.get(TELEOP.name, 0) < 13:  # a busy machine may lose some
                session.put(
                    KEY,
                    payload,
                    encoding=ENCODING,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
            _, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert most < 2_000_000, (
        "bytes that Python held at one time: nothing of what is too large is copied"
    )
    assert handled == []
    client.publish(COMMAND)
    eventually(lambda: handled)
    assert f"its key is **, not {KEY}; stamped by {name}" in caplog.text


@pytest.mark.zenoh
def test_sender_cannot_choose_priority_or_congestion_control(router_endpoint: str) -> None:
    block = zenoh.CongestionControl.BLOCK
    first = zenoh.Priority.REAL_TIME
    with stranger(router_endpoint) as rude, stranger(router_endpoint) as receiver:
        for name in (*TOPICS, "anything"):
            key = f"smal/rescuebot/{name}"
            came = SimpleQueue[zenoh.Sample]()
            receiver.declare_subscriber(key, came.put)
            publisher = rude.declare_publisher(
                key, congestion_control=block, priority=first, express=True
            )
            eventually(lambda publisher=publisher: publisher.matching_status.matching)
            publisher.put(b"")
            sample = came.get(timeout=100.0)
            topic = TOPICS.get(name, topics.STATE)
            assert (sample.congestion_control == block) == topic.reliable
            assert (sample.priority == first) == (topic.lane == "stop")
            assert sample.express == (topic.lane != "ordinary")


@pytest.mark.zenoh
def test_a_forged_sign_of_life_is_refused(
    router_endpoint: str, node: Node, run_node: RunNode, client: Bus
) -> None:
    heard: list[int] = []
    node.subscribe(topics.STATE, lambda state: heard.append(state.tick), replay=True)
    run_node(node)
    client.publish(EXAMPLES[State].model_copy(update={"tick": 0}))
    eventually(lambda: heard)
    with stranger(router_endpoint) as session:
        for count, name in enumerate(("x", "**", "*/1", "0f/1x"), start=1):
            token = session.liveliness().declare_token(
                f"{topics.STATE.key('rescuebot')}/@adv/pub/{name}"
            )
            bad(client, "state", count)
            client.publish(EXAMPLES[State].model_copy(update={"tick": count}))
            eventually(lambda count=count: heard[-1] == count)
            assert heard == list(range(count + 1)), "nothing is replayed twice"
            token.undeclare()


def taken_until(send: Callable[[], object], size: int, sizes: SimpleQueue[int]) -> set[int]:
    """Send until something of a size arrives, for a busy machine may lose some; return all sizes that arrived."""
    taken: set[int] = set()
    deadline_s = time.monotonic() + 100.0
    while size not in taken:
        assert time.monotonic() < deadline_s
        send()
        with suppress(Empty):
            while size not in taken:
                taken.add(sizes.get(timeout=1.0))
    return taken


@pytest.mark.zenoh
def test_message_is_dropped_when_it_exceeds_every_topic(router_endpoint: str, client: Bus) -> None:
    camera = topics.JPEG.key("rescuebot")
    sizes = SimpleQueue[int]()
    with stranger(router_endpoint) as sender, stranger(router_endpoint) as witness:
        _held = witness.declare_subscriber(camera, lambda sample: sizes.put(len(sample.payload)))

        def send(size: int) -> None:
            sender.put(camera, bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)

        taken_until(lambda: send(1), 1, sizes)
        image = EXAMPLES[CompressedImage].model_copy(update={"data": bytes(LARGEST_BYTES - 1024)})
        for size in (2 * LARGEST_BYTES, 1 << 28):
            send(size)
            assert taken_until(lambda: send(2), 2, sizes) <= {1, 2}
        assert taken_until(lambda: send(LARGEST_BYTES), LARGEST_BYTES, sizes) <= {2, LARGEST_BYTES}
        taken_until(lambda: client.publish(image), len(encode(image)), sizes)
        assert sender.info.routers_zid()


@pytest.mark.zenoh
def test_a_client_of_a_router_without_bounds_has_its_own(free_endpoint: str) -> None:
    router = stranger(mode="router", **{"listen/endpoints": [free_endpoint]})
    with router, stranger(free_endpoint) as sender:
        bus = Bus("rescuebot", free_endpoint)
        sizes = SimpleQueue[int]()
        try:
            bus.listen("smal/**", lambda _key, payload, _encoding: sizes.put(len(payload)))
            taken_until(lambda: sender.put(KEY, b"1"), 1, sizes)
            sender.put(
                KEY, bytes(2 * LARGEST_BYTES), congestion_control=zenoh.CongestionControl.BLOCK
            )
            assert taken_until(lambda: sender.put(KEY, b"12"), 2, sizes) <= {1, 2}
        finally:
            bus.close()


def test_the_other_router_is_told_the_same() -> None:
    comment, configured = (ROOT / "deploy" / "zenohd.json5").read_text().split("{", 1)
    assert all(line.startswith("//") for line in comment.splitlines())
    rows = (
        f"  {json.dumps(key)}: {json.dumps(value)}"
        for key, value in zenohd_configuration(OTHERS, [], None).items()
    )
    assert "{" + configured == "{\n" + ",\n".join(rows) + "\n}\n", (
        "what differs is to be written there"
    )
    assert f"ZENOH_RUNTIME: {runtime(MAX_SESSIONS)!r}" in (ROOT / "docker-compose.yml").read_text()


def test_waiting_messages_of_a_node_are_bounded(settings: ServiceSettings) -> None:
    topic = topics.JPEG
    sender = Bus("rescuebot", settings.router)
    with Node("sample", settings) as node:
        node.subscribe(topic, lambda _: None, depth=2 * topic.kept)
        node.subscribe(TELEOP, lambda _: None)
        eventually(lambda: (sender.publish(COMMAND), node.waits(TELEOP))[1])
        payload = bytes(CompressedImage.max_bytes)

        def send() -> int:
            send_as_stranger(sender, topic, payload, encoding_of(topic.message))
            return node.status().dropped.get(topic.name, 0)

        eventually(lambda: send() > 0)
        assert node.status().waiting[topic.name] == 256 // 16 - 1, "256 MiB, less a command"
        assert node.waits(TELEOP), "what others send is not lost"
    sender.close()


def test_a_reply_that_is_too_large_is_an_error(client: Bus, node: Node, run_node: RunNode) -> None:
    def error(request: EndRequest) -> Failure:
        if request.episode == "fails":
            raise ServiceError("x" * 2_000_000)
        return Failure(error="x" * 2_000_000)

    node.serve("end", EndRequest, error)
    run_node(node)
    ready(client, "sample")
    for episode in ("fails", "e"):
        with pytest.raises(
            RpcError,
            match=r"^sample end: invalid reply: too large \(2000012 bytes > maximum 1000000\)$",
        ):
            client.call("sample", "end", EndRequest(episode=episode), Failure)


@pytest.mark.zenoh
def test_call_to_a_wildcard_is_refused(
    router_endpoint: str, node: Node, run_node: RunNode, client: Bus
) -> None:
    stopped: list[Nothing] = []
    node.serve("stop", Nothing, stopped.append)
    run_node(node)
    ready(client, "sample")
    with stranger(router_endpoint) as session:
        for count, key in enumerate(
            ("**", "smal/**", "smal/*/rpc/*/stop", "smal/rescuebot/rpc/**"), start=1
        ):
            replies = list(session.get(key, timeout=100.0))
            assert replies
            assert all(
                reply.err is not None and b"its key is" in reply.err.payload.to_bytes()
                for reply in replies
            )
            eventually(lambda count=count: status(client).bad.get("rpc/stop") == count)
    assert stopped == []


@pytest.mark.zenoh
def test_a_flood_of_calls_takes_a_tenth_of_a_processor(router_endpoint: str, client: Bus) -> None:
    answered = 0

    def answer(_request: bytes, reply: Callable[[EndRequest], None]) -> None:
        nonlocal answered
        began_s = time.thread_time()
        while time.thread_time() - began_s < 0.005:
            pass
        answered += 1
        reply(EndRequest(episode="e"))

    service = Bus("rescuebot", router_endpoint)
    service.serve("sim", "end", answer)
    eventually(lambda: _called(client, "sim"))
    with stranger(router_endpoint) as session:
        before = answered
        began_s = time.monotonic()
        ended = SimpleQueue[None]()
        handler = zenoh.handlers.Callback(
            lambda _reply: None, lambda: ended.put(None), indirect=False
        )
        for _ in range(5000):
            session.get(rpc_key("rescuebot", "sim", "end"), handler, timeout=100.0)
        for _ in range(5000):
            ended.get(timeout=100.0)
        elapsed_s = time.monotonic() - began_s
    assert 0 < answered - before <= 0.1 * elapsed_s / 0.005 + 1
    assert _called(client, "sim") == "e"
    service.close()


@pytest.mark.zenoh
def test_call_is_dropped_when_it_is_too_large(router_endpoint: str, client: Bus) -> None:
    asked: list[int] = []
    service = Bus("rescuebot", router_endpoint)
    service.serve(
        "sim",
        "end",
        lambda _request, reply: reply(EndRequest(episode="e")),
        lambda why: asked.append(len(why)),
    )
    eventually(lambda: _called(client, "sim"))
    with stranger(router_endpoint) as session:
        key = rpc_key("rescuebot", "sim", "end")
        assert [
            reply.err for reply in session.get(key, payload=bytes(MAX_RPC_BYTES + 1), timeout=100.0)
        ] != []
        assert len(asked) == 1
        assert list(session.get(key, payload=bytes(3 * MAX_RPC_BYTES), timeout=100.0)) == []
    assert len(asked) == 1
    service.close()


@pytest.mark.zenoh
@pytest.mark.parametrize("way", ["key", "delete", "many"])
def test_forged_replies(router_endpoint: str, client: Bus, way: str) -> None:
    key = rpc_key("rescuebot", "sim", "end")
    sent = threading.Event()

    def on_query(query: zenoh.Query) -> None:
        with query:
            if way == "key":
                query.reply("smal/rescuebot/rpc/*/end", b"{}")
            elif way == "delete":
                query.reply_del(key)
            for _ in range(1000 if way == "many" else 0):
                query.reply(key, b'{"episode":"first"}' + b" " * 900_000)
        sent.set()

    with stranger(router_endpoint) as session:
        _held = session.declare_queryable(key, on_query, complete=True)
        other = Bus("rescuebot", router_endpoint)
        other.serve("other", "end", lambda _request, reply: reply(EndRequest(episode="e")))
        eventually(lambda: _called(client, "other") == "e")
        tracemalloc.start()
        try:
            told = eventually(lambda: _called(client, "sim"))
            _, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert _called(client, "other") == "e"
        assert sent.wait(100.0)
        other.close()
    expected = {
        "key": "invalid reply: its key is smal",
        "delete": "invalid reply: it deletes",
        "many": "first",
    }
    assert expected[way] in told
    assert most < 5_000_000


def _called(bus: Bus, service: str) -> str:
    """Return the answer or the error; an empty text while the service is missing."""
    try:
        return bus.call(service, "end", Nothing(), EndRequest, timeout_s=100.0).episode
    except RpcError as error:
        return "" if "is the service running" in str(error) else str(error)


def test_repeated_failures_do_not_fill_the_log(
    node: Node, run_node: RunNode, client: Bus, caplog: pytest.LogCaptureFixture
) -> None:

    def refuse(_: Nothing) -> None:
        raise ServiceError("not now")

    def fail(_: object) -> None:
        raise ZeroDivisionError("a bug")

    node.serve("refuse", Nothing, refuse)
    node.serve("fail", Nothing, fail)
    node.subscribe(topics.STATE, fail)
    node.at_once(TELEOP, fail)
    run_node(node)
    introduce(client, "sample", COMMAND, EXAMPLES[State])
    before = status(client).failed
    began_s = time.monotonic()
    for _ in range(20):
        for verb in ("refuse", "fail"):
            with pytest.raises(RpcError):
                client.call("sample", verb, Nothing(), Nothing)
        client.publish(COMMAND)
        client.publish(EXAMPLES[State])
    eventually(lambda: status(client).failed == before + 60)
    lines = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    for text in (
        "refuse refused: not now",
        "handling rpc/fail",
        "handling state",
        "handling command/teleop",
    ):
        assert (
            1 <= len([line for line in lines if text in line]) <= 3 + time.monotonic() - began_s
        ), "one a second"
    assert "ZeroDivisionError" in caplog.text


def test_a_message_that_was_changed_on_its_way_is_refused(
    client: Bus, router_endpoint: str
) -> None:
    pose = EXAMPLES[TruePose]
    heard = SimpleQueue[bytes]()
    refused = SimpleQueue[str]()
    payload = encode(pose)
    changed = payload.replace(b"x_m", b"y_m")
    assert changed != payload
    with closing(Bus("rescuebot", router_endpoint)) as other:
        other.subscribe(topics.POSE, lambda payload, *_: heard.put(payload), refused.put)
        sender = client.declare_publisher(topics.POSE)

        def told() -> bool:
            sender.put(changed, attachment=checksum(payload))
            return not refused.empty()

        eventually(told)
        assert "changed" in refused.get()
        sender.put(payload)  # of a sender that says nothing of it
        client.publish(pose)
        assert [heard.get(timeout=100.0) for _ in range(2)] == [payload] * 2


STOP = COMMANDS["emergency_stop"].key("rescuebot")
STATUS = rpc_key("rescuebot", "robot", "status")
FLOOD = 40_000  # More than a router lets through in the time that it takes to ask them.


def test_each_call_of_a_role_is_bounded() -> None:
    items: Any = settings_of("router", "tcp/127.0.0.1:1", None)["downsampling"]
    (item,) = items
    assert item["messages"] == ["query"]
    calls = {rpc_key("*", *name.split("/", 1)) for role in roles().values() for name in role.calls}
    assert calls <= {rule["key_expr"] for rule in item["rules"]}


def test_flood_of_calls_is_dropped_while_stops_pass(
    router_endpoint: str,
) -> None:
    asked = [0]
    stops = [0]

    def answer(query: zenoh.Query) -> None:
        with query:
            asked[0] += 1
            query.reply(STATUS, b"{}")

    def note(_sample: zenoh.Sample) -> None:
        stops[0] += 1

    with (
        closing(open_session(router_endpoint, None)) as robot,
        closing(open_session(router_endpoint, None)) as flooder,
        closing(open_session(router_endpoint, None)) as other,
    ):
        served = robot.declare_queryable(STATUS, zenoh.handlers.Callback(answer, indirect=False))
        heard = robot.declare_subscriber(STOP, zenoh.handlers.Callback(note, indirect=False))
        eventually(lambda: list(other.get(STATUS, timeout=100.0)))
        eventually(lambda: (other.put(STOP, b"first"), stops[0])[1])
        # Messages of one session arrive in order, so that all earlier messages are here.
        list(other.get(STATUS, timeout=100.0))
        before = stops[0]
        since_s = time.monotonic()
        for number in range(FLOOD):
            flooder.get(STATUS, zenoh.handlers.RingChannel(1), timeout=100.0)
            if number % (FLOOD // 10) == 0:
                flooder.put(STOP, b"of the flooder")
                other.put(STOP, b"of another one")
                assert list(other.get(STATUS, timeout=100.0)), "who asks one by one is answered"
        asked_s = time.monotonic() - since_s
        eventually(lambda: stops[0] == before + 20)
        served.undeclare()
        heard.undeclare()
    assert 0 < asked[0] <= MOST_CALLS_HZ * (asked_s + 1.0) + 100
