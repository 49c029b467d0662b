"""The simulator as a process: episodes over the bus, malformed commands on every topic, silence, stop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from schemas import topics
from schemas.base import Message
from schemas.codec import decode
from schemas.command import Command, CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.episode import Episode
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, ResumeRequest
from services.kit.bus import Bus, RpcError, Take
from tests.services.chain import process
from tests.services.waiting import eventually, malformed, ready, status_of

pytestmark = [pytest.mark.rendering, pytest.mark.zenoh]


@dataclass
class Heard:
    """What the simulator said."""

    images: list[CompressedImage] = field(default_factory=list)
    applied: list[CommandApplied] = field(default_factory=list)
    events: list[Episode] = field(default_factory=list)


@pytest.fixture
def heard(client: Bus, router_endpoint: str) -> Iterator[Heard]:
    heard = Heard()

    def into(collected: list[Message], cls: type[Message]) -> Take:
        return lambda payload, encoding, _transit_s: collected.append(decode(cls, payload, encoding))

    client.subscribe(topics.JPEG, into(heard.images, CompressedImage))  # type: ignore[arg-type]
    client.subscribe(topics.APPLIED, into(heard.applied, CommandApplied))  # type: ignore[arg-type]
    client.subscribe(topics.EPISODE, into(heard.events, Episode))  # type: ignore[arg-type]
    flags = ("--world", "yard", "--camera-width", "64", "--camera-height", "48")
    with process("robot", router_endpoint, *flags):
        stop = ready(client, "robot").detail["emergency_stop"]
        with pytest.raises(RpcError, match="the robot is not armed"):
            reset(client)
        client.call("robot", "arm", ArmRequest(stop=int(stop or 0)), Nothing)
        yield heard


def reset(client: Bus, **request: object) -> ResetReply:
    return client.call("robot", "reset", ResetRequest.model_validate({"seed": 1} | request), ResetReply, 30.0)


def command(episode: str, tick: int, atom: str = "forward") -> Command:
    return Command.model_validate(
        {"robot": "rescuebot", "episode": episode, "tick": tick, "stamp_ns": 0, "source": "policy", "atom": atom}
    )


def test_lockstep_episode_waits_for_commands_and_survives_malformed_ones_on_every_topic(
    client: Bus, heard: Heard
) -> None:
    reply = reset(client)
    assert reply.world == "yard"
    eventually(lambda: heard.images)
    for source, topic in topics.COMMANDS.items():
        malformed(client, "robot", topic)
        status = status_of(client, "robot")
        assert status is not None
        if source == "emergency_stop":  # in whatever form it comes, it is one
            assert status.detail["stop_cause"] == "emergency_stop"
            client.call("robot", "arm", ArmRequest(stop=int(status.detail["emergency_stop"] or 0)), Nothing)
            client.call("robot", "resume", ResumeRequest(episode=reply.episode, tick=0), Nothing)
        else:
            assert status.detail["stop_cause"] is None
    assert [image.tick for image in heard.images] in ([0], [0, 0])
    for tick in range(3):
        client.publish(command(reply.episode, tick))
        eventually(lambda tick=tick: heard.images[-1].tick == tick + 1)  # type: ignore[misc]
    assert heard.images[0].data != heard.images[-1].data
    client.call("robot", "end", EndRequest(episode=reply.episode), Nothing)
    eventually(lambda: heard.events[-1].event == "ended")
    with pytest.raises(RpcError, match="not running"):
        client.call("robot", "end", EndRequest(episode=reply.episode), Nothing)
