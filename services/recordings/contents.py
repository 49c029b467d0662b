"""What an unfinished recording holds: all that its writer has to know to go on with it."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Self

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata
from pydantic import ValidationError

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.topics import TOPICS, topic_of
from services.recordings.ledger import Order, order_of
from services.recordings.records import Record, fields, message_header, message_payload
from services.recordings.recovery import RecoveryError

#: Messages whose place among their like is more than their tick.
_ORDERED: tuple[type[Message], ...] = (Episode, Command, CommandApplied)


def end_tick_of(message: Message, before: int | None) -> int | None:
    """Return the tick at which the episode ended, as far as is known after this message."""
    return message.tick if isinstance(message, Episode) and message.event == "ended" else before


@dataclass
class Contents:
    """What an unfinished recording holds.

    Attributes
    ----------
    metadata
        Robot and episode.
    channels
        By topic.
    orders
        Topic and place (see ``ledger.order_of``) of every message, in order.
    end_tick
        Tick of the episode's end, if that was recorded.
    """

    metadata: dict[str, str] = field(default_factory=dict)
    channels: dict[str, Channel] = field(default_factory=dict)
    orders: list[tuple[str, Order]] = field(default_factory=list)
    end_tick: int | None = None

    @classmethod
    def of(cls, records: Iterable[Record]) -> Self:
        """Read the records of a file.

        Raises
        ------
        RecoveryError
            When they are not those of one episode.
        """
        contents = cls()
        names: dict[int, str] = {}
        try:
            for record in records:
                contents._take(record, names)
        except (McapError, ValidationError, KeyError, ValueError, struct.error):
            raise RecoveryError("not the recording of an episode") from None
        if not contents.metadata:
            raise RecoveryError("it ends before it says which episode it is of")
        return contents

    def _take(self, record: Record, names: dict[int, str]) -> None:
        match record.opcode:
            case Opcode.METADATA:
                found = Metadata.read(fields(record.body)).metadata
                self.metadata = self.metadata or {name: found[name] for name in ("robot", "episode")}
            case Opcode.CHANNEL:
                channel = Channel.read(fields(record.body))
                topic = topic_of(channel.topic)
                if topic is None:
                    raise ValueError(channel.topic)
                self.channels[topic.name], names[channel.id] = channel, topic.name
            case Opcode.MESSAGE:
                header = message_header(record.body)
                self._enter(names[header.channel_id], header.sequence, message_payload(record.body))

    def _enter(self, topic: str, tick: int, payload: memoryview) -> None:
        kind = TOPICS[topic].message
        if kind not in _ORDERED:
            self.orders.append((topic, (tick,)))
            return
        message = kind.model_validate_json(bytes(payload))
        self.orders.append((topic, order_of(message)))
        self.end_tick = end_tick_of(message, self.end_tick)
