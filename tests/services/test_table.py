"""The table of services: everything that is derived from it, and a new service as a folder and a row."""

from pathlib import Path

import pytest
import yaml

from schemas import topics
from schemas.topics import TOPICS, Topic
from services.cli.doctor import check_port
from services.cli.stack import Stack, StackPlan
from services.kit.settings import ServiceSettings
from services.table import SERVICES, Service, givers, stack_services, takers
from tests.services.cli.conftest import ROOT

TOY = """
from schemas import topics
from services.kit.node import Node
from services.kit.process import read_settings
from services.kit.settings import ServiceSettings

with Node("toy", read_settings(ServiceSettings, "toy")) as node:
    node.stop_on_signals()
    node.subscribe(topics.ODOMETRY, lambda odometry: None)
    node.spin()
"""


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Service:
    """Add a service as a contributor would: a folder, and a row."""
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "__main__.py").write_text(TOY)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    row = Service("toy", "counts the wheels' turns", takes=(topics.ODOMETRY,), module="toy")
    monkeypatch.setitem(SERVICES, "toy", row)
    return row


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda topic: topic.name)
def test_topic_has_one_kind_of_publisher(topic: Topic) -> None:
    senders = givers(topic)
    # A person drives at one of two places.
    assert len(senders) == 1 or senders == ("console", "teleop")
    # Robots receive the pulses of others, and instances of a service the snapshots of others.
    to_itself = topic is topics.PULSE or topic in topics.SNAPSHOTS.values()
    assert set(senders) & set(takers(topic)) == (set(senders) if to_itself else set())


COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
SECURE = yaml.safe_load((ROOT / "deploy" / "secure.yml").read_text())["services"]


@pytest.mark.parametrize("name", stack_services())
def test_compose_runs_each_service_in_its_image(name: str) -> None:
    row = SERVICES[name]
    container = COMPOSE[name]
    assert container["command"].split() == ["python", *row.command]
    assert container["build"]["target"] == row.image


@pytest.mark.parametrize("name", stack_services())
def test_container_has_a_certificate_of_its_own(name: str) -> None:
    secrets = {one["target"]: one["source"] for one in SECURE[name]["secrets"]}
    assert secrets == {"ca.pem": "ca", "cert.pem": f"{name}-cert", "key.pem": f"{name}-key"}


def test_new_service_starts_with_the_stack(
    toy: Service, free_endpoint: str, tmp_path: Path
) -> None:
    assert stack_services()[-1] == "toy"
    plan = StackPlan(("router", "toy"), "toybot", free_endpoint, logs=tmp_path / "logs")
    with Stack(plan):
        found = check_port(ServiceSettings(robot="toybot", router=free_endpoint))
    assert found.endswith("router, toy")
