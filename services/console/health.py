"""How every service is, for the page."""

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from schemas.rpc import Nothing, Status
from services.kit.bus import Bus, RpcError
from services.kit.health import ailment

_ANSWER_S: Final = 1.0  # How long a service may take to answer.
#: What a service tells of itself that the page needs.
_TOLD: Final = ("world", "worlds", "variation", "variations", "disk")


class Health:
    """Asks services how they are."""

    def __init__(self, bus: Bus, services: tuple[str, ...]) -> None:
        self._bus = bus
        self._services = services
        self._asked_s = time.monotonic()
        self.statuses: dict[str, Status | None] = {}  # The last answers; None of who did not answer.

    def ask(self) -> list[dict[str, object]]:
        """Ask all at once; return one row a service, for the page."""
        before = self.statuses
        # Threads for this once: a service that hangs holds up its own thread alone, and for no longer than its time.
        with ThreadPoolExecutor(len(self._services), "health") as pool:
            self.statuses = dict(zip(self._services, pool.map(self._status, self._services), strict=True))
        now = time.monotonic()
        elapsed_s, self._asked_s = max(now - self._asked_s, 1e-3), now
        return [_row(name, before.get(name), status, elapsed_s) for name, status in self.statuses.items()]

    def detail(self, service: str, key: str) -> object:
        """Return what a service told of itself; None where it did not."""
        status = self.statuses.get(service)
        return None if status is None else status.detail.get(key)

    def _status(self, service: str) -> Status | None:
        try:
            return self._bus.call(service, "status", Nothing(), Status, _ANSWER_S)
        except RpcError:
            return None


def _row(name: str, before: Status | None, status: Status | None, elapsed_s: float) -> dict[str, object]:
    if status is None:
        return {"name": name, "ailment": "does not answer"}
    earlier = before.published if before is not None and before.pid == status.pid else {}
    rates = {topic: (count - earlier.get(topic, count)) / elapsed_s for topic, count in status.published.items()}
    return {
        "name": name,
        "ailment": ailment(status),
        "idle": round(status.idle_s, 1),
        "rates": {topic: round(rate, 1) for topic, rate in rates.items() if rate > 0},
        "dropped": sum(status.dropped.values()),
        "bad": sum(status.bad.values()),
        "failed": status.failed,
        "told": {key: status.detail[key] for key in _TOLD if status.detail.get(key) not in (None, "", False)},
    }
