"""Health and metrics of a service."""

import socket
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from urllib.error import HTTPError

import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from schemas import topics
from schemas.command import Command
from schemas.rpc import Status
from services.kit.bus import Bus, Router
from services.kit.errors import JobError
from services.kit.health import MOST_CONNECTIONS, ailment, serve_http
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from tests.services.chain import command
from tests.services.conftest import RunNode
from tests.services.waiting import eventually, introduce

HEALTHY = Status(
    service="s", state="ready", pid=1, connected=True, uptime_s=9.0, idle_s=0.0, busy_s=0.0, oldest_s=0.0, waiting={},
    received={}, published={}, dropped={}, bad={}, failed=0, detail={},
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({}, None),
        ({"busy_s": 4.9, "oldest_s": 4.9}, None),
        ({"state": "starting"}, "starting"),
        ({"state": "stopping"}, "stopping"),
        ({"connected": False}, "no connection to the router"),
        ({"busy_s": 5.1}, "the work at hand has taken 5.1 s so far"),
        ({"oldest_s": 5.1}, "a message has waited for 5.1 s"),
    ],
)
def test_health_is_about_work_that_gets_done(
    change: dict[str, object], problem: str | None
) -> None:
    assert ailment(HEALTHY.model_copy(update=change)) == problem


@pytest.fixture
def node(settings: ServiceSettings) -> Iterator[Node]:
    with closing(Node("sample", settings.model_copy(update={"http": "127.0.0.1:0"}))) as node:
        yield node


def get(node: Node, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(
            f"http://127.0.0.1:{node._http.server_port}{path}", timeout=100.0
        ) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        with closing(error):
            return error.code, error.read().decode()


def values(text: str) -> Iterator[tuple[tuple[str, str], float]]:
    """Yield every sample of the metrics by its name and its topic or other label."""
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            yield (
                (sample.name, sample.labels.get("topic", sample.labels.get("name", ""))),
                sample.value,
            )


def test_a_stuck_handler_is_no_health(
    node: Node, client: Bus, run_node: RunNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.kit.health.STUCK_S", 0.05)
    begun = threading.Event()
    release = threading.Event()

    def work(_message: object) -> None:
        begun.set()
        release.wait()

    node.subscribe(topics.COMMANDS["teleop"], work)
    run_node(node)

    def sent() -> bool:
        client.publish(command(0))
        return begun.is_set()

    eventually(sent)
    assert eventually(lambda: get(node, "/healthz")[0] == 503)
    assert "the work at hand has taken" in get(node, "/healthz")[1]
    release.set()
    assert eventually(lambda: get(node, "/healthz") == (200, "ok\n"))


def test_a_node_without_its_router_is_not_healthy(free_endpoint: str) -> None:
    router = Router(free_endpoint)
    node = Node("sample", ServiceSettings(router=free_endpoint, http="127.0.0.1:0"))
    thread = threading.Thread(target=node.spin)
    thread.start()
    try:
        assert eventually(lambda: get(node, "/healthz") == (200, "ok\n"))
        router.close()
        assert eventually(lambda: get(node, "/healthz") == (503, "no connection to the router\n"))
        router = Router(free_endpoint)
        assert eventually(lambda: get(node, "/healthz") == (200, "ok\n"))
    finally:
        node.stop()
        thread.join()
        node.close()
        router.close()


def test_silent_http_clients_take_few_threads(
    node: Node, run_node: RunNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.kit.health._Handler.timeout", 0.2)
    run_node(node)
    eventually(lambda: get(node, "/healthz")[0] == 200)
    before = threading.active_count()
    with ExitStack() as silent:
        for _ in range(10 * MOST_CONNECTIONS):
            one = silent.enter_context(
                socket.create_connection(("127.0.0.1", node._http.server_port))
            )
            one.send(b"G")
        assert threading.active_count() <= before + MOST_CONNECTIONS

        def answered() -> bool:
            with suppress(OSError):
                return get(node, "/healthz") == (200, "ok\n")
            return False

        eventually(answered)


def test_metrics_count_every_message_and_the_parts_of_its_hop(
    node: Node, client: Bus, run_node: RunNode
) -> None:
    def answer(message: Command) -> None:
        if message.tick == 13:
            raise ServiceError("not this one")

    node.subscribe(topics.COMMANDS["teleop"], answer)
    node.detail = lambda: {"share of it": 0.5, "world": "campus", "latched": True, "model": None}
    run_node(node)
    introduce(client, "sample", command(0))
    before = node.status().received["command/teleop"]
    for tick in (11, 12, 13):
        client.publish(command(tick))
    eventually(
        lambda: node.status().received["command/teleop"] == before + 3 and node.status().failed == 1
    )
    found = dict(values(get(node, "/metrics")[1]))
    topic = "command/teleop"
    assert found["smal_messages_received_total", topic] == before + 3
    assert found["smal_wait_seconds_count", topic] == before + 2, "all but the one that failed"
    assert found["smal_work_seconds_count", topic] == before + 2
    assert found["smal_transit_seconds_count", topic] == before + 3
    assert (
        0.0
        < found["smal_transit_seconds_sum", topic]
        < 5.0 * found["smal_transit_seconds_count", topic]
    )
    assert found["smal_queue_depth", topic] == 0
    assert found["smal_handling_failures_total", ""] == 1
    assert found["smal_healthy", ""] == 1
    assert (found["smal_sample_share_of_it", ""], found["smal_sample_latched", ""]) == (0.5, 1.0)
    assert not [name for name, _ in found if name in ("smal_sample_world", "smal_sample_model")]
    assert found["process_open_fds", ""] > 0


def test_an_address_that_cannot_be_had_is_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(
            JobError, match=rf"^cannot answer HTTP on {address}: Address already in use$"
        ):
            serve_http(address, str, CollectorRegistry())
    with pytest.raises(JobError, match=r"^cannot answer HTTP on 127\.0\.0\.1:99999: no such port$"):
        serve_http("127.0.0.1:99999", str, CollectorRegistry())
