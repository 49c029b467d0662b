"""Settings that all services share."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from schemas.base import ROBOT_ID_PATTERN
from schemas.topics import check_robot_id
from services.kit.bus import DEFAULT_ROUTER, PATIENCE_S, Bus
from services.kit.credentials import Credentials, certificate_of, credentials_in

#: Default router with certificates.
DEFAULT_SECURE_ROUTER: Final = DEFAULT_ROUTER.replace("tcp/", "tls/")


#: Maximum robots of a fleet: each has threads in every process that serves it, and sessions at the
#: router.
MAX_ROBOTS: Final = 32


class ServiceSettings(BaseSettings):
    """Settings that all services share; each is ``SMAL_<NAME>`` or ``--<name>``."""

    model_config = SettingsConfigDict(
        env_prefix="SMAL_", cli_kebab_case=True, use_attribute_docstrings=True
    )

    robot: Annotated[str, Field(pattern=ROBOT_ID_PATTERN)] = "rescuebot"
    """Robot id, part of every topic's key."""
    router: str = DEFAULT_ROUTER
    """Address of the Zenoh router, or addresses separated by commas; with certificates they begin
    with tls/.
    """
    secure: Path | None = None
    """Folder of certificates that `smal secure init` made."""
    tls_ca: Path | None = None
    """Certificate of the authority, in place of the folder's."""
    tls_cert: Path | None = None
    """Certificate of this process."""
    tls_key: Path | None = None
    """Key of the certificate."""
    http: Annotated[str | None, Field(pattern=r"^[^\s/:]*:\d{1,5}$")] = None
    """Address of GET /healthz and GET /metrics, HOST:PORT; disabled by default."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest severity of logged messages."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [
            name for name in ("tls_ca", "tls_cert", "tls_key") if getattr(self, name) is not None
        ]
        if 0 < len(given) < 3:
            raise ValueError("tls_ca, tls_cert and tls_key go together")
        if (given or self.secure) and "router" not in self.model_fields_set:
            self.router = DEFAULT_SECURE_ROUTER
        return self

    def credentials(self, role: str) -> Credentials:
        """Return the credentials of a role; BusError if configured but missing."""
        if self.tls_ca and self.tls_cert and self.tls_key:
            return certificate_of(self.tls_ca, self.tls_cert, self.tls_key)
        return None if self.secure is None else credentials_in(self.secure, role)

    def open_bus(self, role: str, patience_s: float = PATIENCE_S) -> Bus:
        """Connect to the router in a role; BusError if no router accepts the connection."""
        return Bus(self.robot, self.router, patience_s, self.credentials(role), role=role)


class FleetSettings(ServiceSettings):
    """Settings of services for several robots."""

    robots: Annotated[int, Field(ge=1, le=MAX_ROBOTS)] = 1
    """Number of robots that are served: ROBOT, ROBOT-2 and so on."""

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        fleet(self.robot, self.robots)
        return self

    def of_robot(self, robot: str) -> Self:
        """Return the settings of one robot's node, whose process reports its health."""
        return self.model_copy(update={"robot": robot, "http": None})


def fleet(robot: str, robots: int) -> tuple[str, ...]:
    """Return the ids of a fleet's robots, ``robot`` first; ValueError if one is too long."""
    return (robot, *(check_robot_id(f"{robot}-{number}") for number in range(2, robots + 1)))
