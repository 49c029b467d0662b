"""Session with the robot's own router, apart from the stack's; the only module here with Zenoh."""

import json
import logging
import secrets
import time
from collections.abc import Callable
from itertools import count
from threading import Event, Lock, Thread
from typing import Any, Final

import zenoh
import zenoh.ext

from schemas.codec import printable
from services.kit.node import Detail, ServiceError
from services.kit.ros_message import LARGEST_BYTES
from services.robot.clock import now_s
from services.ros2 import messages
from services.ros2.config import Ros2Config
from services.ros2.messages import Messages
from services.ros2.senses import Senses
from services.ros2.wire import Bridge, Endpoint, Kind, Qos, RmwZenoh, gid_of, read_attachment

#: Timeout of the first connection; later reconnections are automatic.
PATIENCE_MS: Final = 5000
#: Period of the round trip measurement, seconds: it limits the error of a message's age, besides the
#: round trip.
ECHO_S: Final = 0.03
_ECHOES: Final = 1000  # Maximum echoes in flight: half a minute.
#: Sensor topics are best effort, as in `rmw_qos_profile_sensor_data`; commands are reliable. Topics
#: of changes are latched, to receive the last message from before the subscription.
_SENSOR = Qos(reliable=False, depth=5)
_COMMAND = Qos(reliable=True, depth=10)
_CHANGES = Qos(reliable=True, depth=1, latched=True)
_log = logging.getLogger("ros2")


def _settings(config: Ros2Config) -> zenoh.Config:
    settings: dict[str, object] = {
        # A client: rmw_zenohd does not route between peers.
        "mode": "client",
        "connect/endpoints": [config.router],
        "connect/timeout_ms": PATIENCE_MS,
        "connect/exit_on_failure": True,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 1.5,
        },
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": 2000,
        "transport/shared_memory/enabled": False,
        # Larger messages are dropped on arrival; otherwise one takes up to 1 GiB here.
        "transport/link/rx/max_message_size": LARGEST_BYTES,
    }
    configuration = zenoh.Config()
    for key, value in settings.items():
        configuration.insert_json5(key, json.dumps(value))
    return configuration


class Ros2Session:
    """Link to a base: receives its messages, and sends velocities.

    Raises
    ------
    ServiceError
        If its router does not answer.
    """

    def __init__(self, config: Ros2Config, senses: Senses) -> None:
        self._config = config
        self._senses = senses
        self._messages = Messages(config.distribution)
        hashed = config.distribution != "humble"
        rmw = RmwZenoh(self._messages, config.domain, config.namespace, hashed=hashed)
        self._dialect = rmw if config.dialect == "rmw_zenoh" else Bridge()
        self._topic = config.full(config.velocity.topic)
        self._lock = Lock()
        self._closed = False
        self._tokens: dict[str, Endpoint] = {}
        self._heard: dict[str, tuple[bytes, int]] = {}
        self._changes: dict[str, zenoh.ext.AdvancedSubscriber[None]] = {}
        self._types = messages.VELOCITIES[config.velocity.wheelbase_m is not None]
        self._auto = config.velocity.type == "auto"
        self._type: str | None = None if self._auto else str(config.velocity.type)
        try:
            self._session = zenoh.open(_settings(config))
            self._echo = Echo(config, self._session, senses.echoed)
        except zenoh.ZError:
            raise ServiceError(
                f"{config.name}: no Zenoh router at {config.router}; on the robot start rmw_zenohd "
                "(`ros2 run rmw_zenoh_cpp rmw_zenohd`), or zenoh-bridge-ros2dds"
            ) from None
        self._zid = str(self._session.info.zid())
        self._declared: list[Any] = []
        self._publishers: dict[str, tuple[zenoh.Publisher, bytes]] = {}
        self._sequence = count(1)
        self._number = count(1)
        self._declare(self._dialect.node_token(self._zid))
        changes = senses.changes()
        for topic, heard in senses.inputs.items():
            if topic in changes:
                self._ask(topic)
            else:
                key = self._dialect.key(topic, heard.type_name)
                self._declared.append(
                    self._session.declare_subscriber(key, _in_turn(self._listener(topic)))
                )
            self._announce("MS", topic, heard.type_name, _CHANGES if topic in changes else _SENSOR)
        self._declared.append(
            self._session.liveliness().declare_subscriber(
                self._dialect.tokens, _called(self._on_token), history=True
            )
        )

    def _declare(self, token: str | None) -> None:
        if token is not None:
            self._declared.append(self._session.liveliness().declare_token(token))

    def _announce(self, kind: Kind, topic: str, type_name: str, qos: Qos) -> str:
        endpoint = Endpoint(kind, topic, type_name, self._dialect.type_hash(type_name))
        token = self._dialect.endpoint_token(self._zid, next(self._number), endpoint, qos)
        self._declare(token)
        return token or ""

    # -- received ----------------------------------------------------------------------------------

    def _listener(self, topic: str) -> Callable[[zenoh.Sample], None]:
        def on_sample(sample: zenoh.Sample) -> None:
            if self._in_order(topic, sample):
                self._senses.take(topic, sample.payload.to_bytes())

        return _called(on_sample)

    def _ask(self, topic: str) -> None:
        """Subscribe to a topic of changes, and query its publishers for their last message.

        This repeats whenever a publisher appears or disappears, and discards earlier messages. A
        volatile publisher, which keeps no message, is received from its next change on.
        """
        self._senses.forget(topic)
        self._heard.pop(topic, None)
        key = self._dialect.key(topic, self._senses.inputs[topic].type_name)
        last = zenoh.ext.HistoryConfig(max_samples=1)
        asked = zenoh.ext.declare_advanced_subscriber(
            self._session, key, self._listener(topic), history=last
        )
        # After the new subscription, so that no change in between is lost.
        before = self._changes.get(topic)
        self._changes[topic] = asked
        if before is not None:
            before.undeclare()

    def _in_order(self, topic: str, sample: zenoh.Sample) -> bool:
        """Return whether a message is newer than its publisher's earlier ones, by its number."""
        if not self._dialect.attached:
            return True
        attached = (
            None if sample.attachment is None else read_attachment(sample.attachment.to_bytes())
        )
        if attached is None:
            self._senses.refuse(topic, "no attachment, which rmw_zenoh sends")
            return False
        gid, last = self._heard.get(topic, (b"", -1))
        # A repeated query receives the last change twice, because two subscriptions overlap.
        if attached.gid == gid and attached.sequence < last + (topic not in self._changes):
            self._senses.refuse(
                topic, f"number {attached.sequence} of its publisher came after a later one"
            )
            return False
        # The current publisher of each topic; a restarted publisher has another id.
        self._heard[topic] = attached.gid, attached.sequence
        return True

    # -- endpoints ---------------------------------------------------------------------------------

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        endpoint = self._dialect.read_token(token)
        with self._lock:
            if endpoint is None or self._closed:
                return
            changes = endpoint.kind == "MP" and endpoint.topic in self._changes
            if not (changes or (endpoint.kind == "MS" and endpoint.topic == self._topic)):
                return
            if changes:
                # First, so that messages of an earlier publisher are discarded.
                self._ask(endpoint.topic)
            if sample.kind == zenoh.SampleKind.DELETE:
                self._tokens.pop(token, None)
            else:
                self._tokens[token] = endpoint
            if not changes:
                self._choose(self._there("MS", endpoint.topic))

    def _there(self, kind: Kind, topic: str) -> list[Endpoint]:
        return [
            one for one in list(self._tokens.values()) if (one.kind, one.topic) == (kind, topic)
        ]

    def _choose(self, endpoints: list[Endpoint]) -> None:
        types = {one.type_name for one in endpoints}
        wanted = next((name for name in self._types if name in types), None)
        if wanted is None:
            if types:
                named = ", ".join(sorted(map(printable, types)))
                _log.error(
                    "%s: unsupported type %s; supported are %s and %s",
                    self._topic,
                    named,
                    *self._types,
                )
            return
        hashes = {one.type_hash for one in endpoints if one.type_name == wanted}
        own = self._dialect.type_hash(wanted)
        if own not in hashes:
            _log.error(
                "%s: the robot's %s is %s, but for %s it is %s; set distribution to the robot's",
                self._topic, wanted, printable(min(hashes)), self._config.distribution, own,
            )  # fmt: skip
        if wanted != self._type and self._auto:
            self._type = wanted
            _log.info("%s: sending %s", self._topic, wanted)
        elif wanted != self._type:
            _log.error(
                "%s has the type %s, but velocity.type is %s; the robot will not move",
                self._topic,
                wanted,
                self._type,
            )

    # -- sent --------------------------------------------------------------------------------------

    def lacks(self) -> str | None:
        """Return which endpoint the base lacks to accept velocities or to forbid them, or None."""
        if not self._session.info.routers_zid():
            return f"no connection to {self._config.router}"
        for topic in self._changes:
            if not self._there("MP", topic):
                return f"{topic} has no publisher"
        if self._type is None or (self._auto and not self._there("MS", self._topic)):
            return f"{self._topic} has no subscriber"
        return None

    def send(self, ahead_m_s: float, turn_rad_s: float, robot_s: float | None) -> None:
        """Send a velocity; if the link is full it is dropped, since the next one is newer."""
        type_name = self._type
        if type_name is None:
            return
        stamp_ns = round((robot_s or 0.0) * 1e9) if type_name.endswith("Stamped") else None
        publisher, gid = self._publisher(type_name)
        publisher.put(
            self._messages.velocity(
                ahead_m_s, turn_rad_s, stamp_ns, self._config.velocity.wheelbase_m
            ),
            attachment=self._dialect.attachment(next(self._sequence), time.time_ns(), gid),
        )

    def _publisher(self, type_name: str) -> tuple[zenoh.Publisher, bytes]:
        entry = self._publishers.get(type_name)
        if entry is None:
            publisher = self._session.declare_publisher(
                self._dialect.key(self._topic, type_name),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            token = self._announce("MP", self._topic, type_name, _COMMAND)
            entry = self._publishers[type_name] = publisher, gid_of(token)
        return entry

    def detail(self) -> Detail:
        """Return the type of the commands, and whether the router is connected."""
        return {"velocity_type": self._type, "robot_router": bool(self._session.info.routers_zid())}

    def close(self) -> None:
        """Close the session."""
        with self._lock:
            self._closed = True
        self._echo.close()
        self._session.close()


class Echo:
    """Measures the round trip to the robot's router, by echoes of a second session.

    Both dialects have this router. Echoes have the priority of images and share their queues. A
    router does not return messages to the session that sent them, hence the second session.
    """

    def __init__(
        self, config: Ros2Config, session: zenoh.Session, take: Callable[[float], None]
    ) -> None:
        self._take = take
        self._sent: dict[bytes, float] = {}
        self._ended = Event()
        self._session = zenoh.open(_settings(config))
        key = f"smal/echo/{self._session.info.zid()}"
        self._subscriber = session.declare_subscriber(key, _in_turn(_called(self._on_echo)))
        drop = zenoh.CongestionControl.DROP
        self._publisher = self._session.declare_publisher(
            key, congestion_control=drop, express=True
        )
        self._thread = Thread(target=self._send, name="echo", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the measurement."""
        self._ended.set()
        self._thread.join()
        self._session.close()

    def _send(self) -> None:
        while not self._ended.wait(ECHO_S):
            if len(self._sent) >= _ECHOES:
                self._sent.clear()
            # Random, so that only a sent word can return.
            word = secrets.token_bytes(8)
            self._sent[word] = now_s()
            self._publisher.put(word)

    def _on_echo(self, sample: zenoh.Sample) -> None:
        asked_s = self._sent.pop(sample.payload.to_bytes(), None)
        if asked_s is not None:
            self._take(asked_s)


def _in_turn(handler: Callable[[zenoh.Sample], None]) -> "zenoh.handlers.Callback[zenoh.Sample]":
    """Handle samples of all keys on the thread of the link, in the order of their arrival.

    With separate threads a later echo overtakes a waiting image.
    """
    return zenoh.handlers.Callback(handler, indirect=False)


def _called(handler: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Sample], None]:
    """Log errors of a callback; otherwise Zenoh ends its thread's loop, or hides them."""

    def call(sample: zenoh.Sample) -> None:
        try:
            handler(sample)
        except Exception:  # noqa: BLE001 - the next sample must be handled
            _log.exception("%s", sample.key_expr)

    return call
