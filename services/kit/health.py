"""When a service counts as healthy: it has its router, and its work gets done. That its process exists says nothing."""

from __future__ import annotations

from typing import Final

from schemas.rpc import Status

#: Seconds that one piece of work may take, or wait, before the service counts as stuck. Rendering the first frame on a
#: busy machine takes longer; a health check allows for it with its start period and retries.
STUCK_S: Final = 5.0


def ailment(status: Status) -> str | None:
    """Return why a service is not healthy, in one line; None where it is."""
    if status.state != "ready":
        return status.state
    if not status.connected:
        return "no connection to the router"
    if status.busy_s > STUCK_S:
        return f"the work at hand has taken {status.busy_s:.1f} s so far"
    if status.oldest_s > STUCK_S:
        return f"a message has waited for {status.oldest_s:.1f} s"
    return None
