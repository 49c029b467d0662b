"""The simulator as a process: episodes over the bus, malformed commands on every topic, silence, stop."""

import pytest

from schemas import topics
from schemas.base import Message
from schemas.command import Command
from schemas.rpc import ArmRequest, EndRequest, Nothing, ResetReply, ResetRequest, ResumeRequest
from services.kit.bus import Bus, RpcError
from tests.services.chain import process
from tests.services.waiting import collected, eventually, malformed, ready, status_of

pytestmark = [pytest.mark.rendering, pytest.mark.zenoh]


def command(episode: str, tick: int) -> Command:
    header = Message(robot="rescuebot", episode=episode, tick=tick, stamp_ns=0)
    return Command.after(header, source="policy", atom="forward")


def test_lockstep_episode_waits_and_survives_malformed_commands(
    client: Bus, router_endpoint: str
) -> None:
    images = collected(client, topics.JPEG)
    reset = ResetRequest(seed=1)

    def told(what: str) -> object:
        return eventually(lambda: status_of(client, "robot")).detail[what]

    def arm() -> None:
        client.call("robot", "arm", ArmRequest(stop=int(str(told("latched_stop") or 0))), Nothing)

    with process(
        "robot", router_endpoint, "--world", "yard", "--camera-width", "64", "--camera-height", "48"
    ):
        ready(client, "robot")
        with pytest.raises(RpcError, match="the robot is not armed"):
            client.call("robot", "reset", reset, ResetReply, 30.0)
        arm()
        reply = client.call("robot", "reset", reset, ResetReply, 30.0)
        assert reply.world == "yard"
        eventually(lambda: images)
        for source, topic in topics.COMMANDS.items():
            malformed(client, "robot", topic)
            stopped = told("stop_cause")
            # In whatever form a stop comes, it is one.
            assert stopped == ("emergency_stop" if source == "emergency_stop" else None)
            if stopped:
                arm()
                client.call(
                    "robot", "resume", ResumeRequest(episode=reply.episode, tick=0), Nothing
                )
        assert [image.tick for image in images] in ([0], [0, 0])
        for tick in range(3):
            client.publish(command(reply.episode, tick))
            eventually(lambda tick=tick: images[-1].tick == tick + 1)
        assert images[0].data != images[-1].data
        client.call("robot", "end", EndRequest(episode=reply.episode), Nothing)
        with pytest.raises(RpcError, match="not running"):
            client.call("robot", "end", EndRequest(episode=reply.episode), Nothing)
