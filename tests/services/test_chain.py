"""Recognition and policy as processes: beliefs drive the robot, malformed messages are dropped."""

from pathlib import Path

import pytest

from schemas import topics
from schemas.base import Message
from schemas.codec import decode
from schemas.topics import Topic
from services.kit.bus import Bus
from tests import corridor
from tests.services.chain import process, seen, state, wheels
from tests.services.waiting import eventually, introduce, malformed, ready

pytestmark = pytest.mark.zenoh


def collect(client: Bus, topic: Topic) -> dict[int, Message]:
    """Collect the messages of a topic by tick."""
    heard: dict[int, Message] = {}

    def take(payload: bytes, encoding: str, _transit_s: float | None) -> None:
        message = decode(topic.message, payload, encoding)
        heard[message.tick] = message

    client.subscribe(topic, take)
    return heard


def test_belief_drives_the_robot(client: Bus, router_endpoint: str, tmp_path: Path) -> None:
    """By a map; the odometry of a frame arrives before or after its observation."""
    states = collect(client, topics.STATE)
    actions = collect(client, topics.ACTION)
    commands = collect(client, topics.COMMANDS["policy"])
    mapped = corridor.save_model(tmp_path / "mapped.smal")
    with (
        process("recognition", router_endpoint, "--model", str(mapped)),
        process("policy", router_endpoint, "--model", str(mapped)),
    ):
        for service, message in (
            ("recognition", seen(0, episode="hello")),
            ("policy", state(0, None)),
        ):
            ready(client, service)
            introduce(client, service, message)

        def answered() -> bool:
            for message in (wheels(99, episode="hello"), seen(99, episode="hello")):
                client.publish(message)
            return 99 in states

        eventually(answered)
        for service, topic in (
            ("recognition", topics.ODOMETRY),
            ("recognition", topics.OBSERVATION),
            ("policy", topics.STATE),
        ):
            malformed(client, service, topic)
        for tick in range(corridor.FRAMES):
            both = [seen(tick), wheels(tick)]
            for message in both if tick % 2 else reversed(both):
                client.publish(message)
            eventually(lambda tick=tick: tick in commands and tick in actions)
    assert {states[tick].status for tick in range(corridor.FRAMES)} == {"recognized"}
    assert commands[5].atom == "forward"
    assert actions[5].kind == "follow"
    assert states[10].places[0].keyframe == actions[10].state
    assert (actions[corridor.FRAMES - 1].kind, commands[corridor.FRAMES - 1].atom) == (
        "goal",
        "stop",
    )
