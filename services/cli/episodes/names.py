"""By what name a stack's service knows a file or folder of the user's."""

from __future__ import annotations

from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from schemas.codec import describe
from schemas.rpc import FolderName, Nothing, Status
from services.kit.bus import Bus
from services.kit.errors import UsageError
from services.kit.root import name_below

_NAME: TypeAdapter[str] = TypeAdapter(FolderName)


def name_for(bus: Bus, service: str, path: Path, option: str) -> str:
    """Return the name of a path below the root of a service.

    Raises
    ------
    UsageError
        When it is elsewhere, or cannot be named.
    RpcError
        When the service does not answer.
    """
    root = bus.call(service, "status", Nothing(), Status).detail.get("root")
    name = name_below(Path(str(root)), path)
    if name is None:
        raise UsageError(
            f"{option} {path}: the {service} of this stack takes only what is below {root}; put it there, or start the "
            "stack with --root"
        )
    try:
        return _NAME.validate_python(name)
    except ValidationError as error:
        raise UsageError(f"{option} {path}: {describe(error)}") from None
