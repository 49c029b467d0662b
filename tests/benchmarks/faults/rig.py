"""A stack that drives, what is observed of it, and the hands that look after it while others do harm."""

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal
from unittest.mock import patch

from schemas.codec import DecodeError, decode
from schemas.rpc import (
    ArmRequest,
    EndRequest,
    Mode,
    Nothing,
    RecordReply,
    ResetReply,
    ResetRequest,
    ResumeRequest,
    Status,
)
from schemas.topics import EPISODE, TOPICS, Topic
from services.cli.stack import GROUPED, Stack, StackPlan, flags, free_endpoint
from services.cli.up import WATCH_S
from services.kit.bus import Bus, RpcError
from services.kit.errors import JobError
from services.kit.node import Detail
from services.table import stack_services
from tests.benchmarks.faults.judge import Entry, drives
from tests.benchmarks.faults.noting import NOTES
from tests.benchmarks.faults.proxy import Link, link
from tests.benchmarks.faults.wheels import Step, boot_ahead_s, read_steps, rolling

ROBOT: Final = "faulty"
WORLD: Final = "yard"
CAMERA: Final = (160, 120)
LINKED: Final = (
    "robot",
    "policy",
    "recorder",
)  # Services whose way to the router is a link that can go down.
_LOOK_S: Final = 0.02
_MOVING_S: Final = 12.0
_STARTS: Final = 5
_FLEET_HZ: Final = 5.0  # Frames a second of each of several robots in real time: two cores do other things as well.


@dataclass(frozen=True)
class RigPlan:
    """What to set up, with a new folder for recordings and logs, and certificates if ``secure`` has them.

    ``robot`` is "moving base", a process of its own, which moves on in real time whatever is harmed; "noting", the
    simulated robot, which notes its stops and which nobody observes, who would only be flooded as well; or "simulated".
    """

    model: Path
    folder: Path
    world: str = WORLD
    robot: Literal["moving base", "noting", "simulated"] = "moving base"
    console: str = "127.0.0.1:0"
    secure: Path | None = None
    routers: int = 1
    robots: int = 1  # The others are simulated, and begin one episode after another.
    instances: int = 1  # Instances of each grouped service.
    mode: Mode = "realtime"

    @property
    def notes(self) -> Path:
        """What the robot of a flooded stack notes of its stops."""
        return self.folder / "stops.jsonl"

    @property
    def recordings(self) -> Path:
        """Folder of the recordings."""
        return self.folder / "recordings"

    @property
    def steps(self) -> Path:
        """The moving base's log."""
        return self.folder / "steps.jsonl"

    def stack(self, endpoint: str, links: Mapping[str, str], wheels: str | None) -> StackPlan:
        """Return what to start, with the addresses of the links and of the moving base."""
        chain = flags(model=self.model.resolve())
        body = {"world": self.world, "camera_width": CAMERA[0], "camera_height": CAMERA[1]}
        if self.robots > 1:
            body["frames_hz"] = _FLEET_HZ
        own = {
            "robot": flags(**body, wheels=wheels, depth=None if wheels is None else False),
            "recognition": chain,
            "policy": chain,
            "recorder": flags(recordings=self.recordings.resolve()),
            "console": flags(console=self.console, root=self.folder.resolve()),
        }
        every = {
            name: own.get(name, ()) + flags(router=links.get(name)) for name in stack_services()
        }
        for number in range(2, self.robots + 1):
            every[f"robot-{number}"] = flags(
                **body, depth="false" if self.mode == "realtime" else None
            )
            every[f"recorder-{number}"] = flags(recordings=self.recordings.resolve() / str(number))
            every[f"console-{number}"] = flags(console="127.0.0.1:0", root=self.folder.resolve())
        module = {"moving base": "robot", "noting": "noting"}.get(self.robot)
        modules = {"robot": f"tests.benchmarks.faults.{module}"} if module else {}
        scale = dict.fromkeys(GROUPED, self.instances)
        logs = self.folder / "logs"
        return StackPlan(
            stack_services(),
            ROBOT,
            endpoint,
            every,
            self.secure,
            logs,
            self.robots,
            scale,
            modules=modules,
        )


class Rig:
    """A driving stack, and one robot of it; made by ``rig_for``."""

    def __init__(
        self, plan: RigPlan, stack: Stack, bus: Bus, links: Mapping[str, Link], arrived: list[Entry]
    ) -> None:
        self.plan = plan
        self.stack = stack
        self.bus = bus
        self.links = links  # The link of each linked service.
        self.entries: list[Entry] = []  # Everything that was observed since the last ``forget``.
        self.supervised = True  # Whether dead services are started again, as ``smal up`` does.
        self.driven = False  # Whether a new episode begins when one has ended.
        #: Rigs of the further robots of the fleet; only the ends of their episodes are observed.
        self.others: list[Rig] = []
        self.outcomes: Counter[str] = Counter()  # How the episodes ended since the last ``forget``.
        self.notes: list[str] = []
        self.seed = 100
        self.lost = 0  # How many routers of two were lost.
        self.since_s = time.monotonic()  # When the account began, monotonic seconds.
        self._armed = False
        self._arrived = arrived
        self._episode: str | None = None
        self._watch_s = self._begin_s = 0.0

    def until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Look after the stack until ``done()``, at most ``timeout_s``; return whether it is done."""
        deadline_s = time.monotonic() + timeout_s
        while not done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            time.sleep(min(_LOOK_S, left_s))
            self._look()
        return True

    def hold(self, seconds: float) -> None:
        """Let a fault last."""
        self.until(lambda: False, seconds)

    def _look(self) -> None:
        new = self._arrived[:]
        del self._arrived[: len(new)]
        self.entries += new
        for one in new:
            if one.topic == EPISODE.name and one.told["event"] == "ended":
                self.outcomes[one.told["outcome"]] += 1
                self._episode = None if one.episode == self._episode else self._episode
        if self.supervised and time.monotonic() >= self._watch_s:
            self._watch_s = time.monotonic() + WATCH_S
            if "robot" in self.stack.restart_dead():
                self._episode = None
                self._armed = False
        if self.driven and self._episode is None and time.monotonic() >= self._begin_s:
            self._begin_s = time.monotonic() + WATCH_S
            self.begin(timeout_s=30.0)
        for other in self.others:
            other._look()

    def forget(self) -> None:
        """Begin a new account; an episode that has ended meanwhile is noticed all the same."""
        self._look()
        self.entries = []
        self.notes = []
        self.since_s = time.monotonic()
        self.outcomes.clear()
        for other in self.others:
            other.forget()

    def steps(self) -> list[Step]:
        """Return what the moving base did since then."""
        return read_steps(self.plan.steps, self.since_s)

    def start_moving(self) -> None:
        """Begin an episode in which the robot moves by the commands of the policy.

        Raises
        ------
        JobError
            When it does not, from several starts.
        """
        for _ in range(_STARTS):
            self.finish_episode()
            self.forget()
            begun = self.until(lambda: self.begin(timeout_s=30.0), 30.0)
            if begun and self.until(lambda: drives(self.entries, self._episode), _MOVING_S):
                return
        raise JobError(
            f"the robot does not move, from {_STARTS} starts; see {self.plan.folder / 'logs'}"
        )

    def begin(self, timeout_s: float) -> bool:
        """Begin an episode; return whether one has begun."""
        request = ResetRequest(seed=self.seed + 1, mode=self.plan.mode)
        try:
            if not self._armed:  # as its operator does with a robot that was just started
                if self.bus.call("robot", "status", Nothing(), Status).state != "ready":
                    return False
                self._arm("not_armed")
            self._episode = self.bus.call("robot", "reset", request, ResetReply, timeout_s).episode
        except RpcError:
            return False
        self.seed += 1
        return True

    def _arm(self, cause: str | None = None) -> Detail:
        """Arm a robot that stands, for this cause or any; return what it tells of itself."""
        told = self.bus.call("robot", "status", Nothing(), Status).detail
        if told["latched_stop"] and cause in (None, told["stop_cause"]):
            self.bus.call("robot", "arm", ArmRequest(stop=int(told["latched_stop"])), Nothing)
        self._armed = True
        return told

    def moves(self) -> bool:
        """Whether the robot moves now, by the last that its actuator told."""
        return drives(self.entries, self._episode, 1)

    def ended(self) -> bool:
        """Whether no episode runs."""
        return self._episode is None

    def resume(self) -> None:
        """Arm the robot for whichever stop it stands, and have the policy go on."""
        told = self._arm()
        if told.get("episode") is not None:
            request = ResumeRequest(episode=str(told["episode"]), tick=int(told["tick"] or 0))
            self.bus.call("robot", "resume", request, Nothing)

    def end_episode(self) -> None:
        """Have the running episode end, if any."""
        if self._episode is not None:
            self._call("robot", "end", EndRequest(episode=self._episode))

    def finish_episode(self) -> None:
        """End the running episode, if any, and have its recording finished."""
        self.driven = False
        episode = self._episode
        self.end_episode()
        if not self.until(lambda: self._episode is None, 5.0):
            self.notes.append(f"the end of {episode} was not seen")
            self._episode = None
        self._call("recorder", "flush", Nothing())
        if episode is not None:  # After an outage its end may be on the way.
            self.until((self.plan.recordings / f"{episode}.mcap").exists, 5.0)
        self._look()

    def _call(self, service: str, verb: str, request: EndRequest | Nothing) -> None:
        """Call, and note a failure."""
        try:
            self.bus.call(
                service, verb, request, RecordReply if verb == "flush" else Nothing, timeout_s=15.0
            )
        except RpcError as error:
            self.notes.append(str(error))

    def status(self, service: str, timeout_s: float = 2.0) -> Status | None:
        """Ask a service how it is; None where it does not answer."""
        try:
            return self.bus.call(service, "status", Nothing(), Status, timeout_s)
        except RpcError:
            return None

    def pid(self, service: str) -> int:
        """Return a service's process id.

        Raises
        ------
        JobError
            When it does not answer.
        """
        if (status := self.status(service)) is None:
            raise JobError(f"{service} does not answer; see {self.plan.folder / 'logs'}")
        return status.pid

    def ready(self, service: str, not_pid: int) -> bool:
        """Whether a service, and not its dead predecessor, is ready."""
        status = self.status(service, timeout_s=0.3)
        return status is not None and status.state == "ready" and status.pid != not_pid


@contextmanager
def rig_for(plan: RigPlan) -> Iterator[Rig]:
    """Set everything up, and leave no process behind."""
    endpoint = ",".join(free_endpoint() for _ in range(plan.routers))
    arrived = list[Entry]()
    if plan.secure is not None:
        endpoint = endpoint.replace("tcp/127.0.0.1", "tls/localhost")
    plan.folder.mkdir(parents=True, exist_ok=True)
    plan.notes.touch()
    with ExitStack() as stacked:
        linked = (
            LINKED if plan.robot == "moving base" and plan.routers == plan.instances == 1 else ()
        )
        links = {service: stacked.enter_context(link(endpoint, batches=True)) for service in linked}
        wheels = (
            stacked.enter_context(rolling(plan.world, plan.steps))
            if plan.robot == "moving base"
            else None
        )
        stack = Stack(
            plan.stack(endpoint, {service: way.address for service, way in links.items()}, wheels)
        )
        with patch.dict(os.environ, {NOTES: str(plan.notes.resolve())}):
            stacked.enter_context(stack)
        if plan.robot != "noting":
            stacked.enter_context(closing(observer(endpoint, arrived)))
        bus = stacked.enter_context(closing(stack.settings.open_bus("operator")))
        rig = Rig(plan, stack, bus, links, arrived)
        for robot in stack.plan.fleet[1:]:
            ended: list[Entry] = []
            own = stacked.enter_context(closing(bus.of_robot(robot)))
            other = Rig(plan, stack, own, {}, ended)
            note(own, EPISODE, ended)
            other.driven = True
            other.supervised = False
            rig.others.append(other)
        yield rig


def observer(endpoint: str, arrived: list[Entry]) -> Bus:
    """Note every message that is recorded; what was missed in an outage is asked for, as the recorder does."""
    bus = Bus(ROBOT, endpoint)
    for topic in TOPICS.values():
        if topic.recorded:
            note(bus, topic, arrived)
    bus.wait_connected(30.0)
    return bus


def note(bus: Bus, topic: Topic, arrived: list[Entry]) -> None:
    def take(payload: bytes, encoding: str, *_transit: object) -> None:
        t_s = time.monotonic()
        try:
            arrived.append(Entry.of(decode(topic.message, payload, encoding), t_s, boot_ahead_s()))
        except DecodeError:
            return

    bus.subscribe(topic, take, replay=True)
