"""What a service tells Prometheus: counts, queues, and where the time between arrival and answer goes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Final

from prometheus_client import CollectorRegistry, Histogram, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from schemas.rpc import Status
from services.kit.health import ailment

BUCKETS_S: Final = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
_BY_TOPIC: Final = ("service", "robot", "topic")
#: What no metric's name holds.
_NOT_OF_A_NAME: Final = re.compile(r"\W", re.ASCII)
#: Fields of ``Status`` that count by topic, and what the metric says.
_COUNTS: Final = {
    "received": "Messages taken.",
    "published": "Messages sent.",
    "dropped": "Messages replaced by newer ones before they were taken.",
    "bad": "Messages and requests refused as malformed.",
}


class Metrics:
    """The metrics of one node.

    A hop from one service to the next is its transit on the bus, its wait in the queue and the work on it.

    Parameters
    ----------
    service, robot
        Labels of every metric.
    status
        Tells the counts.
    """

    def __init__(self, service: str, robot: str, status: Callable[[], Status]) -> None:
        self._labels = (service, robot)
        self.registry = CollectorRegistry()
        self.registry.register(_StatusCollector(robot, status))
        ProcessCollector(registry=self.registry)
        self._transit = self._histogram(
            "smal_transit_seconds", "From the sender to here, by the clocks of both machines.", _BY_TOPIC
        )
        self._wait = self._histogram("smal_wait_seconds", "From arrival until its turn in the queue.", _BY_TOPIC)
        self._work = self._histogram("smal_work_seconds", "Handling one message, its answers published.", _BY_TOPIC)
        self._decision = self._histogram(
            "smal_decision_seconds",
            "From a frame's readiness to the acceptance of its command, at the actuator.",
            ("service", "robot", "source"),
        )

    def transit(self, topic: str, seconds: float) -> None:
        """Count the way of one message over the bus."""
        self._transit.labels(*self._labels, topic).observe(max(0.0, seconds))

    def hop(self, topic: str, wait_s: float, work_s: float) -> None:
        """Count one message that was handled."""
        self._wait.labels(*self._labels, topic).observe(wait_s)
        self._work.labels(*self._labels, topic).observe(work_s)

    def decision(self, source: str, seconds: float) -> None:
        """Count one command that the actuator accepted."""
        self._decision.labels(*self._labels, source).observe(seconds)

    def _histogram(self, name: str, meaning: str, labels: tuple[str, ...]) -> Histogram:
        return Histogram(name, meaning, labels, buckets=BUCKETS_S, registry=self.registry)


class _StatusCollector(Collector):
    """Turns a node's status into metrics whenever it is asked."""

    def __init__(self, robot: str, status: Callable[[], Status]) -> None:
        self._robot = robot
        self._status = status

    def describe(self) -> Iterator[Metric]:
        """Name nothing beforehand: a registry would otherwise ask for the status before there is one."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Give every figure of the status."""
        status = self._status()
        labels = [status.service, self._robot]
        for field, meaning in _COUNTS.items():
            counts = CounterMetricFamily(f"smal_messages_{field}", meaning, labels=_BY_TOPIC)
            for topic, count in getattr(status, field).items():
                counts.add_metric([*labels, topic], count)
            yield counts
        waiting = GaugeMetricFamily("smal_queue_depth", "Messages that wait for their turn.", labels=_BY_TOPIC)
        for topic, count in status.waiting.items():
            waiting.add_metric([*labels, topic], count)
        yield waiting
        failures = CounterMetricFamily("smal_handling_failures", "Messages and requests whose handling failed.",
                                       labels=_BY_TOPIC[:2])  # fmt: skip
        failures.add_metric(labels, status.failed)
        yield failures
        health = GaugeMetricFamily("smal_healthy", "Whether the service has its router and gets its work done.",
                                   labels=_BY_TOPIC[:2])  # fmt: skip
        health.add_metric(labels, ailment(status) is None)
        yield health
        yield from _details(status, labels)


def _details(status: Status, labels: list[str]) -> Iterator[Metric]:
    """Give the numbers among what a service tells of itself, each as a metric of its own."""
    for name, value in status.detail.items():
        if isinstance(value, int | float):
            metric = f"smal_{status.service}_{_NOT_OF_A_NAME.sub('_', name)}"
            family = GaugeMetricFamily(metric, f"{name}, as the service tells it.", labels=_BY_TOPIC[:2])
            family.add_metric(labels, value)
            yield family
