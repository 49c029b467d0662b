"""Assign the robots of a fleet to the instances of a service, without a coordinator.

- The names of the robots are known beforehand (`FleetSettings`). A name from the network is never
  served.
- An instance declares a liveliness token of Zenoh at ``smal/<fleet>/@group/<service>/<instance>``.
  For each robot that it serves, it declares another token, at that key with the robot's id behind
  it. The tokens of a killed process vanish at once, those of a frozen or disconnected process after
  `zenoh_session.LEASE_MS`.
- Rendezvous hashing over the announced instances assigns each robot to one of them: when an
  instance leaves, only its robots move. The name of an instance ends with the number of robots that
  it serves, so a fleet can grow while it drives, instance by instance.
- An instance that loses a robot first closes its node and then withdraws the token. An instance
  that gains a robot first declares its token, queries again, and opens a node if there is no other
  token. Of two instances that query, at least one sees the other, so no frame is answered twice.
  Frames that arrive in between are lost.
- An instance queries all tokens every `LOOK_S` instead of subscribing to them: this bounds the load
  by a flood of tokens.
- A token alone proves nothing: it stands while its process is frozen, and any holder of the role's
  key can declare it. So every instance queries all instances, itself included, every `ASK_S`. An
  instance counts while its last answer is not older than `ANSWER_S`, and it answers while its main
  loop runs.
- An instance without an answer of its own releases the robots that others might take.
- An answer names the robots that the instance serves. A robot that no answer names is reported by
  `/healthz`.
- A service with a state publishes it (`schemas.snapshot`). Every instance keeps the newest snapshot
  of each robot, and the node that gains the robot begins with it.
"""

import logging
import math
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from hashlib import blake2b
from typing import Final, Generic, NamedTuple, TypeVar

from prometheus_client import CollectorRegistry
from pydantic import ValidationError

from schemas.base import Strict
from schemas.codec import DecodeError, decode
from schemas.snapshot import Snapshot
from schemas.topics import KEPT_S, SNAPSHOTS, group_key, key_of
from services.kit.bus import MOVE_S
from services.kit.ending import check_memory, ends_soon
from services.kit.health import Together, ailment, serve_http, silence
from services.kit.node import LOOK_S, SNAPSHOT_S, Node
from services.kit.settings import FleetSettings, fleet
from services.kit.zenoh_session import LEASE_MS
from services.table import role_of

#: Age at which a belief is useless: the robot can have been carried elsewhere.
OLD_S: Final = 10.0
ASK_S: Final = 0.25  # Period of the queries to the other instances.
ANSWER_S: Final = 2.0  # Age of the last answer at which an instance is left out.
#: Time without an instance at which the service is unhealthy: an instance that is left out, and a
#: move.
UNSERVED_S: Final = ANSWER_S + MOVE_S
_STUCK_S: Final = 100.0  # Time limit for a node to end, after which the process ends without it.
S = TypeVar("S", bound=FleetSettings)


def share(instance: str, robots: Iterable[str], instances: Iterable[str]) -> set[str]:
    """Return the robots of an instance, among the instances that serve enough robots."""
    able = {one: int(one.rpartition("-")[2]) for one in instances}
    return {
        robot
        for number, robot in enumerate(robots, 1)
        if owner(robot, [one for one, many in able.items() if many >= number]) == instance
    }


def owner(robot: str, instances: Iterable[str]) -> str:
    """Return the instance with the highest digest together with the robot; empty without instances."""
    return max(
        instances, key=lambda one: (blake2b(f"{one}/{robot}".encode()).digest(), one), default=""
    )


class Seen(NamedTuple):
    """The announced instances, and the instances that serve each robot."""

    instances: frozenset[str]
    serving: dict[str, frozenset[str]]

    @classmethod
    def of(cls, keys: Iterable[str], prefix: str) -> "Seen":
        """Parse the keys of liveliness tokens; a key of another form is left out."""
        pattern = re.compile(
            rf"{re.escape(prefix)}/([0-9a-f]{{8}}-[1-9]\d?)(?:/([a-z0-9_-]{{1,32}}))?"
        )
        instances: set[str] = set()
        serving: dict[str, set[str]] = {}
        for match in filter(None, map(pattern.fullmatch, keys)):
            instance, robot = match.groups()
            (instances if robot is None else serving.setdefault(robot, set())).add(instance)
        return cls(
            frozenset(instances), {robot: frozenset(found) for robot, found in serving.items()}
        )

    def among(self, answering: frozenset[str]) -> "Seen":
        """Return the view restricted to instances that answer."""
        serving = {robot: instances & answering for robot, instances in self.serving.items()}
        return Seen(
            self.instances & answering,
            {robot: instances for robot, instances in serving.items() if instances},
        )


_NOTHING: Final = Seen(frozenset(), {})


class Answer(Strict):
    """Answer of an instance to the others."""

    # Robots whose nodes the instance has opened.
    robots: tuple[str, ...]


class Answers:
    """The last answer of each instance."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, frozenset[str]]] = {}

    def note(self, instance: str, robots: Iterable[str], now_s: float) -> bool:
        """Store an answer; return whether it changes the state."""
        before = self._last.get(instance)
        self._last[instance] = now_s, frozenset(robots)
        return (
            before is None or now_s - before[0] > ANSWER_S or before[1] != self._last[instance][1]
        )

    def answering(self, now_s: float) -> frozenset[str]:
        """Return the instances whose last answer is recent, and drop the others."""
        self._last = {
            one: answer for one, answer in self._last.items() if now_s - answer[0] <= ANSWER_S
        }
        return frozenset(self._last)

    def served(self) -> frozenset[str]:
        """Return the robots that the answers name."""
        return frozenset().union(*(robots for _, robots in self._last.values()))


class _Kept(NamedTuple):
    """Snapshot as received."""

    payload: bytes
    encoding: str
    arrived_s: float


class _Served:
    """Robot that is assigned to this instance: first its token, later a thread with its node."""

    def __init__(self, go: Callable[[], None]) -> None:
        self.go = go
        self.since_s = time.monotonic()
        self.node: Node | None = None
        self.thread: threading.Thread | None = None
        self.leaving = False

    def leave(self) -> bool:
        """Ask the node to end; return whether it has ended and its token is withdrawn."""
        self.leaving = True
        if self.node is not None:
            self.node.stop()
        if self.thread is not None and self.thread.is_alive():
            return False
        go = self.go
        self.go = lambda: None
        go()
        return True


class Group(Generic[S]):
    """Instance of a service that runs a node for each of its robots, by ``serve``, until stopped.

    Raises
    ------
    BusError
        Without a router, or if a lane stays deaf.
    JobError
        If a node fails.
    """

    def __init__(self, name: str, settings: S, serve: Callable[[Node, S], None]) -> None:
        self._name = name
        self._settings = settings
        self._serve = serve
        self.log = logging.getLogger(name)
        self.instance = f"{secrets.token_hex(4)}-{settings.robots}"
        self.robots = fleet(settings.robot, settings.robots)
        self._prefix = group_key(settings.robot, name)
        self._seen = _NOTHING  # The tokens at the last query.
        self._thawed_s = -math.inf  # End of the last freeze.
        self._served: dict[str, _Served] = {}
        self._kept: dict[str, _Kept] = {}
        self._failure: Exception | None = None
        self._here = self._others = self._stopped = False
        self._ending = False
        self._answers = Answers()
        self._answering: frozenset[str] = frozenset()
        self._answered = threading.Lock()  # Held to store an answer and to read all answers.
        self._looked_s = self._asked_s = -math.inf
        # Time at which each robot was last served by an instance.
        self._served_s = dict.fromkeys(self.robots, math.inf)
        # Time at which another instance last served each robot.
        self._elsewhere_s: dict[str, float] = {}
        self._news = threading.Event()
        self._ended = threading.Event()
        self._looking = threading.Thread(target=self._keep_looking, name="tokens", daemon=True)

    def run(self) -> None:
        """Serve until stopped."""
        http = None
        with ExitStack() as closing_last:
            closing_last.callback(self._join_looking)
            self._bus = closing_last.enter_context(
                closing(self._settings.open_bus(role_of(self._name)))
            )
            try:
                if self._settings.http is not None:
                    http = serve_http(
                        self._settings.http, self._ailment, Together(self._registries).registry
                    )
                self._keep_snapshots(closing_last)
                self._looked_s = time.monotonic()
                self._served_s = dict.fromkeys(self.robots, self._looked_s)
                self._bus.answer(f"{self._prefix}/{self.instance}", self._tell)
                go = self._bus.stand(f"{self._prefix}/{self.instance}")
                self._looking.start()
                closing_last.callback(self._ended.set)
                try:
                    with ends_soon():
                        self._serve_until_stopped()
                finally:
                    go()  # First, so that the next instance learns of it at once.
            finally:
                self._end()
                if http is not None:
                    http.shutdown()
                    http.server_close()

    def _serve_until_stopped(self) -> None:
        while not self._stopped and self._failure is None:
            self._bus.check()
            check_memory()
            if time.monotonic() - self._looked_s > LEASE_MS / 1000.0:
                # After so long a freeze the others consider this instance dead, and its view is
                # outdated.
                self._seen = _NOTHING
                self._thawed_s = time.monotonic()
            self._looked_s = time.monotonic()
            self._ask()
            self._look_at_answers()
            self._settle(self._seen)
            self._news.wait(LOOK_S)
            self._news.clear()
        if self._failure is not None:
            raise self._failure

    def _keep_looking(self) -> None:
        """Query the tokens of all instances periodically, on a separate thread."""
        while not self._ended.wait(LOOK_S):
            began_s = time.monotonic()
            seen = Seen.of(self._bus.look(f"{self._prefix}/**", ANSWER_S), self._prefix)
            if began_s < self._thawed_s:
                continue
            changed = seen.among(self._answering) != self._seen.among(self._answering)
            self._seen = seen
            if changed:
                self._news.set()

    def _join_looking(self) -> None:
        """Wait for the querying thread; closing the bus ends its query, even at a frozen router."""
        if self._looking.ident is not None:
            self._looking.join()

    # -- proof of life -----------------------------------------------------------------------------

    def _tell(self) -> Answer | None:
        """Answer another instance, while the main loop runs or the nodes end."""
        if not self._ending and time.monotonic() - self._looked_s > ANSWER_S:
            return None
        served = [*self._served.items()]
        return Answer(
            robots=tuple(robot for robot, one in served if one.node is not None and not one.leaving)
        )

    def _ask(self) -> None:
        """Query all instances, this one included, for the robots that they serve."""
        if self._looked_s - self._asked_s >= ASK_S:
            self._asked_s = self._looked_s
            self._bus.ask(f"{self._prefix}/*", self._take_answer, ANSWER_S)

    def _take_answer(self, key: str, payload: bytes) -> None:
        try:
            answer = Answer.model_validate_json(payload)
        except ValidationError:
            return
        for instance in Seen.of([key], self._prefix).instances:
            with self._answered:
                changed = self._answers.note(instance, answer.robots, time.monotonic())
            if changed:
                self._news.set()

    def _look_at_answers(self) -> None:
        """Store which instances answer, and when each robot was served."""
        now_s = time.monotonic()
        with self._answered:
            self._answering = self._answers.answering(now_s)
            served = self._answers.served()
        self._served_s |= {robot: now_s for robot in self.robots if robot in served}

    def stop(self) -> None:
        """Make ``run`` return soon; takes no lock."""
        self._stopped = True

    def _settle(self, announced: Seen) -> None:
        """Release the robots of other instances, and take the own robots that the others released."""
        seen = announced.among(self._answering)
        self._here = here = self.instance in seen.instances
        others = {robot for robot, serving in seen.serving.items() if serving - {self.instance}}
        self._elsewhere_s |= dict.fromkeys(others, time.monotonic())
        if here:
            self._others = len(seen.instances) > 1
        wanted = self._wanted(seen)
        for robot, served in [*self._served.items()]:
            if (robot not in wanted or served.leaving) and served.leave():
                del self._served[robot]
        for robot in sorted(wanted - others):
            if robot not in self._served:
                token = self._bus.stand(f"{self._prefix}/{self.instance}/{robot}")
                self._served[robot] = _Served(token)
            elif robot in seen.serving:
                self._take(robot, announced.serving[robot] == {self.instance})

    def _wanted(self, seen: Seen) -> set[str]:
        """Return the robots that this instance serves once the others release them."""
        if self._here:
            return share(self.instance, self.robots, seen.instances)
        # No other instance can be queried. A lone instance continues: its robot does not wait for
        # the router.
        return set() if self._others else set(self._served)

    def _take(self, robot: str, alone: bool) -> None:
        """Open a robot that the others have released."""
        mine = self._served[robot]
        if mine.thread is not None or not self._handed_on(robot):
            return
        # An instance that is announced here and does not answer yet can serve the robot.
        if alone or time.monotonic() - mine.since_s > ANSWER_S:
            self._open(robot, mine)

    def _open(self, robot: str, served: _Served) -> None:
        settings = self._settings.of_robot(robot)

        def work() -> None:
            try:
                with Node(self._name, settings, bus=self._bus, instance=self.instance) as node:
                    node.inherited = self._inherited(robot)
                    # So that an idle robot costs almost nothing.
                    node.every(KEPT_S, node.bus.forget)
                    served.node = node
                    if not served.leaving:
                        self._serve(node, settings)
            except Exception as error:  # noqa: BLE001 - it ends the process, by its main thread
                self._failure = error
            finally:
                self._news.set()

        served.thread = threading.Thread(target=work, name=f"{self._name} of {robot}", daemon=True)
        served.thread.start()
        self.log.info("instance %s serves %s", self.instance, robot)

    def _end(self) -> None:
        """End all nodes, and withdraw all tokens."""
        self._ending = True
        until_s = time.monotonic() + _STUCK_S
        for served in self._served.values():
            served.leave()
        for served in self._served.values():
            if served.thread is not None:
                served.thread.join(max(0.0, until_s - time.monotonic()))
            served.leave()

    def _handed_on(self, robot: str) -> bool:
        """Return whether a robot's snapshot has arrived, by another link than the tokens."""
        since_s = time.monotonic() - self._elsewhere_s.get(robot, -math.inf)
        return self._name not in SNAPSHOTS or robot in self._kept or since_s > 2.0 * SNAPSHOT_S

    # -- snapshots ---------------------------------------------------------------------------------

    def _keep_snapshots(self, until: ExitStack) -> None:
        topics = [SNAPSHOTS[self._name]] if self._name in SNAPSHOTS else []
        for robot, topic in ((robot, topic) for robot in self.robots for topic in topics):

            def keep(
                payload: bytes, encoding: str, _transit_s: float | None, robot: str = robot
            ) -> None:
                self._kept[robot] = _Kept(payload, encoding, time.monotonic())
                self._news.set()

            until.enter_context(closing(self._bus.of_robot(robot))).subscribe(topic, keep)

    def _inherited(self, robot: str) -> Snapshot | None:
        """Return the valid snapshot of a robot without an outdated belief, or None."""
        kept = self._kept.get(robot)
        if kept is None:
            return None
        try:
            snapshot: Snapshot = decode(Snapshot, kept.payload, kept.encoding)
            if key_of(snapshot) != SNAPSHOTS[self._name].key(robot):
                raise DecodeError(f"it belongs to {snapshot.robot} and {snapshot.service}")
        except DecodeError as error:
            self.log.warning("the snapshot of %s is refused: %s", robot, error)
            return None
        old = time.monotonic() - kept.arrived_s > OLD_S
        return snapshot.model_copy(update={"state": None}) if old else snapshot

    # -- health ------------------------------------------------------------------------------------

    def _nodes(self) -> list[Node]:
        return [
            served.node
            for served in [*self._served.values()]
            if served.node is not None and not served.leaving
        ]

    def _registries(self) -> list[CollectorRegistry]:
        return [node.metrics.registry for node in self._nodes()]

    def _ailment(self) -> str | None:
        """Return the first fault: a silent link, a robot without an instance, or an unhealthy node."""
        if silent := self._bus.silent():
            return silence(silent)
        longest_s = time.monotonic() - UNSERVED_S
        unserved = [robot for robot, served_s in [*self._served_s.items()] if served_s < longest_s]
        if unserved:
            return f"{unserved[0]}: served by no instance"
        if not self._here or any(served.node is None for served in [*self._served.values()]):
            return "starting"
        found = ((node.robot, ailment(node.status())) for node in self._nodes())
        return next((f"{robot}: {what}" for robot, what in found if what is not None), None)
