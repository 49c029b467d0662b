"""Recognition and policy as processes: beliefs drive the robot, malformed messages are dropped."""

from pathlib import Path

import pytest

from schemas import topics
from services.kit.bus import Bus
from tests import corridor
from tests.services.chain import process, seen, state, wheels
from tests.services.waiting import collected, eventually, introduce, malformed, ready

pytestmark = pytest.mark.zenoh


def test_belief_drives_the_robot(client: Bus, router_endpoint: str, tmp_path: Path) -> None:
    """By a map; the odometry of a frame arrives before or after its observation."""
    states = collected(client, topics.STATE)
    actions = collected(client, topics.ACTION)
    commands = collected(client, topics.COMMANDS["policy"])
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
            return any(one.tick == 99 for one in states)

        eventually(answered)
        for service, topic in (
            ("recognition", topics.ODOMETRY),
            ("recognition", topics.OBSERVATION),
            ("policy", topics.STATE),
        ):
            malformed(client, service, topic)
        introduced = [len(heard) for heard in (states, actions, commands)]
        for tick in range(corridor.FRAMES):
            both = [seen(tick), wheels(tick)]
            for message in both if tick % 2 else reversed(both):
                client.publish(message)
            eventually(lambda tick=tick: commands[-1].tick == actions[-1].tick == tick)
    told, done, driven = (
        {one.tick: one for one in heard[since:] if one.episode == "e"}
        for heard, since in zip((states, actions, commands), introduced, strict=True)
    )
    assert {told[tick].status for tick in range(corridor.FRAMES)} == {"recognized"}
    assert (driven[5].atom, done[5].kind) == ("forward", "follow")
    assert told[10].keyframes[0] == done[10].state
    last = corridor.FRAMES - 1
    assert (done[last].kind, driven[last].atom) == ("goal", "stop")
