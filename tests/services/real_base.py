"""What tests of real bases share: a driven base that a test harms, and refused configurations."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from schemas.rpc import ArmRequest, Nothing, ResetReply, ResetRequest, ResumeRequest, Status
from services.kit.bus import Bus, RpcError
from services.kit.errors import UsageError

_MOVES_S = 2.0  # Time in which a base that was armed moves.
_LASTS_S = 0.3  # Time for which it then has to move.


def until(holds: Callable[[], object], timeout_s: float = 100.0, pause_s: float = 0.005) -> None:
    """Wait until something holds; calls of a service need a pause, or its router takes them for a flood."""
    deadline_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s: {holds}"
        time.sleep(pause_s)


class DrivenBase(ABC):
    """A fake base and the service that drives it, on a bus."""

    bus: Bus

    @property
    @abstractmethod
    def moving(self) -> bool:
        """Whether the wheels turn."""

    @property
    def detail(self) -> dict[str, object]:
        """Return the status of the service, empty while it does not answer."""
        try:
            return dict(self.bus.call("robot", "status", Nothing(), Status, timeout_s=1.0).detail)
        except RpcError:
            return {}

    def moves(self) -> bool:
        """Make the base move if it does not: arm it, resume, begin an episode."""
        detail = self.detail
        if not detail:
            return False
        with suppress(RpcError):
            if detail["latched_stop"]:
                stop = ArmRequest(stop=int(str(detail["latched_stop"])))
                self.bus.call("robot", "arm", stop, Nothing)
                detail = self.detail
            if detail["taken_over"]:
                newest = ResumeRequest(
                    episode=str(detail["episode"]), tick=int(str(detail["tick"]))
                )
                self.bus.call("robot", "resume", newest, Nothing)
            if detail["episode"] is None:
                request = ResetRequest(seed=1, driver="expert", mode="realtime", max_ticks=100_000)
                self.bus.call("robot", "reset", request, ResetReply)
        began_s = time.monotonic()
        with suppress(AssertionError):
            until(lambda: self.moving and time.monotonic() - began_s > _LASTS_S, _MOVES_S)
        return self.moving


def check_refusal(
    read_config: Callable[[Path], object], text: str, line: str, folder: Path
) -> None:
    """Assert that a configuration is refused in one short line that contains `line`."""
    path = folder / "mine.yaml"
    path.write_text(text)
    with pytest.raises(UsageError) as caught:
        read_config(path)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
