"""Run a router: ``python -m services.router --router tcp/127.0.0.1:7447``.

With ``--peers`` several routers are linked and share all messages. Clients with several addresses
(``--router A,B``) connect to the first, and within two seconds to the next if that router is killed
or frozen.
"""

from services.kit.bus import Router, addresses, host_and_port
from services.kit.credentials import how_secure
from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.kit.settings import FleetSettings, fleet
from services.router.flooding import end_floods, take_log


class RouterSettings(FleetSettings):
    """Settings of a router that listens on ``--router``."""

    peers: str | None = None
    """Addresses of the linked routers, separated by commas; if they include its own, it connects to
    those before it.
    """
    insecure: bool = False
    """Whether it listens without certificates where other machines can connect."""


def serve() -> None:
    """Route until stopped; the status queryable is a client of the router."""
    settings = read_settings(RouterSettings, "router")
    configure_logging(settings.log_level)
    credentials = settings.credentials("router")
    peers = addresses(settings.peers) if settings.peers else []
    robots = fleet(settings.robot, settings.robots)
    log = take_log()
    router = Router(settings.router, credentials, *robots, insecure=settings.insecure, peers=peers)
    end_floods(log, len(robots), linked=bool(peers), disconnect=router.disconnect)
    try:
        with Node("router", settings) as node:
            node.stop_on_signals()
            node.detail = lambda: {"robots": len(robots)}
            who = how_secure(credentials, host_and_port(settings.router)[0])
            node.log.info("listening on %s, %s", settings.router, who)
            node.spin()
    finally:
        router.close()


if __name__ == "__main__":
    run_service("router", serve)
