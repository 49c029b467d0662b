"""The bus: messages, and calls of services, between whoever has the same router.

``Bus`` encodes and decodes; its bytes are carried by Zenoh (``zenoh_wire``). What may be counted on stands in ``wire``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from pydantic import ValidationError

from schemas.base import Message, Strict
from schemas.codec import describe, encode, printable
from schemas.rpc import Failure
from schemas.topics import TOPICS, Lane, Topic, rpc_key
from services.kit.credentials import Credentials
from services.kit.wire import Answer, BusError, Refused, Take
from services.kit.zenoh_settings import DEFAULT_ROUTER, check_credentials, host_and_port, zenohd_configuration
from services.kit.zenoh_wire import PATIENCE_S, Router, ZenohWire

__all__ = [
    "DEFAULT_ROUTER",
    "PATIENCE_S",
    "Bus",
    "BusError",
    "Refused",
    "Router",
    "RpcError",
    "Take",
    "check_credentials",
    "host_and_port",
    "zenohd_configuration",
]

Reply = TypeVar("Reply", bound=Strict)


class RpcError(Exception):
    """A call was refused by the service or not answered; the text says why in one line."""


def _ignore(_why: str) -> None:
    """Tell nobody."""


class Bus:
    """One process's connection to the router.

    Parameters
    ----------
    robot
        Robot id, part of every key.
    endpoint
        The router's address; after an outage the connection is made again in the background.
    patience_s
        How long to wait for the router.
    credentials
        Who this is to the router; None where it lets everybody in.

    Raises
    ------
    BusError
        When the address is malformed, or no router is there within ``patience_s`` that lets us in.
    """

    def __init__(
        self,
        robot: str,
        endpoint: str = DEFAULT_ROUTER,
        patience_s: float = PATIENCE_S,
        credentials: Credentials = None,
    ) -> None:
        self.robot = robot
        self.endpoint = endpoint
        self._wire = ZenohWire(robot, endpoint, patience_s, credentials)

    def connected(self) -> bool:
        """Whether there is a router."""
        return self._wire.connected()

    def wait_connected(self, timeout_s: float) -> None:
        """Wait for the router.

        Raises
        ------
        BusError
            When there is none within ``timeout_s``.
        """
        deadline = time.monotonic() + timeout_s
        while not self.connected():
            if time.monotonic() > deadline:
                raise BusError(f"no router at {self.endpoint}; start the stack with `smal up`")
            time.sleep(0.02)

    def publish(self, message: Message) -> None:
        """Send a message on its topic.

        During an outage of the router it is lost, but for the topics that are recorded: those are kept for
        ``topics.KEPT_S``, and subscribers with ``replay`` have them sent afterwards.
        """
        self._wire.publish(TOPICS[message.topic_name], encode(message))

    def has_listeners(self, topic: Topic) -> bool:
        """Whether anybody subscribes to a topic that is not recorded, as far as the router has told yet.

        For what is costly to make; what is recorded is kept for those who come later, whether or not anybody listens.
        """
        return self._wire.has_listeners(topic)

    def subscribe(self, topic: Topic, take: Take, refused: Refused = _ignore, *, replay: bool = False) -> None:
        """Call ``take`` for every sample of a topic, on the bus's thread; it must return at once.

        A sample comes on the topic's very key, with an encoding and of a size that its message may have; the rest of it
        is not looked at.

        Parameters
        ----------
        topic
            What to listen to.
        take
            Called with payload, encoding, and the seconds that the sample took from its sender, by the clocks of both
            machines (None where it does not tell).
        refused
            Called, on the same thread, with why what came is no such sample, and whose it is as far as that is known.
        replay
            Whether to have those samples sent, in order, that were published in the last ``topics.KEPT_S`` before
            this subscription, and those that get lost on the way, in an outage of the router too. For what keeps a
            record; never for what moves a robot.
        """
        self._wire.subscribe(topic, take, refused, replay=replay)

    def listen(self, keys: str, take: Callable[[str, bytes, str], None], *, lane: Lane = "ordinary") -> None:
        """Call ``take(key, payload, encoding)`` for every sample on matching keys, on the bus's thread.

        Raises
        ------
        BusError
            When ``keys`` is no valid key expression.
        """
        self._wire.listen(keys, take, lane=lane)

    def serve(
        self,
        service: str,
        verb: str,
        answer: Callable[[bytes, Callable[[Strict], None]], None],
        refused: Refused = _ignore,
    ) -> None:
        """Answer calls: ``answer(request_json, reply)`` runs on the bus's thread and may pass ``reply`` on.

        A ``Failure`` given to ``reply`` reaches the caller as an error; so does why a request is too large, or not for
        this service alone, of which ``refused`` is told.
        """

        def on_call(request: bytes, send: Callable[[Answer], None]) -> None:
            def reply(message: Strict) -> None:
                send(Answer(message.model_dump_json().encode(), isinstance(message, Failure)))

            answer(request, reply)

        self._wire.serve(rpc_key(self.robot, service, verb), on_call, refused)

    def call(self, service: str, verb: str, request: Strict, reply_type: type[Reply], timeout_s: float = 10.0) -> Reply:
        """Call a service and wait for its reply.

        Raises
        ------
        RpcError
            When the service refuses, does not answer in time, or answers nonsense.
        """
        key = rpc_key(self.robot, service, verb)
        answer = self._wire.call(key, request.model_dump_json().encode(), timeout_s)
        if answer is None:
            raise RpcError(f"{service} {verb}: no answer; is the service running? (router {self.endpoint})")
        if answer.failed:
            raise RpcError(f"{service} {verb}: {_reason(answer.payload)}")
        try:
            return reply_type.model_validate_json(answer.payload)
        except ValidationError as error:
            raise RpcError(f"{service} {verb}: malformed reply: {describe(error)}") from None

    def close(self) -> None:
        """Take back every declaration and leave the router."""
        self._wire.close()


def _reason(failure: bytes) -> str:
    try:
        return printable(Failure.model_validate_json(failure).error)
    except ValidationError:
        # The wire's own errors ("Timeout") are plain text.
        return printable(failure[:200].decode(errors="replace"))
