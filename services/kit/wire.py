"""What whoever uses a ``Bus`` may count on.

- What one bus sends arrives in the order in which it was sent, over all topics that are as urgent and as reliable.
  There is no other order, and any sample may be lost.
- Nothing is copied before its key, kind, encoding and size are looked at: see ``flaw``. What is refused is told to who
  listens, with its sender where that is known; an unfit request is answered with a ``Failure``. So is a message of
  which bytes were changed on the way, where its sender said what they were.
- Handlers run on the bus's own threads, one for what is urgent, one for all else and one for the calls of each key, and
  hold up what follows there until they return. A publisher never waits for one, but for its own
  bus's. What a handler raises is logged.
- A handler that holds up its lane makes it deaf: after 12 s its process ends (`echo`).
- Calls that come faster than they are answered, or than a tenth of a processor answers them, wait; of
  too many the oldest are dropped.
- A handler must not call on its own bus: the answer comes on the thread that waits for it.
- It takes a moment until others know of a subscription, a service, or their end.
- ``close`` takes back every declaration; who waits for an answer is told that there is none. A closed bus is of no use.
"""

import zlib
from collections.abc import Callable
from typing import Final

from pydantic import ValidationError

from schemas.base import Message
from schemas.codec import misfit, printable
from schemas.rpc import Failure
from schemas.topics import TOPICS
from services.kit.errors import JobError

MAX_RPC_BYTES: Final = 1_000_000  # Largest request of a service, and largest reply, bytes.
LARGEST_BYTES: Final = max(
    topic.message.max_bytes for topic in TOPICS.values()
)  # Largest message of any topic, bytes.
#: What a subscriber is called with: payload, encoding, seconds on the way.
Take = Callable[[bytes, str, float | None], None]
Refused = Callable[
    [str], None
]  # What is called with why a sample or a request is refused, in one line.


class BusError(JobError):
    """The bus cannot be used as asked."""


def flaw(
    wanted: str,
    message: type[Message] | None,
    key: str,
    size: int,
    encoding: str = "",
    *,
    put: bool = True,
) -> str | None:
    """Say in one line why something is refused, before its bytes are copied; None where it may be taken.

    One key is ``wanted`` alone, since whoever sends to ``**`` reaches every subscriber. ``message`` is what a sample
    has to be; None for requests and replies, whose JSON needs no other check. Without ``put`` it deletes the key.
    """
    if key != wanted:
        return f"its key is {printable(key)}, not {wanted}"
    if not put:
        return f"it deletes {wanted}"
    if message is not None:
        return misfit(message, encoding, size)
    return f"{size} bytes, at most {MAX_RPC_BYTES} allowed" if size > MAX_RPC_BYTES else None


def checksum(payload: bytes) -> bytes:
    """Return what is sent beside a message: a link on which much is dropped has changed bytes of some (1.10.2)."""
    return zlib.crc32(payload).to_bytes(4, "little")


def damage(payload: bytes, summed: bytes) -> str | None:
    """Say why a message is refused that is not what its sender said that it is."""
    return None if summed == checksum(payload) else "bytes of it were changed on their way"


def reason(failure: bytes) -> str:
    """Return why a call failed, by the error that answered it."""
    try:
        return printable(Failure.model_validate_json(failure).error)
    except ValidationError:
        # Zenoh's own errors ("Timeout") are plain text.
        return printable(failure[:200].decode(errors="replace"))
