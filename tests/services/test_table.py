"""The one table of services: what is derived from it, and that adding a service is a folder and a row."""

from pathlib import Path

import pytest

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
def test_every_topic_has_somebody_who_publishes_it(topic: Topic) -> None:
    senders = givers(topic)
    # A person drives at one of two places.
    assert len(senders) == 1 or senders == ("console", "teleop")
    # A robot hears whether there is another one of its id, and instances of a service what they hand on.
    to_itself = topic is topics.PULSE or topic in topics.SNAPSHOTS.values()
    assert set(senders) & set(takers(topic)) == (set(senders) if to_itself else set())


@pytest.mark.parametrize("name", stack_services())
def test_the_compose_file_runs_every_service_in_its_image(name: str) -> None:
    row = SERVICES[name]
    compose = (ROOT / "docker-compose.yml").read_text()
    before, command, _ = compose.partition(f"command: python {' '.join(row.command)}\n")
    assert command, f"docker-compose.yml has no container for {name}"
    # The anchors that a container is made of stand above its command.
    assert f"*{row.image}_image" in before[before.rindex("<<: [") :].splitlines()[0]


@pytest.mark.parametrize("name", stack_services())
def test_every_container_has_a_certificate_of_its_own(name: str) -> None:
    compose = (ROOT / "deploy" / "secure.yml").read_text()
    own = compose.partition(f"\n  {name}:\n")[2].partition("\n  ")[2].partition("\n  r")[0]
    assert f"{{source: {name}-cert, target: cert.pem}}" in own
    assert f"{{source: {name}-key, target: key.pem}}" in own


def test_a_new_service_starts_with_the_stack_and_the_doctor_finds_it(
    toy: Service, free_endpoint: str, tmp_path: Path
) -> None:
    assert stack_services()[-1] == "toy"
    plan = StackPlan(("router", "toy"), "toybot", free_endpoint, logs=tmp_path / "logs")
    with Stack(plan):
        found = check_port(ServiceSettings(robot="toybot", router=free_endpoint))
    assert found.endswith("router, toy")
