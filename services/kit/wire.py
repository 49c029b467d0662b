"""Guarantees of the ``Bus``.

- Messages of one bus arrive in the order in which they were sent, over all topics with the same
  urgency and reliability. There is no other order, and any sample can be lost.
- Key, kind, encoding and size are checked before a sample is copied: see ``flaw``. Refused samples,
  and samples with a wrong checksum, are reported to the subscriber, with their sender if known. An
  invalid request is answered with a ``Failure``.
- Handlers run on the bus's threads: one for urgent lanes, one for the ordinary lane and one for the
  calls of each key. Each delays what follows on its thread. A publisher never waits for a handler
  of another process. Exceptions of handlers are logged.
- A handler that blocks its lane makes it deaf: after 12 s its process ends (`echo`).
- Calls wait if they arrive faster than they are answered, or need more than a tenth of a processor.
  The oldest calls beyond the queue are dropped.
- A handler must not call on its own bus: the answer arrives on the thread that waits for it.
- Other processes learn of a subscription, a service, or their end with a delay.
- ``close`` withdraws every declaration; pending calls end without an answer. A closed bus is
  unusable.
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

# Maximum size of a request and of a reply, bytes.
MAX_RPC_BYTES: Final = 1_000_000
# Maximum size of a message of any topic, bytes.
LARGEST_BYTES: Final = max(topic.message.max_bytes for topic in TOPICS.values())
#: Handler of a subscriber: payload, encoding, seconds in transit.
Take = Callable[[bytes, str, float | None], None]
# Called with the reason for refusing a sample or a request, in one line.
Refused = Callable[[str], None]


class BusError(JobError):
    """An impossible use of the bus."""


def flaw(
    wanted: str,
    message: type[Message] | None,
    key: str,
    size: int,
    encoding: str = "",
    *,
    put: bool = True,
) -> str | None:
    """Return in one line why a sample or request is refused, before its bytes are copied, or None.

    Parameters
    ----------
    wanted
        The only valid key: a wildcard ``**`` reaches every subscriber.
    message
        Class of the sample; None for requests and replies, whose JSON needs no other check.
    key, size, encoding
        Key, bytes and encoding of the sample.
    put
        False if the sample deletes the key.
    """
    if key != wanted:
        return f"its key is {printable(key)}, not {wanted}"
    if not put:
        return f"it deletes {wanted}"
    if message is not None:
        return misfit(message, encoding, size)
    return f"too large ({size} bytes > maximum {MAX_RPC_BYTES})" if size > MAX_RPC_BYTES else None


def checksum(payload: bytes) -> bytes:
    """Return the checksum of a message: a lossy link has changed bytes (Zenoh 1.10.2)."""
    return zlib.crc32(payload).to_bytes(4, "little")


def damage(payload: bytes, summed: bytes) -> str | None:
    """Return why a message with a wrong checksum is refused, or None."""
    return (
        None if summed == checksum(payload) else "invalid checksum: bytes were changed on the way"
    )


def reason(failure: bytes) -> str:
    """Return why a call failed, from its error reply."""
    try:
        return printable(Failure.model_validate_json(failure).error)
    except ValidationError:
        # Zenoh's own errors ("Timeout") are plain text.
        return printable(failure[:200].decode(errors="replace"))
