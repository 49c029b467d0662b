"""Files of the user as a stack's services name them, and recording by the stack's recorder."""

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

STOP_TIMEOUT_S: Final = 30.0  # A slow disk delays the end of the last file.
STOP_AFTER_FAILURE_TIMEOUT_S: Final = 5.0


def name_for(bus: Bus, service: str, path: Path, option: str) -> str:
    """Return a path's name below a service's root folder.

    Raises
    ------
    UsageError
        If the path is outside the root folder.
    RpcError
        If the service does not answer.
    """
    root = bus.call(service, "status", Nothing(), Status).detail.get("root")
    name = name_below(Path(str(root)), path)
    if name is None:
        raise UsageError(
            f"{option} {path}: outside the folder of the {service}, {root}; move it there, or "
            "start the stack with --root"
        )
    return name


@contextmanager
def recording(bus: Bus, folder: Path, option: str) -> Iterator[list[str]]:
    """Record every episode into a folder; yield a list that holds the recordings at the end."""
    request = RecordRequest(folder=name_for(bus, "recorder", folder, option))
    bus.call("recorder", "start", request, Nothing)
    files: list[str] = []
    try:
        yield files
    except BaseException:
        # The first error matters more than a recorder that is gone with it.
        with suppress(RpcError):
            bus.call("recorder", "stop", Nothing(), RecordReply, STOP_AFTER_FAILURE_TIMEOUT_S)
        raise
    reply = bus.call("recorder", "stop", Nothing(), RecordReply, STOP_TIMEOUT_S)
    files.extend(reply.files)
    if reply.dropped:
        told = bus.call("recorder", "status", Nothing(), Status).detail.get("last_error")
        why = "" if told is None else f" ({printable(str(told))})"
        tqdm.write(
            f"warning: the recorder dropped {reply.dropped} messages{why}; smal learn splits "
            "recordings at gaps"
        )
