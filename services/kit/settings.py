"""Settings that every service has."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from schemas.base import ROBOT_ID_PATTERN
from schemas.topics import check_robot_id
from services.kit.bus import DEFAULT_ROUTER, PATIENCE_S, Bus
from services.kit.credentials import Credentials, certificate_of, credentials_in

#: Where a router is that takes certificates, unless something else is said.
DEFAULT_SECURE_ROUTER: Final = DEFAULT_ROUTER.replace("tcp/", "tls/")


#: Robots of a fleet, at most: each has threads of its own in every process that serves it, and sessions at the router.
MAX_ROBOTS: Final = 32


class ServiceSettings(BaseSettings):
    """Settings that every service has; each can be given as ``SMAL_<NAME>`` or ``--<name>``."""

    model_config = SettingsConfigDict(
        env_prefix="SMAL_", cli_kebab_case=True, use_attribute_docstrings=True
    )

    robot: Annotated[str, Field(pattern=ROBOT_ID_PATTERN)] = "rescuebot"
    """Robot id, part of every topic's key."""
    router: str = DEFAULT_ROUTER
    """Address of the Zenoh router, or of several, separated by commas; with certificates it begins with tls/."""
    secure: Path | None = None
    """Folder of certificates that `smal secure init` made."""
    tls_ca: Path | None = None
    """Certificate by whose signature others are known, in place of the folder's."""
    tls_cert: Path | None = None
    """Certificate of this process."""
    tls_key: Path | None = None
    """Its key."""
    http: Annotated[str | None, Field(pattern=r"^[^\s/:]*:\d{1,5}$")] = None
    """Where to answer GET /healthz and GET /metrics, HOST:PORT; nowhere if not given."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe messages that are logged."""

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
        """Return what to show the router as one of the roles; BusError where it is asked for, and not there."""
        if self.tls_ca and self.tls_cert and self.tls_key:
            return certificate_of(self.tls_ca, self.tls_cert, self.tls_key)
        return None if self.secure is None else credentials_in(self.secure, role)

    def open_bus(self, role: str, patience_s: float = PATIENCE_S) -> Bus:
        """Connect to the router as one of the roles; BusError when there is none, or it does not let us in."""
        return Bus(self.robot, self.router, patience_s, self.credentials(role), role=role)


class FleetSettings(ServiceSettings):
    """Settings of what serves several robots."""

    robots: Annotated[int, Field(ge=1, le=MAX_ROBOTS)] = 1
    """Robots that are served: ROBOT, ROBOT-2 and so on."""

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        fleet(self.robot, self.robots)
        return self

    def of_robot(self, robot: str) -> Self:
        """Return the settings of the node of one robot, which tells its health by its process."""
        return self.model_copy(update={"robot": robot, "http": None})


def fleet(robot: str, robots: int) -> tuple[str, ...]:
    """Return the ids of the robots of a fleet, the first as it is called; ValueError where one becomes too long."""
    return (robot, *(check_robot_id(f"{robot}-{number}") for number in range(2, robots + 1)))
