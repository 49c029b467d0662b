"""Features, recognition and policy as processes: good message, malformed message, silence, stop."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from schemas import topics
from schemas.action import Action
from schemas.base import Message
from schemas.codec import decode
from schemas.command import Command
from schemas.observation import Observation
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import State
from schemas.topics import Topic
from services.kit.bus import Bus, RpcError
from tests import corridor
from tests.services.chain import (
    FEATURES,
    LENGTH,
    identity,
    image,
    observation,
    process,
    save_model,
    seen,
    state,
    wheels,
)
from tests.services.waiting import eventually, introduce, malformed, ready, status_of

pytestmark = pytest.mark.zenoh

M = TypeVar("M", bound=Message)
Listen = Callable[[Topic, type[M]], dict[int, M]]


@pytest.fixture
def listen(client: Bus) -> Listen[Message]:
    """Collect the messages of a topic by tick."""

    def collect(topic: Topic, cls: type[M]) -> dict[int, M]:
        heard: dict[int, M] = {}

        def take(payload: bytes, encoding: str, _transit_s: float | None) -> None:
            message = decode(cls, payload, encoding)
            heard[message.tick] = message

        client.subscribe(topic, take)
        return heard

    return collect


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_model(tmp_path_factory.mktemp("model") / "corridor.smal")


@pytest.fixture
def recognition(client: Bus, router_endpoint: str, model: Path) -> Iterator[None]:
    with process("recognition", router_endpoint, "--model", str(model)):
        ready(client, "recognition")
        introduce(client, "recognition", observation(0, episode="hello"))
        yield


@pytest.fixture
def policy(client: Bus, router_endpoint: str, model: Path) -> Iterator[None]:
    with process("policy", router_endpoint, "--model", str(model)):
        ready(client, "policy")
        introduce(client, "policy", state(0, model, episode="hello", status="collecting"))
        yield


def until_heard(client: Bus, message: Message, heard: dict[int, M], *others: Message) -> None:
    """Ask, in an episode of its own, until an answer is heard: a subscription takes a moment to become known.

    What was answered until then is forgotten: it has ticks of the introduction.
    """

    def answered() -> bool:
        for one in (message, *others):
            client.publish(one)
        return message.tick in heard

    eventually(answered)
    heard.clear()


def test_features_turns_every_frame_into_its_observation(
    client: Bus, router_endpoint: str, listen: Listen[Observation]
) -> None:
    heard = listen(topics.OBSERVATION, Observation)
    with process("features", router_endpoint):
        ready(client, "features")
        introduce(client, "features", image(0))
        malformed(client, "features", topics.JPEG)
        client.publish(image(5))
        eventually(lambda: 5 in heard)
    expected = observation(5).features.to_numpy()
    np.testing.assert_array_equal(heard[5].features.to_numpy(), expected)
    assert heard[5].fingerprint == FEATURES.fingerprint
    assert heard[5].stamp_ns == 5


@pytest.mark.usefixtures("recognition")
def test_recognition_knows_where_the_robot_is(
    client: Bus, listen: Listen[State], model: Path
) -> None:
    heard = listen(topics.STATE, State)
    until_heard(client, observation(99, episode="hello"), heard)
    malformed(client, "recognition", topics.OBSERVATION)
    for tick in range(LENGTH):
        client.publish(observation(tick, place=6 + tick))
        eventually(lambda tick=tick: tick in heard)  # type: ignore[misc]
    assert [heard[tick].status for tick in range(LENGTH)] == ["collecting"] * (LENGTH - 1) + [
        "recognized"
    ]
    answer = heard[LENGTH - 1]
    # Sequence 2 holds the places 6, 7 and 8.
    assert answer.state == 2
    assert answer.duality_gap < 1e-3
    assert answer.model == identity(model)


def test_recognition_without_a_model_is_idle_and_refuses_a_bad_one(
    client: Bus, router_endpoint: str, listen: Listen[State], tmp_path: Path, model: Path
) -> None:
    heard = listen(topics.STATE, State)
    shutil.copy(model, tmp_path / "whole.smal")
    with process("recognition", router_endpoint, "--root", str(tmp_path)):
        ready(client, "recognition")
        introduce(client, "recognition", observation(0))
        client.publish(observation(1))
        eventually(lambda: 1 in heard)
        assert heard[1].status == "idle"
        truncated = tmp_path / "truncated.smal"
        truncated.write_bytes(model.read_bytes()[:-7])
        with pytest.raises(RpcError, match="truncated"):
            client.call("recognition", "load", LoadRequest(model="truncated.smal"), LoadReply)
        reply = client.call(
            "recognition", "load", LoadRequest(model="whole.smal", scheme="paper"), LoadReply
        )
        assert (reply.scheme, reply.stride) == ("paper", LENGTH)


@pytest.mark.usefixtures("policy")
def test_policy_commands_every_frame_and_decides_when_a_state_is_known(
    client: Bus, listen: Listen[Message], model: Path
) -> None:
    commands = listen(topics.COMMANDS["policy"], Command)
    actions = listen(topics.ACTION, Action)
    until_heard(client, state(99, model, episode="hello", status="collecting"), commands)
    malformed(client, "policy", topics.STATE)
    client.publish(state(0, model, status="recognized", state=2))
    for tick in (1, 2, 3):
        client.publish(state(tick, model, status="collecting"))
    eventually(lambda: 3 in commands and 0 in actions)
    # Places 8, 9 (turn left), 10; then the plan is over, and nothing is known of where to go.
    assert [commands[tick].atom for tick in range(4)] == ["forward", "left", "forward", "stop"]
    assert (actions[0].kind, actions[0].atoms) == ("action", ("forward", "left", "forward"))


@pytest.mark.usefixtures("recognition")
def test_robot_stands_while_recognition_and_policy_have_different_models(
    client: Bus, router_endpoint: str, listen: Listen[Message], model: Path, tmp_path: Path
) -> None:
    commands = listen(topics.COMMANDS["policy"], Command)
    actions = listen(topics.ACTION, Action)
    other = save_model(tmp_path / "longer.smal", frames=21)
    flags = ("--model", str(other), "--root", str(model.parent))
    with process("policy", router_endpoint, *flags):
        ready(client, "policy")
        introduce(client, "policy", state(0, other, episode="hello", status="collecting"))
        for tick in range(LENGTH):
            client.publish(observation(tick, place=6 + tick))
            eventually(lambda tick=tick: tick in commands)  # type: ignore[misc]
            assert commands[tick].atom == "stop"
        assert not actions
        status = status_of(client, "policy")
        assert status is not None
        assert status.detail["states_of_another_model"] == LENGTH
        client.call("policy", "load", LoadRequest(model=model.name), LoadReply)
        for tick in range(LENGTH, 2 * LENGTH):
            client.publish(observation(tick, place=3 + tick, episode="next"))
            eventually(lambda tick=tick: tick in commands)  # type: ignore[misc]
        # The last place was 8, and the corridor goes on forward to 9.
        eventually(lambda: 2 * LENGTH - 1 in actions)
        assert commands[2 * LENGTH - 1].atom == "forward"


def test_a_belief_drives_the_robot(
    client: Bus, router_endpoint: str, listen: Listen[Message], tmp_path: Path
) -> None:
    """By a map; odometry comes after the observation of its frame, or before it."""
    states = listen(topics.STATE, State)
    actions = listen(topics.ACTION, Action)
    commands = listen(topics.COMMANDS["policy"], Command)
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
        until_heard(client, wheels(99, episode="hello"), states, seen(99, episode="hello"))
        malformed(client, "recognition", topics.ODOMETRY)
        for tick in range(corridor.FRAMES):
            both = [seen(tick), wheels(tick)]
            for message in both if tick % 2 else reversed(both):
                client.publish(message)
            eventually(lambda tick=tick: tick in commands and tick in actions)  # type: ignore[misc]
    assert {states[tick].status for tick in range(corridor.FRAMES)} == {"recognized"}
    assert commands[5].atom == "forward"
    assert actions[5].kind == "follow"
    assert states[10].keyframes[0] == actions[10].state
    assert (actions[corridor.FRAMES - 1].kind, commands[corridor.FRAMES - 1].atom) == (
        "goal",
        "stop",
    )
