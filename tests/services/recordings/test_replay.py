"""A replay is what the robot told, and nothing that moves one; and what follows it decides as the library does."""

import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import smal
from schemas import topics
from schemas.base import Message, Velocity
from schemas.codec import decode
from schemas.episode import Episode
from services.cli.replay import Player
from services.features.service import FeaturesService
from services.kit.bus import Bus
from services.kit.model_service import LoadedModel
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.policy.service import PolicyService
from services.recognition.service import RecognitionService
from services.recordings.encoding import decode_image
from services.recordings.reader import read_recording
from services.recordings.replay import REPLAYABLE, Tick, tracks_of
from services.table import SERVICES
from smal.model import Model
from tests import corridor
from tests.command import run_smal
from tests.services.cli.conftest import Smal
from tests.services.conftest import RunNode
from tests.services.recordings import driven_corridor
from tests.services.recordings.recorded_messages import episode
from tests.services.recordings.test_recorder_files import record
from tests.services.waiting import eventually, ready

ROBOT = "rescuebot"


class Heard:
    """What was said on some topics, by tick; of the newest episode only."""

    def __init__(self, bus: Bus, *which: topics.Topic) -> None:
        self.said: defaultdict[str, dict[int, Message]] = defaultdict(dict)
        self.order: list[Message] = []
        self._news = threading.Condition()
        for topic in which:
            bus.subscribe(topic, self._taker(topic))

    def _taker(self, topic: topics.Topic) -> Callable[[bytes, str, float | None], None]:
        def take(payload: bytes, encoding: str, _transit_s: float | None) -> None:
            message = decode(topic.message, payload, encoding)
            with self._news:
                self.said[topic.name][message.tick] = message
                self.order.append(message)
                self._news.notify_all()

        return take

    def wait(self, topic: topics.Topic, tick: int) -> None:
        with self._news:
            assert self._news.wait_for(lambda: tick in self.said[topic.name], 20.0), (
                f"no {topic.name} of {tick}"
            )


@pytest.fixture
def robot(settings: ServiceSettings) -> Node:
    node = Node("robot", settings)
    yield node
    node.close()


@pytest.fixture
def chain(settings: ServiceSettings, run_node: RunNode) -> Callable[[Model], None]:
    """Run features, recognition and policy, wired as their processes are."""

    def run(model: Model) -> None:
        features, recognition, policy = (
            Node(name, settings) for name in ("features", "recognition", "policy")
        )
        loaded = LoadedModel.of(model, "model")
        recognizing = RecognitionService()
        deciding = PolicyService()
        recognizing.load(loaded)
        deciding.load(loaded)
        features.subscribe(topics.JPEG, FeaturesService(model.feature_settings).handle)
        recognizing.announce = recognition.publish
        recognition.subscribe(topics.ODOMETRY, recognizing.see)
        recognition.subscribe(topics.APPLIED, recognizing.see_applied)
        recognition.subscribe(topics.OBSERVATION, recognizing.handle)
        policy.subscribe(topics.APPLIED, deciding.see_applied)
        policy.subscribe(topics.STATE, deciding.handle)
        for node in (features, recognition, policy):
            run_node(node)

    return run


def decided(path: Path, model: Model) -> list[tuple[Velocity, str, smal.Belief]]:
    """Return what the library does on the recorded frames: velocity, kind of decision, belief."""
    (recorded,) = read_recording(path).episodes
    stamps = {
        tick: stamp_ns for tick, stamp_ns in stamps_of(path).items() if tick in recorded.images
    }
    robot = smal.Robot(model)
    decisions = []
    last_ns = None
    for tick in sorted(recorded.images):
        elapsed_s = None if last_ns is None else (stamps[tick] - last_ns) / 1e9
        image = decode_image(bytes(recorded.images[tick]))
        robot.step(image, recorded.odometry[tick].pose, elapsed_s)
        last_ns = stamps[tick]
        decisions.append((Velocity(*robot.executed), robot.decision.kind, robot.belief))
    return decisions


def stamps_of(path: Path) -> dict[int, int]:
    (track,) = tracks_of(path)
    ticks = track.play("any", "any", 0, {"odometry": topics.ODOMETRY})
    return {tick.number: message.stamp_ns for tick in ticks for message in tick.messages}


def check_decisions(client: Bus, robot: Node, path: Path, model: Model) -> list[str]:
    """Replay, frame by frame, and compare what is decided with what the library decides."""
    expected = decided(path, model)
    heard = Heard(client, topics.MAP, topics.STATE, topics.ACTION, topics.COMMANDS["policy"])
    (track,) = tracks_of(path)

    def answered(tick: Tick) -> bool:
        if tick.number > 0:
            heard.wait(topics.COMMANDS["policy"], tick.number - 1)
        return True

    eventually(lambda: robot.bus.has_listeners(topics.JPEG))
    player = Player(robot, track, "replay-1", dict(REPLAYABLE))
    player.run(answered)
    last = len(expected) - 1
    # A command is urgent: it overtakes what it was decided by.
    for topic in (topics.STATE, topics.ACTION, topics.COMMANDS["policy"]):
        heard.wait(topic, last)
    for tick, (velocity, kind, belief) in enumerate(expected):
        command, action, state = (
            heard.said[name][tick] for name in ("command/policy", "action", "state")
        )
        assert (command.velocity, action.kind, tick) == (velocity, kind, tick)
        assert (command.episode, command.robot) == ("replay-1", ROBOT)
        places = belief.summary()
        assert state.keyframes.tolist() == places.keyframes.tolist()
        np.testing.assert_array_equal(state.weights, places.weights.astype(np.float32))
        assert state.evidence == belief.evidence
        assert state.lost == min(belief.lost, 1.0)
    assert list(heard.said["map"]) == [0]
    return [velocity.atom() for velocity, _, _ in expected]


def test_services_match_library_when_replayed(
    client: Bus, robot: Node, chain: Callable[[Model], None], tmp_path: Path
) -> None:
    path = driven_corridor.record(tmp_path)
    chain(corridor.model())
    atoms = check_decisions(client, robot, path, corridor.model())
    assert {"forward", "left", "right"} <= set(atoms), (
        "a drive that calls for one decision proves little"
    )


def test_replay_publishes_robot_messages_without_commands(
    client: Bus, robot: Node, tmp_path: Path
) -> None:
    path = record(tmp_path, list(episode("drive-1", frames=4)))
    keys: set[str] = set()
    client.listen("**", lambda key, _payload, _encoding: keys.add(key))
    heard = Heard(client, *REPLAYABLE.values())
    eventually(lambda: robot.bus.has_listeners(topics.JPEG))
    (track,) = tracks_of(path)
    Player(robot, track, "replay-1", dict(REPLAYABLE)).run(lambda _tick: True)
    heard.wait(topics.EPISODE, 3)
    eventually(
        lambda: any(isinstance(one, Episode) and one.event == "ended" for one in heard.order)
    )
    assert keys <= {topic.key(ROBOT) for topic in SERVICES["robot"].gives}
    assert not keys & {topic.key(ROBOT) for topic in (*topics.COMMANDS.values(), topics.HEARTBEAT)}
    assert {(one.robot, one.episode) for one in heard.order} == {(ROBOT, "replay-1")}
    for topic in (topics.ODOMETRY, topics.IMU, topics.POSE, topics.JPEG):
        heard.wait(topic, 3)  # they come on their own ways
        assert sorted(heard.said[topic.name]) == [0, 1, 2, 3]
    sent = {(one.topic_name, one.tick): one for one in episode("drive-1", frames=4)}
    told = heard.said["odometry"][2]
    recorded = sent["odometry", 2]
    changed = {"robot", "episode", "stamp_ns"}
    assert told.model_dump(exclude=changed) == recorded.model_dump(exclude=changed)
    image = heard.said["camera/jpeg"][2]
    assert image.data == sent["camera/jpeg", 2].data
    stamps = [heard.said["odometry"][tick].stamp_ns for tick in range(4)]
    assert np.diff(stamps).tolist() == [100_000_000] * 3
    assert {one.purpose for one in heard.order if isinstance(one, Episode)} == {"run"}, (
        "no second demonstration"
    )


@pytest.mark.zenoh
def test_the_command_replays_and_is_refused_where_a_robot_is(
    client: Bus,
    router_endpoint: str,
    settings: ServiceSettings,
    run_node: RunNode,
    tmp_path: Path,
    smal: Smal,
) -> None:
    path = record(tmp_path, list(episode("drive-1", frames=5)))
    heard = Heard(client, topics.JPEG, topics.EPISODE)
    status, _, told = smal("replay", path, "--router", router_endpoint, "--rate", 20)
    assert status == 0, told
    assert "episode drive-1 of rescuebot as replay-" in told
    heard.wait(topics.JPEG, 4)
    stepped = run_smal("replay", path, "--router", router_endpoint, "--step", typed="\n\n")
    assert stepped.returncode == 0, stepped.stderr
    eventually(lambda: [one.tick for one in heard.order if isinstance(one, Episode)][-1] == 1)
    run_node(Node("robot", settings))
    ready(client, "robot")
    status, _, why = smal("replay", path, "--router", router_endpoint)
    assert status == 1
    assert why.startswith("smal: robot rescuebot already exists (process ")
    assert "smal up --robot-body none" in why
    assert why.count("\n") == 1


@pytest.mark.system
def test_a_stack_without_a_robot_answers_a_replay(
    free_endpoint: str, tmp_path: Path, smal: Smal
) -> None:
    path = driven_corridor.record(tmp_path)
    model = corridor.save_model(tmp_path / "corridor.smal")
    up = subprocess.Popen(
        [
            *(
                sys.executable, "-c", "from services.cli.main import main; main()", "up",
                "--robot-body", "none",
            ),
            *("--console", "none", "--model", model, "--router", free_endpoint),
        ],
        stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        assert any("robot rescuebot without a robot" in line for line in up.stderr)
        with closing(Bus(ROBOT, free_endpoint)) as bus:
            heard = Heard(bus, topics.ACTION)
            status, _, told = smal("replay", path, "--router", free_endpoint, "--rate", 2)
            assert status == 0, told
            eventually(lambda: max(heard.said["action"], default=0) > driven_corridor.FRAMES - 5)
    finally:
        up.terminate()
        assert up.wait(100.0) == 0
