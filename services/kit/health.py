"""Health over HTTP: ``GET /healthz`` for supervisors, ``GET /metrics`` for Prometheus."""

import re
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import TYPE_CHECKING, Any, Final, Literal
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, Histogram, ProcessCollector, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import ThreadingWSGIServer
from prometheus_client.registry import Collector

from schemas.rpc import Status
from schemas.topics import LANES
from services.kit.errors import JobError

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIEnvironment

#: Time limit of one piece of work, and of its wait, before the service counts as stuck, seconds.
#: Rendering the first frame on a busy machine takes longer; health checks allow for it by their
#: start period and retries.
STUCK_S: Final = 5.0
BUCKETS_S: Final = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
#: Maximum number of connections, each with a thread: several times those of a health check and
#: Prometheus.
MOST_CONNECTIONS: Final = 16
_BY_TOPIC: Final = ("service", "robot", "topic")
Labels = tuple[str, str]
#: Fields of ``Status`` with counts by topic, and the help of their metrics.
_COUNTS: Final = {
    "received": "Messages received.",
    "published": "Messages published.",
    "dropped": "Messages replaced by newer messages before they were handled.",
    "bad": "Messages and requests refused as malformed.",
}
#: Durations, with their second label and the help of their metrics.
_TIMES: Final = {
    "transit": ("topic", "Transit from the sender, by the clocks of both machines."),
    "wait": ("topic", "Wait in the queue."),
    "work": ("topic", "Handling of one message, including the publishing of its answers."),
    "decision": (
        "source",
        "From a frame's readiness to the acceptance of its command, at the actuator.",
    ),
}


def ailment(status: Status) -> str | None:
    """Return why a service is unhealthy, in one line, or None."""
    if status.state != "ready":
        return status.state
    if not status.connected:
        return silence(status.silent)
    if status.busy_s > STUCK_S:
        return f"the work at hand has taken {status.busy_s:.1f} s so far"
    if status.oldest_s > STUCK_S:
        return f"a message has waited for {status.oldest_s:.1f} s"
    return None


def silence(lanes: Collection[str]) -> str:
    """Describe the outage of the bus in one line, by its silent lanes."""
    some = 0 < len(lanes) < len(LANES)
    return (
        f"no echo from the router by lane {', '.join(lanes)}"
        if some
        else "no connection to the router"
    )


class Metrics(Collector):
    """Metrics of one node, labelled by its name and robot.

    ``status`` returns the counts. A hop between two services consists of transit on the bus, wait
    in the queue and work.
    """

    def __init__(self, service: str, robot: str, status: Callable[[], Status]) -> None:
        self._labels = (service, robot)
        self._status = status
        self.registry = CollectorRegistry()
        self.registry.register(self)
        ProcessCollector(registry=self.registry)
        self._times = {
            what: Histogram(
                f"smal_{what}_seconds",
                meaning,
                ("service", "robot", by),
                buckets=BUCKETS_S,
                registry=self.registry,
            )
            for what, (by, meaning) in _TIMES.items()
        }

    def took(
        self, what: Literal["transit", "wait", "work", "decision"], of: str, seconds: float
    ) -> None:
        """Record the duration of a step, by topic or source of commands."""
        self._times[what].labels(*self._labels, of).observe(max(0.0, seconds))

    def describe(self) -> Iterator[Metric]:
        """Describe no metric in advance; otherwise the registry collects before a status exists."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Yield the status as metrics."""
        status = self._status()
        labels = self._labels
        for name, meaning in _COUNTS.items():
            counts = CounterMetricFamily(f"smal_messages_{name}", meaning, labels=_BY_TOPIC)
            yield _by_topic(counts, labels, getattr(status, name))
        depth = GaugeMetricFamily(
            "smal_queue_depth", "Messages that wait for their turn.", labels=_BY_TOPIC
        )
        yield _by_topic(depth, labels, status.waiting)
        meaning = "Messages and requests whose handling failed."
        failures = CounterMetricFamily("smal_handling_failures", meaning, labels=_BY_TOPIC[:2])
        failures.add_metric(labels, status.failed)
        yield failures
        yield _gauge(
            "smal_healthy", "Whether the service is healthy.", labels, ailment(status) is None
        )
        for name, value in status.detail.items():
            if isinstance(value, int | float):
                metric = f"smal_{status.service}_{re.sub(r'[^a-zA-Z0-9_]', '_', name)}"
                yield _gauge(metric, f"{name}, from the service's status.", labels, value)


class Together(Collector):
    """Metrics of all nodes of a process, merged by name."""

    def __init__(self, registries: Callable[[], Iterable[CollectorRegistry]]) -> None:
        self._registries = registries
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.registry.register(self)

    def describe(self) -> Iterator[Metric]:
        """Describe no metric in advance, like the merged collectors."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Merge the metrics by name, without those of the process."""
        together: dict[str, Metric] = {}
        for family in (family for registry in self._registries() for family in registry.collect()):
            together.setdefault(family.name, family)
            if together[family.name] is not family:
                together[family.name].samples += family.samples
        return (family for name, family in together.items() if not name.startswith("process_"))


def _by_topic(
    family: GaugeMetricFamily | CounterMetricFamily, labels: Labels, counts: dict[str, int]
) -> Metric:
    for topic, count in counts.items():
        family.add_metric((*labels, topic), count)
    return family


def _gauge(name: str, meaning: str, labels: Labels, value: float) -> Metric:
    family = GaugeMetricFamily(name, meaning, labels=_BY_TOPIC[:2])
    family.add_metric(labels, value)
    return family


class _Server(ThreadingWSGIServer):
    """Server with a limited number of connections that does not log disconnected clients."""

    #: With the library's default of 5, a sixth simultaneous client waits a second or more for TCP to
    #: retry.
    request_queue_size = 128

    def __init__(self, *arguments: Any) -> None:  # noqa: ANN401 - as the library says
        self._room = threading.Semaphore(MOST_CONNECTIONS)
        super().__init__(*arguments)

    def verify_request(self, *_request: object) -> bool:
        return self._room.acquire(blocking=False)

    def process_request_thread(self, *request: Any) -> None:  # noqa: ANN401
        try:
            super().process_request_thread(*request)
        finally:
            self._room.release()

    def handle_error(self, *_request: object) -> None:
        """Log nothing: the application logs its own errors, and the rest are the client's."""


class _Handler(WSGIRequestHandler):
    timeout = 5.0  #: Timeout of a silent client, seconds.

    def log_message(self, *_arguments: object) -> None:
        """Log nothing: a check every few seconds is no news."""


def serve_http(
    address: str, ailment: Callable[[], str | None], metrics: CollectorRegistry
) -> WSGIServer:
    """Serve HTTP on separate threads, so that a busy service answers and a frozen one does not.

    Parameters
    ----------
    address
        ``HOST:PORT``; without a host, all interfaces.
    ailment
        Returns why the service is unhealthy, or None.
    metrics
        Metrics to publish.

    Returns
    -------
    WSGIServer
        The server, which answers until its `shutdown`.

    Raises
    ------
    JobError
        If the port is taken or the host does not belong to this machine.
    """
    host, _, port = address.rpartition(":")
    tell = make_wsgi_app(metrics)

    def answer(asked: "WSGIEnvironment", start: "StartResponse") -> Iterable[bytes]:
        if asked["PATH_INFO"] != "/healthz":
            return tell(asked, start)  # type: ignore[no-any-return]
        problem = ailment()
        status = "200 OK" if problem is None else "503 Service Unavailable"
        start(status, [("Content-Type", "text/plain; charset=utf-8")])
        return [f"{problem or 'ok'}\n".encode()]

    try:
        server = make_server(host, int(port), answer, _Server, _Handler)
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise JobError(f"cannot answer HTTP on {address}: {reason}") from None
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
