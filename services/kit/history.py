"""Subscription with history: kept samples, lost samples and live samples, in order."""

import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import zenoh
import zenoh.ext

from schemas.codec import printable
from schemas.topics import KEPT_S
from services.kit.connection import Connection, Declared
from services.kit.replay import Budget, Replay
from services.kit.wire import Refused

# Timeout after which an unresponsive sender no longer delays its own samples.
REPLAY_TIMEOUT_S: Final = 10.0
_AGAIN_S: Final = 0.5  # Pause between two unanswered queries.
#: Name of a publisher that keeps samples: its session and its number there.
_SENDER_PATTERN: Final = r"[0-9a-f]{1,32}/[0-9]+(?=/|$)"


def in_order(on_sample: Callable[[zenoh.Sample], None]) -> "zenoh.handlers.Callback[zenoh.Sample]":
    """Create a callback that runs on the session's thread, which keeps the order of topics."""
    return zenoh.handlers.Callback(on_sample, indirect=False)


def _ask(
    connection: Connection,
    keys: str,
    on_reply: Callable[[zenoh.Sample], None],
    end: Callable[[], None],
    until_s: float,
) -> None:
    """Fetch kept samples; retry until ``until_s``, since a new sender appears before it can answer."""
    came: list[bool] = []

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            came.append(True)
            on_reply(reply.ok)

    def on_end() -> None:
        if came or time.monotonic() > until_s:
            end()
        else:
            again = threading.Timer(_AGAIN_S, _ask, (connection, keys, on_reply, end, until_s))
            again.daemon = True
            again.start()

    with suppress(zenoh.ZError):
        connection.session.get(
            zenoh.Selector(keys, f"_time=[now(-{KEPT_S:g}s)..]"),
            zenoh.handlers.Callback(take, on_end, indirect=False),
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=REPLAY_TIMEOUT_S,
        )


def subscribe_whole(
    connection: Connection,
    key: str,
    take: Callable[[zenoh.Sample], None],
    refused: Refused,
    budget: Budget,
) -> tuple[Declared[Any], Declared[Any]]:
    """Call ``take`` for each sample of a key, including the samples of the last ``topics.KEPT_S``.

    Returns
    -------
    tuple of Declared
        The two declarations.
    """
    senders = f"{key}/@adv/pub"
    renewed: list[
        bool
        # One entry per session; from the second session on, senders without an answer are queried
        # again.
    ] = []

    def ask(name: str) -> None:
        def on_reply(sample: zenoh.Sample) -> None:
            if sample.source_info is not None:
                replay.replayed(name, sample.source_info.source_sn, sample)

        until_s = time.monotonic() + (REPLAY_TIMEOUT_S if len(renewed) > 1 else 0.0)
        _ask(connection, f"{senders}/{name}/**", on_reply, lambda: replay.ended(name), until_s)

    full = "buffer full while fetching the history of {}; the rest of its history is skipped"
    replay = Replay(take, ask, budget, lambda name: refused(full.format(name)))

    def on_live(sample: zenoh.Sample) -> None:
        source = sample.source_info
        if source is None:  # Sender without a history.
            take(sample)
        else:
            name = f"{source.source_id.zid}/{source.source_id.eid}"
            replay.live(name, source.source_sn, sample, len(sample.payload))

    def on_sender(token: zenoh.Sample) -> None:
        if token.kind == zenoh.SampleKind.PUT:
            name = re.match(_SENDER_PATTERN, str(token.key_expr).removeprefix(f"{senders}/"))
            if name is None:
                refused(f"invalid liveliness token: {printable(str(token.key_expr))}")
            else:
                replay.met(name[0])

    # Subscribing first leaves no gap between kept and live samples. Zenoh detects samples lost on
    # the way, or in an outage, by their numbers and fetches them in order.
    recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)

    def subscribe(session: zenoh.Session) -> zenoh.ext.AdvancedSubscriber[None]:
        renewed.append(True)
        replay.hold()
        return zenoh.ext.declare_advanced_subscriber(
            session, key, in_order(on_live), recovery=recovery
        )

    subscription = connection.declare(subscribe)
    on_token = in_order(on_sender)
    return subscription, connection.declare(
        lambda session: session.liveliness().declare_subscriber(
            f"{senders}/**", on_token, history=True
        )
    )
