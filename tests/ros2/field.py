"""A fake TurtleBot, and a stack that drives it: processes that a test may harm."""

import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas import topics
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.motion import TruePose
from schemas.rpc import (
    ArmRequest,
    EndRequest,
    LoadReply,
    LoadRequest,
    Nothing,
    ResetReply,
    ResetRequest,
    Status,
)
from services.cli.episodes.client import EpisodeClient, EpisodeRecord
from services.cli.episodes.files import name_for, recording
from services.cli.stack import Stack, StackPlan, flags, free_endpoint
from services.expert.driver import ExpertService
from services.kit.bus import RpcError
from services.kit.node import Detail
from services.simulator.sensors.camera import VISIBLE_FRACTION
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from services.simulator.world.route import plan_route
from services.simulator.world.task import sample_start
from services.table import stack_services
from tests.ros2.truth import Truth
from tests.services.real_base import until

STARTED_S = 100.0


@dataclass(frozen=True)
class Robot:
    """The properties of the fake robot."""

    folder: Path
    world: str = "yard"
    dialect: str = "rmw_zenoh"
    size: tuple[int, int] = (160, 120)
    rate: int = 15
    humble: bool = False
    twist: str = "Twist"
    encoding: str = "jpeg"
    clock_offset: float = 0.0
    renders: bool = True


class Field:
    """The robot's processes, and its truth."""

    def __init__(self, robot: Robot, endpoint: str) -> None:
        self.robot = robot
        self.endpoint = endpoint
        self.world = load_world(robot.world)
        robot.folder.mkdir(parents=True, exist_ok=True)
        self.truth = Truth(robot.folder / "truth")
        self.log = robot.folder / "steps.jsonl"
        self.children: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, part: str) -> None:
        """Start a process of the robot, or start it again."""
        more = {"endpoint": self.endpoint, "truth": self.robot.folder / "truth", "log": self.log}
        options = json.dumps(asdict(self.robot) | more, default=str)
        with (self.robot.folder / f"{part}.log").open("ab") as log:
            command = [sys.executable, "-m", "tests.ros2.fake_turtlebot", part, options]
            self.children[part] = subprocess.Popen(command, stdout=log, stderr=log)

    def stop(self) -> None:
        """End them all."""
        for child in self.children.values():
            child.send_signal(signal.SIGCONT)
            child.kill()
            child.wait()

    def config(self) -> Path:
        """Write the configuration of this robot for the service."""
        robot = self.robot
        drive = self.world.robot.drive
        raw = robot.encoding != "jpeg"
        camera = (
            ("camera/image_raw", "Image")
            if raw
            else ("camera/image_raw/compressed", "CompressedImage")
        )
        told: dict[str, Any] = {
            "preset": "generic", "name": "fake", "router": self.endpoint, "dialect": robot.dialect,
            "distribution": "humble" if robot.humble else "jazzy", "speed_m_s": drive.speed_m_s,
            "turn_rate_rad_s": drive.turn_rate_rad_s, "braking_s": 0.0, "watchdog_s": 0.2, "imu": {"topic": "imu"},
            "camera": {"topic": camera[0], "type": f"sensor_msgs/msg/{camera[1]}", "latency_s": 0.0},
            "stops": [{"topic": "hazard_detection", "type": "irobot_create_msgs/msg/HazardDetectionVector"}],
        }  # fmt: skip
        path = robot.folder / "fake.yaml"
        path.write_text(json.dumps(told))  # JSON is YAML
        return path

    def steps(self, since_s: float) -> list[list[float]]:
        """Return the steps of the wheels: time, position, velocities, and time of the order."""
        lines = self.log.read_text().splitlines()
        # The last line may be half written; of a day's work the end is enough.
        return [step for step in map(json.loads, lines[-4000:-1]) if step[0] >= since_s]

    def carry(self, pose: Pose) -> None:
        """Carry the robot somewhere, as a person does; wait until its camera sees that."""
        self.truth.put(pose.x, pose.y, pose.heading)
        frames = self.truth["frames"]
        until(
            lambda: self.truth["was_put"] == self.truth["put"] and self.truth["frames"] > frames + 3
        )

    def begin_at(self, seed: int, purpose: str) -> Pose:
        """Carry it to where the simulator would begin an episode."""
        number = {"drive": 0, "run": 1}[purpose]
        pose = sample_start(self.world, np.random.default_rng([seed, number, 0]), purpose)
        self.carry(pose)
        return pose

    def found(self) -> bool:
        """Whether the victim is near, and in view."""
        x = self.truth["x"]
        y = self.truth["y"]
        near = (
            math.hypot(self.world.victim.x - x, self.world.victim.y - y) <= self.world.scale.found_m
        )
        return near and self.truth["victim"] >= VISIBLE_FRACTION

    @property
    def moving(self) -> bool:
        """Whether it moves."""
        return self.truth["ahead_m_s"] != 0.0 or self.truth["turn_rad_s"] != 0.0


@contextmanager
def robot_for(robot: Robot) -> Iterator[Field]:
    """Have a robot for as long as the context lasts."""
    place = Field(robot, free_endpoint())
    try:
        for part in ("router", "base", "camera"):
            place.start(part)
        # A renderer in software that others leave no time begins late.
        until(lambda: place.truth["t_s"] and place.truth["frames"], 3 * STARTED_S)
        yield place
    finally:
        place.stop()


@dataclass
class Person:
    """A person that carries the robot, drives it by the map, and reports the victim."""

    place: Field
    client: EpisodeClient
    expert: ExpertService = field(default_factory=ExpertService)

    def __post_init__(self) -> None:
        self.client.watch_poses()
        self.client.node.subscribe(topics.JPEG, self._drive, depth=4)
        self.client.node.bus.wait_connected(100.0)

    def _drive(self, image: CompressedImage) -> Message | None:
        truth = self.place.truth
        pose = TruePose.after(image, x_m=truth["x"], y_m=truth["y"], heading_rad=truth["heading"])
        return self.expert.handle(pose)

    def demonstrate(self, seed: int, folder: Path) -> EpisodeRecord:
        """Drive to the victim once, and have that recorded."""
        start = self.place.begin_at(seed, "drive")
        route = tuple(
            (float(x), float(y)) for x, y in plan_route(self.place.world, (start.x, start.y))
        )
        seen = {"route": route, "found_m": self.place.world.scale.found_m}
        request = ResetRequest(
            seed=seed, purpose="drive", driver="expert", mode="realtime", max_ticks=20000
        )
        with recording(self.client.node.bus, folder, "--folder"):
            return self._run(
                request,
                lambda reply: self.expert.begin(reply.model_copy(update=seen)),
                lambda: self.expert.arrived,
            )

    def load(self, model: Path) -> None:
        """Have recognition and policy work with a model."""
        bus = self.client.node.bus
        for service in ("recognition", "policy"):
            request = LoadRequest(model=name_for(bus, service, model, "--model"))
            bus.call(service, "load", request, LoadReply, timeout_s=100.0)

    def run(self, seed: int, max_ticks: int) -> EpisodeRecord:
        """Let it search by itself."""
        self.place.begin_at(seed, "run")
        request = ResetRequest(seed=seed, driver="policy", mode="realtime", max_ticks=max_ticks)
        return self._run(request, lambda _reply: None, self.place.found)

    def _run(
        self, request: ResetRequest, begin: Callable[[ResetReply], None], there: Callable[[], bool]
    ) -> EpisodeRecord:
        """Run an episode as soon as the robot lacks nothing: on a busy machine it learns its camera's clock again.

        Once it is there, the person says so.
        """
        bus = self.client.node.bus
        said = [""]

        def on_begin(reply: ResetReply) -> None:
            said[0] = reply.episode
            begin(reply)

        def done() -> bool:
            if said[0] and there():
                end = EndRequest(episode=said[0], found=True, session=self.client.node.session)
                said[0] = ""
                bus.call("robot", "end", end, Nothing)
            return False

        while True:
            until(lambda: self.detail["lacks"] is None)
            if stop := int(str(self.detail["latched_stop"] or 0)):
                bus.call("robot", "arm", ArmRequest(stop=stop), Nothing)
            try:
                return self.client.run(request, on_begin=on_begin, done=done)
            except RpcError:
                if self.detail["lacks"] is None:
                    raise

    @property
    def detail(self) -> Detail:
        """Return the status of the robot."""
        return self.client.node.bus.call("robot", "status", Nothing(), Status).detail


@contextmanager
def day_with(robot: Robot) -> Iterator[tuple[Field, Person]]:
    """Have a robot, a stack that drives it, and a person."""
    folder = robot.folder
    with ExitStack() as stacked:
        # Nobody sits at a console in a test.
        stacked.enter_context(pytest.MonkeyPatch.context()).setenv("SMAL_ATTENDED", "false")
        place = stacked.enter_context(robot_for(robot))
        settings = {
            "robot": flags(robot_config=place.config()),
            "console": flags(console="127.0.0.1:0"),
        }
        # What another day has learned lies beside this one.
        settings |= {
            name: flags(root=folder.parent.resolve())
            for name in ("recorder", "recognition", "policy")
        }
        modules = {"robot": "services.ros2"}
        plan = StackPlan(
            stack_services(),
            "fake",
            free_endpoint(),
            settings,
            logs=folder / "logs",
            modules=modules,
        )
        stack = stacked.enter_context(Stack(plan))
        client = EpisodeClient("person", stack.settings)
        stacked.callback(client.close)
        yield place, Person(place, client)
