"""The user's files in the hands of a stack's services: what they call them, and the recorder that writes them."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from tqdm import tqdm

from schemas.codec import printable
from schemas.rpc import Nothing, RecordReply, RecordRequest, Status
from services.kit.bus import Bus, RpcError
from services.kit.errors import UsageError
from services.kit.root import name_below

STOP_TIMEOUT_S: Final = 30.0  # The last file's disk may be slow.
STOP_AFTER_FAILURE_TIMEOUT_S: Final = 5.0  # Nobody wants to wait for it as long.


def name_for(bus: Bus, service: str, path: Path, option: str) -> str:
    """Return a path's name below a service's root; UsageError when it is elsewhere, RpcError without an answer."""
    root = bus.call(service, "status", Nothing(), Status).detail.get("root")
    name = name_below(Path(str(root)), path)
    if name is None:
        raise UsageError(
            f"{option} {path}: the {service} of this stack takes only what is below {root}; put it there, or start the "
            "stack with --root"
        )
    return name


@contextmanager
def recording(bus: Bus, folder: Path, option: str) -> Iterator[list[str]]:
    """Record every episode into a folder; give the list of recordings, filled at the end. UsageError names `option`."""
    request = RecordRequest(folder=name_for(bus, "recorder", folder, option))
    bus.call("recorder", "start", request, Nothing)
    files: list[str] = []
    try:
        yield files
    except BaseException:
        # What failed is the news, and not that the recorder may be gone with it.
        with suppress(RpcError):
            bus.call("recorder", "stop", Nothing(), RecordReply, STOP_AFTER_FAILURE_TIMEOUT_S)
        raise
    reply = bus.call("recorder", "stop", Nothing(), RecordReply, STOP_TIMEOUT_S)
    files.extend(reply.files)
    if reply.dropped:
        told = bus.call("recorder", "status", Nothing(), Status).detail.get("last_error")
        why = "" if told is None else f" ({printable(str(told))})"
        tqdm.write(
            f"warning: the recorder dropped {reply.dropped} messages{why}; smal learn cuts recordings at gaps"
        )
