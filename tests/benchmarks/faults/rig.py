"""A stack that drives, an observer beside it, and the hands that do harm to it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from unittest.mock import patch

from schemas.rpc import ArmRequest, EndRequest, Nothing, RecordReply, ResetReply, ResetRequest, ResumeRequest, Status
from schemas.topics import EPISODE
from services.cli.stack.processes import Stack, StackPlan, flags, free_endpoint
from services.cli.up import WATCH_S
from services.kit.bus import Bus, RpcError
from services.kit.errors import JobError
from services.kit.node import Detail
from services.table import stack_services
from tests.benchmarks.faults.judge import moving
from tests.benchmarks.faults.log import Entry, Step, Tail, boot_ahead_s, read_steps
from tests.benchmarks.faults.observer import observing
from tests.benchmarks.faults.proxy import link
from tests.benchmarks.faults.stop import NOTES, Stop
from tests.benchmarks.faults.track import Track, tracks
from tests.benchmarks.faults.wheels import rolling

ROBOT: Final = "faulty"
WORLD: Final = "yard"
CAMERA: Final = (160, 120)
_LOOK_S: Final = 0.02
_MOVING_S: Final = 12.0
_STARTS: Final = 5


@dataclass(frozen=True)
class RigPlan:
    """What to set up.

    Parameters
    ----------
    model : Path
    folder : Path
        New folder for log, recordings and the services' logs.
    linked : tuple of str
        Services whose way to the router is a link that can go down.
    environment : dict of str to str
        More environment of the services.
    rolling : bool
        Whether the robot's base is a process of its own, which moves on in real time whatever is harmed.
    console : str
        Where the page is, host and port.
    flooded : bool
        Whether the bus is flooded: the robot notes its stops, and nobody observes, who would only be flooded as well.
    secure : Path, optional
        Folder of certificates.
    """

    model: Path
    folder: Path
    linked: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    rolling: bool = False
    console: str = "127.0.0.1:0"
    flooded: bool = False
    secure: Path | None = None

    @property
    def modules(self) -> dict[str, str]:
        """What runs in place of services of the stack."""
        own = "robot" if self.rolling else "noting" if self.flooded else None
        return {} if own is None else {"robot": f"tests.benchmarks.faults.{own}"}

    @property
    def notes(self) -> Path:
        """What the robot of a flooded stack notes of its stops."""
        return self.folder / "stops.jsonl"

    @property
    def recordings(self) -> Path:
        """Folder of the recordings."""
        return self.folder / "recordings"

    @property
    def log(self) -> Path:
        """The observer's log."""
        return self.folder / "observer.jsonl"

    @property
    def steps(self) -> Path:
        """The moving base's log."""
        return self.folder / "steps.jsonl"

    def service_flags(self, links: Mapping[str, str], wheels: str | None = None) -> dict[str, tuple[str, ...]]:
        """Return the services' flags, with the addresses of the links and of the moving base."""
        chain = flags(model=self.model.resolve())
        own = {
            "robot": flags(world=WORLD, camera_width=CAMERA[0], camera_height=CAMERA[1], wheels=wheels),
            "recognition": chain,
            "policy": chain,
            "recorder": flags(recordings=self.recordings.resolve()),
            "console": flags(console=self.console, root=self.folder.resolve()),
        }
        return {name: own.get(name, ()) + flags(router=links.get(name)) for name in stack_services()}


class Rig:
    """A driving stack; made by ``rig_for``.

    Parameters
    ----------
    plan : RigPlan
    stack : Stack
    bus : Bus
        For calls.
    tail : Tail
        Of the observer's log.
    links : dict of str to int
        Process id of the link of each linked service.
    """

    def __init__(self, plan: RigPlan, stack: Stack, bus: Bus, tail: Tail, links: Mapping[str, int]) -> None:
        self.plan, self.stack, self.bus, self.links = plan, stack, bus, links
        #: Everything that was seen since the last ``forget``.
        self.entries: list[Entry] = []
        #: Whether dead services are started again, as ``smal up`` does.
        self.supervised = True
        #: Whether a new episode begins when one has ended.
        self.driven = False
        self.notes: list[str] = []
        #: What became of each emergency stop that was sent while the bus was flooded.
        self.stops: list[Stop] = []
        self.seed = 100
        #: How many episodes have begun.
        self.begun = 0
        #: When the account began, monotonic seconds.
        self.since_s = time.monotonic()
        self._armed = False
        self._tail = tail
        self._episode: str | None = None
        self._watch_s = self._begin_s = 0.0

    # -- time -----------------------------------------------------------------------------------------------------

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
        new = self._tail.read()
        self.entries += new
        for one in new:
            if one.topic == EPISODE.name and one.told["event"] == "ended" and one.episode == self._episode:
                self._episode = None
        if self.supervised and time.monotonic() >= self._watch_s:
            self._watch_s = time.monotonic() + WATCH_S
            if "robot" in self.stack.restart_dead():
                self._episode, self._armed = None, False
        if self.driven and self._episode is None and time.monotonic() >= self._begin_s:
            self._begin_s = time.monotonic() + WATCH_S
            self.begin(timeout_s=30.0)

    # -- driving --------------------------------------------------------------------------------------------------

    def forget(self) -> None:
        """Begin a new account; an episode that has ended meanwhile is noticed all the same."""
        self._look()
        self.entries, self.notes, self.since_s = [], [], time.monotonic()

    def tracks(self) -> list[Track]:
        """Return what was seen since then, by episode."""
        return tracks(self.entries, -boot_ahead_s() if self.plan.rolling else None)

    def steps(self) -> list[Step]:
        """Return what the moving base did since then; nothing without one."""
        return read_steps(self.plan.steps, self.since_s) if self.plan.rolling else []

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
            if self.until(lambda: self.begin(timeout_s=30.0), 30.0) and self.until(self._moves, _MOVING_S):
                return
        raise JobError(f"the robot does not move, from {_STARTS} starts; see {self.plan.folder / 'logs'}")

    def _moves(self) -> bool:
        mine = [one for one in self.entries if one.episode == self._episode]
        return bool(mine) and moving(Track(mine[0].episode, mine))

    def begin(self, timeout_s: float) -> bool:
        """Begin an episode; return whether one has begun."""
        request = ResetRequest(seed=self.seed + 1, mode="realtime")
        try:
            self._arm()
            self._episode = self.bus.call("robot", "reset", request, ResetReply, timeout_s).episode
        except RpcError:
            return False
        self.seed += 1
        self.begun += 1
        return True

    def _arm(self) -> None:
        """Arm a robot that was just started, as its operator does, who knows of that; for nothing else it is armed."""
        if self._armed:
            return
        detail = self.bus.call("robot", "status", Nothing(), Status).detail
        if detail["stop_cause"] == "not_armed":
            self.bus.call("robot", "arm", ArmRequest(stop=int(detail["emergency_stop"] or 0)), Nothing)
        self._armed = True

    def resume(self) -> None:
        """Arm the robot for which stop it may stand, and have the policy go on."""
        told = self.detail()
        if told.get("emergency_stop"):
            self.bus.call("robot", "arm", ArmRequest(stop=int(told["emergency_stop"] or 0)), Nothing)
        if told.get("episode") is not None:
            request = ResumeRequest(episode=str(told["episode"]), tick=int(told["tick"] or 0))
            self.bus.call("robot", "resume", request, Nothing)

    def end_episode(self) -> None:
        """Have the running episode end, if any."""
        if self._episode is None:
            return
        try:
            self.bus.call("robot", "end", EndRequest(episode=self._episode), Nothing)
        except RpcError as error:
            self.notes.append(str(error))

    def finish_episode(self) -> None:
        """End the running episode, if any, and have its recording finished."""
        self.driven = False
        episode = self._episode
        self.end_episode()
        if not self.until(lambda: self._episode is None, 5.0):
            self.notes.append(f"the end of {episode} was not seen")
            self._episode = None
        try:
            self.bus.call("recorder", "flush", Nothing(), RecordReply, timeout_s=15.0)
        except RpcError as error:
            self.notes.append(str(error))
        self._look()

    # -- services -------------------------------------------------------------------------------------------------

    def status(self, service: str, timeout_s: float = 2.0) -> Status | None:
        """Ask a service how it is; None where it does not answer."""
        try:
            return self.bus.call(service, "status", Nothing(), Status, timeout_s)
        except RpcError:
            return None

    def detail(self) -> Detail:
        """Return what the robot tells of itself; nothing where it does not answer."""
        status = self.status("robot")
        return {} if status is None else status.detail

    def pid(self, service: str) -> int:
        """Return a service's process id.

        Raises
        ------
        JobError
            When it does not answer.
        """
        status = self.status(service)
        if status is None:
            raise JobError(f"{service} does not answer; see {self.plan.folder / 'logs'}")
        return status.pid

    def ready(self, service: str, not_pid: int = 0) -> bool:
        """Whether a service, and not its dead predecessor, is ready."""
        status = self.status(service, timeout_s=0.3)
        return status is not None and status.state == "ready" and status.pid != not_pid


@contextmanager
def rig_for(plan: RigPlan) -> Iterator[Rig]:
    """Set everything up, and leave no process behind."""
    endpoint = free_endpoint()
    if plan.secure is not None:
        endpoint = endpoint.replace("tcp/127.0.0.1", "tls/localhost")
    plan.folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stacked:
        links = {service: stacked.enter_context(link(endpoint)) for service in plan.linked}
        wheels = stacked.enter_context(rolling(WORLD, plan.steps)) if plan.rolling else None
        service_flags = plan.service_flags({service: address for service, (address, _) in links.items()}, wheels)
        stack = Stack(
            StackPlan(stack_services(), ROBOT, endpoint, service_flags, plan.secure, plan.folder / "logs", plan.modules)
        )
        with patch.dict(os.environ, {**plan.environment, NOTES: str(plan.notes.resolve())}):
            stacked.enter_context(stack)
        if plan.flooded:
            plan.log.touch()
            plan.notes.write_text("")
        else:
            stacked.enter_context(observing(ROBOT, endpoint, plan.log))
        bus = stacked.enter_context(closing(stack.settings.open_bus("operator")))
        tail = stacked.enter_context(closing(Tail(plan.log)))
        yield Rig(plan, stack, bus, tail, {service: pid for service, (_, pid) in links.items()})
