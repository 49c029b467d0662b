"""Guarantees of the bus: delivery and order, calls, outages, addresses."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from queue import SimpleQueue

import pytest

from schemas import topics
from schemas.base import Message, Strict
from schemas.camera import DepthImage
from schemas.codec import decode, encode, encoding_of
from schemas.command import Command
from schemas.motion import TruePose
from schemas.observation import Observation
from schemas.rpc import EndRequest, Failure, Nothing
from schemas.state import State
from services.kit.bus import HEARTBEAT_S, Bus, BusError, Router, RpcError
from tests.schemas.messages import EXAMPLES
from tests.services.chain import command
from tests.services.waiting import eventually

Sample = tuple[bytes, str]


@pytest.fixture
def other(router_endpoint: str) -> Iterator[Bus]:
    bus = Bus("rescuebot", router_endpoint)
    yield bus
    bus.close()


def heard(bus: Bus, topic: topics.Topic) -> SimpleQueue[Sample]:
    samples: SimpleQueue[Sample] = SimpleQueue()
    bus.subscribe(topic, lambda payload, encoding, _transit_s: samples.put((payload, encoding)))
    return samples


def publish_until(sender: Bus, message: Message, arrived: Callable[[], bool]) -> None:
    """Send again until it arrives: a subscription takes a moment to become known."""

    def sent() -> bool:
        sender.publish(message)
        return arrived()

    eventually(sent)


def test_each_message_arrives_as_it_was_sent(client: Bus, other: Bus) -> None:
    for cls, message in EXAMPLES.items():
        samples = heard(other, topics.TOPICS[message.topic_name])
        publish_until(client, message, lambda samples=samples: not samples.empty())
        payload, encoding = samples.get(timeout=100.0)
        assert (payload, encoding) == (encode(message), encoding_of(cls))
        assert decode(cls, payload, encoding) == message


def test_topics_that_are_equally_urgent_keep_their_order(client: Bus, other: Bus) -> None:
    ticks: list[int] = []
    chain = (State, TruePose, Observation)
    for cls in chain:
        other.subscribe(
            topics.TOPICS[EXAMPLES[cls].topic_name],
            lambda *sample, cls=cls: ticks.append(decode(cls, *sample[:2]).tick),
        )
    for cls in chain:
        publish_until(client, EXAMPLES[cls].model_copy(update={"tick": 0}), lambda: bool(ticks))
        ticks.clear()
    for tick in range(1, 100):
        client.publish(EXAMPLES[chain[tick % 3]].model_copy(update={"tick": tick}))
    eventually(lambda: ticks and ticks[-1] == 99)
    assert [tick for tick in ticks if tick] == list(range(1, 100))


def test_handler_delays_only_its_own_lane(client: Bus, other: Bus) -> None:
    begun = threading.Event()
    release = threading.Event()
    handled = list[int]()
    urgent = threading.Event()
    threads: set[int] = set()

    def work(payload: bytes, encoding: str, _transit_s: float | None) -> None:
        threads.add(threading.get_ident())
        begun.set()
        release.wait()
        handled.append(decode(State, payload, encoding).tick)

    other.subscribe(topics.STATE, work)
    other.subscribe(topics.COMMANDS["teleop"], lambda *_: urgent.set())
    try:
        publish_until(client, EXAMPLES[State].model_copy(update={"tick": 0}), begun.is_set)
        for tick in range(1, 6):
            client.publish(EXAMPLES[State].model_copy(update={"tick": tick}))
        publish_until(client, command(1), urgent.is_set)
        assert not handled, "what is urgent has a thread of its own"
    finally:
        release.set()
    eventually(lambda: 5 in handled)
    assert [tick for tick in handled if tick] == [1, 2, 3, 4, 5]
    assert len(threads) == len(threads - {threading.get_ident()}) == 1


def test_closed_bus_neither_receives_nor_answers(
    client: Bus, other: Bus, router_endpoint: str
) -> None:
    leaving = Bus("rescuebot", router_endpoint)
    before = heard(leaving, topics.STATE)
    stayed = heard(other, topics.STATE)
    leaving.serve("sim", "end", lambda _request, reply: reply(EndRequest(episode="here")))
    publish_until(client, EXAMPLES[State], lambda: not before.empty() and not stayed.empty())
    assert call_when_served(client, "sim", "end", Nothing()) == EndRequest(episode="here")
    leaving.close()
    count = before.qsize()
    after = stayed.qsize()
    client.publish(EXAMPLES[State])
    eventually(lambda: stayed.qsize() > after)
    assert before.qsize() == count
    with pytest.raises(RpcError, match="is the service running"):
        client.call("sim", "end", Nothing(), EndRequest)


def test_another_robots_messages_are_not_heard(
    router_endpoint: str, client: Bus, other: Bus
) -> None:
    stranger = Bus("stranger", router_endpoint)
    try:
        samples = heard(other, topics.COMMANDS["teleop"])
        of_all = SimpleQueue[str]()
        other.listen("smal/*/command/teleop", lambda key, _payload, _encoding: of_all.put(key))
        stranger.publish(command(1))
        publish_until(client, command(2), lambda: not samples.empty())
        payload, encoding = samples.get(timeout=100.0)
        assert decode(Command, payload, encoding).tick == 2
        publish_until(
            stranger,
            command(1),
            lambda: any(of_all.get().startswith("smal/stranger/") for _ in range(of_all.qsize())),
        )
        while not samples.empty():
            payload, encoding = samples.get()
            assert decode(Command, payload, encoding).tick == 2
    finally:
        stranger.close()


def call_when_served(
    bus: Bus, service: str, verb: str, request: Strict, timeout_s: float = 100.0
) -> Strict:
    def answered() -> Strict | None:
        try:
            return bus.call(service, verb, request, EndRequest, timeout_s)
        except RpcError as error:
            if "is the service running" in str(error):
                return None
            raise

    return eventually(answered)


def test_call_names_the_reason_when_it_fails(client: Bus, other: Bus, router_endpoint: str) -> None:
    kept: list[Callable[[Strict], None]] = []
    other.serve("sim", "refused", lambda _request, reply: reply(Failure(error="no such episode")))
    other.serve("sim", "malformed", lambda _request, reply: reply(Nothing()))
    other.serve("sim", "late", lambda _request, reply: kept.append(reply))
    for verb, error in (
        ("refused", "^sim refused: no such episode$"),
        ("malformed", "^sim malformed: invalid reply: episode: Field required$"),
        ("late", "^sim late: "),
    ):
        with pytest.raises(RpcError, match=error):
            call_when_served(
                client, "sim", verb, Nothing(), timeout_s=0.5 if verb == "late" else 100.0
            )
    assert kept
    with pytest.raises(
        RpcError, match=rf"^nobody end: no answer; is the service running.*{router_endpoint}"
    ):
        client.call("nobody", "end", Nothing(), Nothing)


def test_a_request_that_is_dropped_is_told_at_once(client: Bus, other: Bus) -> None:
    asked = threading.Event()

    def drop(_request: bytes, _reply: Callable[[Strict], None]) -> None:
        asked.set()

    def fail(_request: bytes, _reply: Callable[[Strict], None]) -> None:
        raise ZeroDivisionError("a bug")

    other.serve("sim", "drop", drop)
    other.serve("sim", "fail", fail)
    other.serve("sim", "end", lambda _request, reply: reply(EndRequest(episode="e")))
    call_when_served(client, "sim", "end", Nothing())
    for verb in ("drop", "fail"):
        began_s = time.monotonic()
        with pytest.raises(RpcError, match=rf"^sim {verb}: no answer; is the service running"):
            client.call("sim", verb, Nothing(), Nothing, timeout_s=200.0)
        assert time.monotonic() - began_s < 100.0
    assert asked.is_set()


def test_call_fails_at_once_when_its_service_leaves(client: Bus, router_endpoint: str) -> None:
    leaving = Bus("rescuebot", router_endpoint)
    asked = list[Callable[[Strict], None]]()
    leaving.serve("sim", "end", lambda _request, reply: reply(EndRequest(episode="e")))
    leaving.serve("sim", "wait", lambda _request, reply: asked.append(reply))
    call_when_served(client, "sim", "end", Nothing())
    closing = threading.Thread(target=lambda: (eventually(lambda: asked), leaving.close()))
    closing.start()
    began_s = time.monotonic()
    with pytest.raises(RpcError, match=r"^sim wait: no answer; is the service running"):
        client.call("sim", "wait", Nothing(), Nothing, timeout_s=200.0)
    assert time.monotonic() - began_s < 100.0
    closing.join()


def test_messages_flow_again_after_the_router_was_away(free_endpoint: str) -> None:
    router = Router(free_endpoint)
    sender = Bus("rescuebot", free_endpoint)
    receiver = Bus("rescuebot", free_endpoint)
    try:
        samples = heard(receiver, topics.COMMANDS["teleop"])
        receiver.serve(
            "sim", "end", lambda request, reply: reply(EndRequest.model_validate_json(request))
        )
        publish_until(sender, command(1), lambda: not samples.empty())
        eventually(lambda: sender.has_listeners(topics.COMMANDS["teleop"]))
        router.close()
        eventually(lambda: not sender.connected() and not receiver.connected())
        eventually(lambda: not sender.has_listeners(topics.COMMANDS["teleop"]))
        sender.publish(command(2))
        router = Router(free_endpoint)
        sender.wait_connected(100.0)
        receiver.wait_connected(100.0)

        def arrived() -> bool:
            ticks = {decode(Command, *samples.get()).tick for _ in range(samples.qsize())}
            assert 2 not in ticks, (
                "a command given during an outage must not move the robot after it"
            )
            return 3 in ticks

        publish_until(sender, command(3), arrived)
        assert sender.has_listeners(topics.COMMANDS["teleop"])
        assert call_when_served(sender, "sim", "end", EndRequest(episode="e")) == EndRequest(
            episode="e"
        )
    finally:
        sender.close()
        receiver.close()
        router.close()


def replayed(bus: Bus, topic: topics.Topic) -> Callable[[], list[int]]:
    """Subscribe with replay; return a function that gives the ticks received."""
    ticks: list[int] = []
    bus.subscribe(
        topic,
        lambda *sample: ticks.append(decode(topic.message, *sample[:2]).tick),
        replay=True,
    )
    return lambda: ticks


@pytest.mark.parametrize(
    ("topic", "kept_s", "away_s"),
    [
        (topics.STATE, topics.KEPT_S, 3 * HEARTBEAT_S),
        (topics.COMMANDS["teleop"], 0.05, 3 * HEARTBEAT_S),
    ],
    ids=["short", "longer than is asked for"],
)
def test_recorded_topic_is_whole_after_an_outage(
    free_endpoint: str,
    topic: topics.Topic,
    kept_s: float,
    away_s: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("services.kit.bus.KEPT_S", kept_s)
    router = Router(free_endpoint)
    sender = Bus("rescuebot", free_endpoint)
    receiver = Bus("rescuebot", free_endpoint)

    def send(tick: int) -> None:
        sender.publish(EXAMPLES[topic.message].model_copy(update={"tick": tick}))

    try:
        ticks = replayed(receiver, topic)
        send(0)
        eventually(lambda: ticks() == [0])
        router.close()
        eventually(lambda: not sender.connected() and not receiver.connected())
        for tick in range(1, 101):
            send(tick)
        time.sleep(away_s)
        router = Router(free_endpoint)
        eventually(lambda: len(ticks()) > 100)
        assert ticks() == list(range(101))
        send(101)
        eventually(lambda: ticks()[-1] == 101)
    finally:
        sender.close()
        receiver.close()
        router.close()


def test_replay_is_whole_when_live_samples_arrive_meanwhile(
    client: Bus, router_endpoint: str
) -> None:
    before = 100
    after = 150
    late = [Bus("rescuebot", router_endpoint) for _ in range(6)]

    def send(ticks: range, pace_s: float = 0.0) -> None:
        for tick in ticks:
            client.publish(EXAMPLES[State].model_copy(update={"tick": tick}))
            threading.Event().wait(pace_s)

    send(range(before))
    sender = threading.Thread(target=send, args=(range(before, before + after), 0.002))
    sender.start()
    try:
        heard_by = [replayed(bus, topics.STATE) for bus in late]
        sender.join()
        for ticks in heard_by:
            eventually(lambda ticks=ticks: len(ticks()) >= before + after)
            assert ticks() == list(range(before + after))
    finally:
        sender.join()
        for bus in late:
            bus.close()


def test_bus_knows_its_listeners(client: Bus, router_endpoint: str) -> None:
    assert not client.has_listeners(topics.DEPTH)
    one = Bus("rescuebot", router_endpoint)
    all_of_it = Bus("rescuebot", router_endpoint)
    samples = heard(one, topics.DEPTH)
    eventually(lambda: client.has_listeners(topics.DEPTH))
    assert not client.has_listeners(topics.OVERHEAD)
    client.publish(EXAMPLES[DepthImage])
    assert decode(DepthImage, *samples.get(timeout=100.0)) == EXAMPLES[DepthImage], (
        "a known listener hears at once"
    )
    all_of_it.listen("smal/**", lambda *_: None)
    eventually(lambda: client.has_listeners(topics.OVERHEAD))
    all_of_it.close()
    eventually(lambda: not client.has_listeners(topics.OVERHEAD))
    assert client.has_listeners(topics.DEPTH)
    one.close()
    eventually(lambda: not client.has_listeners(topics.DEPTH))


def test_no_router(free_endpoint: str) -> None:
    with pytest.raises(
        BusError, match=rf"^no router at {free_endpoint}; start the stack with `smal up`$"
    ):
        Bus("rescuebot", free_endpoint, patience_s=0.1)


@pytest.mark.zenoh
def test_a_port_where_something_else_listens() -> None:
    with socket.socket() as stranger:
        stranger.bind(("127.0.0.1", 0))
        stranger.listen()
        with pytest.raises(BusError, match=r" is not a router, requires a certificate"):
            Bus("rescuebot", f"tcp/127.0.0.1:{stranger.getsockname()[1]}", patience_s=0.1)


def test_a_client_waits_for_a_router_that_is_starting(free_endpoint: str) -> None:
    routers: list[Router] = []
    starting = threading.Timer(0.3, lambda: routers.append(Router(free_endpoint)))
    starting.start()
    try:
        bus = Bus("rescuebot", free_endpoint, patience_s=100.0)
        bus.wait_connected(100.0)
        bus.close()
    finally:
        starting.join()
        routers[0].close()


@pytest.mark.zenoh
def test_a_busy_port(router_endpoint: str) -> None:
    with pytest.raises(
        BusError,
        match=rf"^cannot listen on {router_endpoint}: the port is in use; stop its user",
    ):
        Router(router_endpoint)


@pytest.mark.parametrize(
    "cls", [Router, lambda endpoint: Bus("rescuebot", endpoint)], ids=["router", "client"]
)
@pytest.mark.parametrize(
    "endpoint",
    ["", "nonsense", "tcp/host", "tcp/host:port", "tcp/127.0.0.1:99999", "foo/127.0.0.1:7447", "127.0.0.1:7447",
     "tcp/user:hunter2@127.0.0.1:7447", "http://user:hunter2@host:80/x"],
)  # fmt: skip
def test_a_malformed_address(cls: Callable[[str], object], endpoint: str) -> None:
    with pytest.raises(BusError, match="expected tcp/<host>:<port>") as refused:
        cls(endpoint)
    assert "\n" not in str(refused.value)
    assert "hunter2" not in str(refused.value), "a log must not show a password"


def test_a_host_that_does_not_exist(free_endpoint: str) -> None:
    address = f"tcp/no-such-host.invalid:{free_endpoint.rpartition(':')[2]}"
    with pytest.raises(BusError, match=r"^cannot listen on tcp/no-such-host.invalid"):
        Router(address)
    with pytest.raises(BusError, match=r"^no router at tcp/no-such-host.invalid"):
        Bus("rescuebot", address, patience_s=0.1)


def test_sender_keeps_only_the_newest_samples(client: Bus, other: Bus) -> None:
    kept = topics.COMMANDS["teleop"].kept
    for tick in range(kept + 10):
        client.publish(command(tick))
    ticks = replayed(other, topics.COMMANDS["teleop"])
    eventually(lambda: len(ticks()) >= kept)
    assert ticks() == list(range(10, kept + 10))


def test_key_expressions(client: Bus, other: Bus) -> None:
    wanted = {"smal/**", "**", "smal/rescuebot/**/state", "smal/*/*"}
    found: set[tuple[str, str]] = set()
    for keys in (*wanted, "smal/*", "*/rescuebot/camera/jpeg"):
        other.listen(keys, lambda key, _payload, _encoding, keys=keys: found.add((keys, key)))
    control = heard(other, topics.STATE)
    for _ in range(2):  # the control is declared later: once it has heard, the listeners are known
        publish_until(client, EXAMPLES[State], lambda: not control.empty())
        control.get()
    assert found == {(keys, topics.STATE.key("rescuebot")) for keys in wanted}
    for keys in ("smal//state", "/smal", "smal/**/", "", "smal/a#b", "smal/a*", "**/*", "a/**/**"):
        with pytest.raises(BusError, match=r"(?i)key"):
            client.listen(keys, lambda _key, _payload, _encoding: None)
