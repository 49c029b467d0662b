"""Run the router: ``python -m services.router --router tcp/127.0.0.1:7447``."""

from services.kit.bus import Router, host_and_port
from services.kit.credentials import how_secure
from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.kit.settings import ServiceSettings


class RouterSettings(ServiceSettings):
    """Listens on ``--router``."""

    insecure: bool = False
    """Whether it may listen without certificates where other machines reach it."""


def serve() -> None:
    """Route until stopped; the status queryable is a client of the router like any other."""
    settings = read_settings(RouterSettings, "router")
    configure_logging(settings.log_level)
    credentials = settings.credentials("router")
    router = Router(settings.router, credentials, settings.robot, insecure=settings.insecure)
    try:
        with Node("router", settings) as node:
            node.stop_on_signals()
            who = how_secure(credentials, host_and_port(settings.router)[0])
            node.log.info("listening on %s, %s", settings.router, who)
            node.spin()
    finally:
        router.close()


if __name__ == "__main__":
    run_service("router", serve)
