"""The recorder of a stack, for as long as a command needs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tqdm import tqdm

from schemas.rpc import Nothing, RecordReply, RecordRequest
from services.cli.episodes.names import name_for
from services.kit.bus import Bus, RpcError

#: The last file's disk may be slow; after a failure nobody wants to wait for it as long.
STOP_TIMEOUT_S: Final = 30.0
STOP_AFTER_FAILURE_TIMEOUT_S: Final = 5.0


@dataclass
class Recorded:
    """What was recorded.

    Attributes
    ----------
    files
        Finished recordings, oldest first; known once the recorder has stopped.
    """

    files: tuple[str, ...] = ()


@contextmanager
def recording(bus: Bus, folder: Path, option: str) -> Iterator[Recorded]:
    """Record every episode into a folder; a stack that goes on running is told to stop after a failure as well.

    Raises
    ------
    UsageError
        When the recorder does not write there; `option` names the folder then.
    """
    request = RecordRequest(folder=name_for(bus, "recorder", folder, option))
    bus.call("recorder", "start", request, Nothing)
    recorded = Recorded()
    try:
        yield recorded
    except BaseException:
        # What failed is the news, and not that the recorder may be gone with it.
        with suppress(RpcError):
            bus.call("recorder", "stop", Nothing(), RecordReply, STOP_AFTER_FAILURE_TIMEOUT_S)
        raise
    reply = bus.call("recorder", "stop", Nothing(), RecordReply, STOP_TIMEOUT_S)
    recorded.files = reply.files
    if reply.dropped:
        tqdm.write(f"warning: the recorder dropped {reply.dropped} messages; smal learn cuts recordings at gaps")
