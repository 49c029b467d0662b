"""A service with several instances: how robots are assigned when an instance joins or leaves."""

import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas import topics
from schemas.array import Float32Array
from schemas.base import Message
from schemas.codec import decode
from schemas.observation import Observation
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import State
from services.cli.stack import free_endpoint
from services.features.__main__ import serve
from services.features.service import FeaturesSettings
from services.kit.bus import MOVE_S, Bus
from services.kit.group import ANSWER_S, Answer, Answers, Group, Seen, owner, share
from services.kit.node import LOOK_S
from services.kit.settings import MAX_ROBOTS, FleetSettings, fleet
from smal.features import extract
from tests import corridor
from tests.places import estimate
from tests.schemas.messages import EXAMPLES
from tests.services.chain import image, process, seen, wheels
from tests.services.waiting import eventually, health, stalls, status_of

NAMES = st.from_regex(r"[0-9a-f]{8}", fullmatch=True)
INSTANCES = st.sets(NAMES, min_size=1, max_size=9)
ROBOTS = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)
PREFIX = "smal/rescuebot/@group/features"


@settings(max_examples=30)
@given(INSTANCES, ROBOTS)
def test_robot_has_one_owner(instances: set[str], robot: str) -> None:
    assert owner(robot, instances) in instances
    assert owner(robot, sorted(instances)) == owner(robot, sorted(instances, reverse=True))


@settings(max_examples=30)
@given(INSTANCES, st.sets(ROBOTS, max_size=20), st.data())
def test_where_an_instance_leaves_its_robots_alone_move(
    instances: set[str], robots: set[str], data: st.DataObject
) -> None:
    before = {robot: owner(robot, instances) for robot in robots}
    gone = data.draw(st.sampled_from(sorted(instances)))
    for robot, whose in before.items() if len(instances) > 1 else ():
        after = owner(robot, instances - {gone})
        assert whose in (after, gone)
        assert after != gone


@settings(max_examples=30)
@given(st.dictionaries(NAMES, st.integers(1, MAX_ROBOTS), min_size=1, max_size=9))
def test_robots_are_shared_among_the_instances_that_serve_them(counts: dict[str, int]) -> None:
    instances = {f"{one}-{many}": many for one, many in counts.items()}
    shares = [share(one, fleet("rescuebot", many), instances) for one, many in instances.items()]
    assert sorted(robot for each in shares for robot in each) == sorted(
        fleet("rescuebot", max(counts.values()))
    )


def test_instances_get_about_as_many_robots() -> None:
    instances = [f"{number:08x}" for number in range(4)]
    counts = Counter(owner(f"robot-{number}", instances) for number in range(1000))
    assert min(counts.values()) > 200


@given(st.lists(st.text(max_size=40)))
def test_tokens_of_another_form_are_left_out(rests: list[str]) -> None:
    tokens = {f"{PREFIX}/0123abcd-2", f"{PREFIX}/0123abcd-2/rescuebot-2"}
    wrong = (*rests, "*", "0123abcd-2/**", "0123ABCD-2", "0123abcd-2/r/s", "0123abcd-0")
    found = Seen.of(
        {*tokens, *(f"{PREFIX}/{rest}" for rest in wrong), "smal/other/@group/features/0123abcd-2"},
        PREFIX,
    )
    assert found == (frozenset({"0123abcd-2"}), {"rescuebot-2": frozenset({"0123abcd-2"})})


def test_a_fleet_is_bounded_and_its_names_are_robots() -> None:
    assert fleet("rescuebot", 3) == ("rescuebot", "rescuebot-2", "rescuebot-3")
    with pytest.raises(ValueError, match=f"less than or equal to {MAX_ROBOTS}"):
        FleetSettings(robots=1000)
    with pytest.raises(ValueError, match=f"invalid robot id '{'r' * 31}-2': must match"):
        FleetSettings(robot="r" * 31, robots=2)


def test_an_instance_counts_while_its_answers_are_recent() -> None:
    answers = Answers()
    assert answers.note("a-1", ["rescuebot"], 10.0)
    assert not answers.note("a-1", ["rescuebot"], 11.0)
    assert answers.note("a-1", [], 11.5)
    answers.note("b-1", ["rescuebot"], 13.0)
    assert answers.answering(11.5 + ANSWER_S) == {"a-1", "b-1"}
    assert answers.answering(11.6 + ANSWER_S) == {"b-1"}
    assert answers.served() == {"rescuebot"}
    assert answers.answering(14.0 + ANSWER_S) == set()
    assert answers.served() == set()


class Robots:
    """Robots of a fleet: each publishes what it is told to, and counts the answers by robot and frame."""

    def __init__(
        self, client: Bus, names: tuple[str, ...], topic: topics.Topic, stack: ExitStack
    ) -> None:
        self.buses = {name: stack.enter_context(closing(client.of_robot(name))) for name in names}
        self.answers: Counter[tuple[str, int]] = Counter()
        self.newest: dict[str, Message] = {}
        for name, bus in self.buses.items():

            def take(
                payload: bytes, encoding: str, _transit_s: float | None, name: str = name
            ) -> None:
                self.newest[name] = message = decode(topic.message, payload, encoding)
                self.answers[name, message.tick] += 1

            bus.subscribe(topic, take)

    def send(self, *messages: Message) -> None:
        """Have each robot publish messages as its own."""
        for name, bus in self.buses.items():
            for message in messages:
                bus.publish(message.model_copy(update={"robot": name}))

    def insist(self, *messages: Message) -> None:
        """Have each robot publish messages until it is answered."""

        def answered() -> bool:
            self.send(*messages)
            time.sleep(0.05)
            return all(self.answers[name, messages[-1].tick] for name in self.buses)

        eventually(answered)

    def instances(self, service: str) -> dict[str, str]:
        """Return which instance answers for each robot that has one."""
        found = {name: status_of(bus, service) for name, bus in self.buses.items()}
        return {
            name: str(status.detail["instance"])
            for name, status in found.items()
            if status and status.state == "ready"
        }

    def served_by(self, service: str, many: int) -> dict[str, str]:
        """Wait until all robots are served by this number of instances."""

        def all_served() -> dict[str, str] | None:
            found = self.instances(service)
            return (
                found if len(found) == len(self.buses) and len({*found.values()}) == many else None
            )

        return eventually(all_served)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def start(
    stack: ExitStack, service: str, endpoint: str, robots: int, *flags: str
) -> subprocess.Popen[str]:
    return stack.enter_context(process(service, endpoint, "--robots", str(robots), *flags))


def run_here(stack: ExitStack, instance: Group[Any]) -> None:
    """Run an instance in this process."""
    thread = threading.Thread(target=instance.run)
    thread.start()
    stack.callback(thread.join)
    stack.callback(instance.stop)


def features(endpoint: str, http: str) -> Group[FeaturesSettings]:
    """Return an instance of features for one robot, which reports its health."""
    return Group("features", FeaturesSettings(router=endpoint, http=http), serve)


#: So many that each of three instances has some, but for one time in a thousand.
MANY = 20


def test_no_frame_is_answered_twice_while_instances_come_and_go(
    client: Bus, router_endpoint: str, stack: ExitStack
) -> None:
    robots = Robots(client, fleet("rescuebot", MANY), topics.OBSERVATION, stack)
    start(stack, "features", router_endpoint, MANY)
    robots.served_by("features", 1)
    tick = 0
    ended = threading.Event()

    def drive() -> None:
        nonlocal tick
        while not ended.wait(0.2):
            robots.send(image(tick, tick % 50))
            tick += 1

    driving = threading.Thread(target=drive)
    driving.start()
    stack.callback(ended.set)
    with process("features", router_endpoint, "--robots", str(MANY)) as second:
        served = robots.served_by("features", 2)
        with process("features", router_endpoint, "--robots", str(MANY)):
            robots.served_by("features", 3)
            second.terminate()
            second.wait(100.0)
            robots.served_by("features", 2)
        # It has ended as well.
        assert {*robots.served_by("features", 1).values()} < {*served.values()}
    since = tick
    eventually(
        lambda: all(
            any(robots.answers[name, at] for at in range(since, tick)) for name in robots.buses
        )
    )
    ended.set()
    driving.join()
    assert max(robots.answers.values()) == 1


def nothing_seen(tick: int) -> Observation:
    """Return the observation of a grey picture, which tells nothing about the position."""
    vector = extract(
        np.full((corridor.HEIGHT, corridor.WIDTH, 3), 128, np.uint8), corridor.FEATURES
    )
    return seen(tick).model_copy(update={"features": Float32Array.from_numpy(vector)})


def test_robots_keep_their_belief_when_an_instance_is_killed(
    client: Bus, router_endpoint: str, stack: ExitStack, model: Path
) -> None:
    names = fleet("rescuebot", MANY)
    robots = Robots(client, names, topics.STATE, stack)
    handed = Robots(client, names, topics.SNAPSHOTS["recognition"], stack)
    flags = ["--root", str(model.parent)]
    start(stack, "recognition", router_endpoint, MANY, *flags)
    command = [
        sys.executable, "-m", "services.recognition", "--router", router_endpoint, "--robots",
        str(MANY), *flags,
    ]  # fmt: skip
    first = stack.enter_context(subprocess.Popen(command))
    stack.callback(first.kill)
    served = robots.served_by("recognition", 2)
    for bus in robots.buses.values():
        bus.call("recognition", "load", LoadRequest(model=model.name), LoadReply)
    robots.insist(wheels(0), seen(0))  # Until each is heard.
    for tick in range(1, 9):
        robots.send(wheels(tick), seen(tick))
        eventually(lambda tick=tick: all(robots.answers[name, tick] for name in names))
    # Each has told what is to be handed on of the last frame.
    eventually(lambda: all(handed.answers[name, 8] for name in names))
    pids = {
        name: status.pid
        for name, bus in robots.buses.items()
        if (status := status_of(bus, "recognition"))
    }
    moving = {name for name, pid in pids.items() if pid == first.pid}
    assert 0 < len(moving) < MANY
    first.kill()
    (stays,) = {*robots.served_by("recognition", 1).values()}
    assert {name for name, instance in served.items() if instance == stays} == {*names} - moving
    # On by 0.6 m, by the wheels alone: from nothing it would not know where it is.
    robots.insist(wheels(11), nothing_seen(11))
    assert max(many for (_, tick), many in robots.answers.items() if 0 < tick < 11) == 1
    for name in names:
        state = robots.newest[name]
        assert estimate(state) == pytest.approx((2.2, 0.0), abs=0.2), name
        assert state.tracked_m == pytest.approx(2.2, abs=0.3), name


def test_idle_robot_forgets_its_samples(
    client: Bus, router_endpoint: str, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = client.of_robot("rescuebot")
    ticks = list[int]()
    robot.publish(EXAMPLES[State].model_copy(update={"tick": 1}))
    with monkeypatch.context() as later:
        later.setattr("services.kit.bus.KEPT_S", 0.0)
        robot.forget()
    recorder = stack.enter_context(closing(Bus("rescuebot", router_endpoint)))
    recorder.subscribe(topics.STATE, lambda payload, coding, _: ticks.append(decode(State, payload, coding).tick),
                       replay=True)  # fmt: skip

    def heard() -> bool:
        robot.publish(EXAMPLES[State].model_copy(update={"tick": 2}))
        return bool(ticks)

    eventually(heard)
    assert {*ticks} == {2}
    robot.close()


def test_a_process_tells_the_health_of_all_its_robots(
    client: Bus, router_endpoint: str, stack: ExitStack
) -> None:
    address = free_endpoint().removeprefix("tcp/")
    start(stack, "features", router_endpoint, 2, "--http", address)
    robots = Robots(client, fleet("rescuebot", 2), topics.OBSERVATION, stack)
    robots.served_by("features", 1)
    robots.insist(image(0))

    def get(path: str) -> str:
        with urlopen(f"http://{address}/{path}") as answer:
            return str(answer.read().decode())

    eventually(lambda: get("healthz") == "ok\n")
    metrics = get("metrics")
    assert metrics.count("# TYPE smal_messages_received_total counter") == 1
    for name in robots.buses:
        line = f'smal_messages_received_total{{robot="{name}",service="features",topic="camera/jpeg"}} '
        assert float(metrics.partition(line)[2].split()[0]) >= 1.0
    assert metrics.count("\nprocess_cpu_seconds_total ") == 1


def test_frozen_instance_loses_its_robots_and_old_answers(
    client: Bus, router_endpoint: str, stack: ExitStack
) -> None:
    robots = Robots(client, fleet("rescuebot", MANY), topics.OBSERVATION, stack)
    first = start(stack, "features", router_endpoint, MANY)
    start(stack, "features", router_endpoint, MANY)
    robots.served_by("features", 2)
    robots.insist(image(0))
    first.send_signal(signal.SIGSTOP)
    try:
        robots.send(image(1))
        robots.served_by("features", 1)
        robots.insist(image(2))
        robots.send(image(3))
        eventually(lambda: all(robots.answers[name, 3] for name in robots.buses))
    finally:
        first.send_signal(signal.SIGCONT)
    robots.served_by("features", 2)
    robots.insist(image(4))
    assert {robots.answers[name, 3] for name in robots.buses} == {1}
    assert {robots.answers[name, 1] for name in robots.buses} == {
        0,
        1,
    }  # Those of the frozen one are nobody's.


def stronger_than(instance: str) -> str:
    """Return the name of an instance that the hashing prefers for the first robot."""
    names = (f"{number:08x}-1" for number in range(1_000_000))
    return next(name for name in names if owner("rescuebot", [name, instance]) == name)


def test_an_announcement_does_not_take_a_robot(
    client: Bus, router_endpoint: str, stack: ExitStack
) -> None:
    address = free_endpoint().removeprefix("tcp/")
    robots = Robots(client, ("rescuebot",), topics.OBSERVATION, stack)
    stolen = "00000000-1"
    for key in (
        stolen,
        f"{stolen}/rescuebot",
    ):  # Announced before the real instance comes, it also claims the robot.
        stack.callback(client.stand(f"{PREFIX}/{key}"))
    run_here(stack, features(router_endpoint, address))
    (instance,) = robots.served_by("features", 1).values()
    robots.insist(image(0))
    lost_s = stack.enter_context(stalls())
    stack.callback(client.stand(f"{PREFIX}/{stronger_than(instance)}"))
    began_s = time.monotonic()
    tick = 1
    while time.monotonic() < began_s + ANSWER_S + MOVE_S:
        robots.insist(image(tick))
        tick += 1
    assert time.monotonic() - began_s - lost_s(began_s) < 2.0 * (ANSWER_S + MOVE_S)
    assert robots.instances("features") == {"rescuebot": instance}
    eventually(lambda: health(address) == "ok\n")


class Looking(Group[FleetSettings]):
    """An instance that counts how often it looks at the announcements."""

    looks = 0

    def _settle(self, announced: Seen) -> None:
        self.looks += 1
        super()._settle(announced)


def test_a_flood_of_announcements_keeps_no_instance_busy(
    client: Bus, router_endpoint: str, stack: ExitStack
) -> None:
    instance = Looking(
        "features", FleetSettings(router=router_endpoint), lambda _node, _settings: None
    )
    run_here(stack, instance)
    eventually(lambda: instance.instance in instance._answering)
    before = instance.looks
    began_s = time.monotonic()
    for number in range(300):
        stack.callback(client.stand(f"{PREFIX}/{number:08x}-1"))
    eventually(lambda: len(instance._seen.instances) == 301)
    assert instance.looks - before <= (time.monotonic() - began_s) / LOOK_S + 3


def test_a_robot_that_no_instance_serves_is_reported(
    client: Bus, router_endpoint: str, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.kit.group.UNSERVED_S", 1.0)
    address = free_endpoint().removeprefix("tcp/")
    robots = Robots(client, ("rescuebot",), topics.OBSERVATION, stack)
    run_here(stack, features(router_endpoint, address))
    (instance,) = robots.served_by("features", 1).values()
    eventually(lambda: health(address) == "ok\n")
    # A thief of the role's key who answers as well is an instance; it serves nothing.
    key = f"{PREFIX}/{stronger_than(instance)}"
    thief = stack.enter_context(closing(Bus("rescuebot", router_endpoint)))
    thief.answer(key, lambda: Answer(robots=()))
    go = thief.stand(key)
    eventually(lambda: health(address) == "rescuebot: served by no instance\n")
    go()
    eventually(lambda: health(address) == "ok\n")
    robots.insist(image(1))


class FrozenBus(Bus):
    """A bus whose router answers no query for tokens until the bus is closed."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.asked = threading.Event()
        self.closed = threading.Event()

    def look(self, keys: str, timeout_s: float) -> frozenset[str]:
        self.asked.set()
        self.closed.wait(100.0)
        return frozenset()

    def close(self) -> None:
        super().close()
        self.closed.set()


def test_an_instance_ends_when_its_router_is_frozen(
    router_endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = FrozenBus("rescuebot", router_endpoint)
    monkeypatch.setattr(FleetSettings, "open_bus", lambda _settings, _role: bus)
    instance = Group(
        "features", FleetSettings(router=router_endpoint), lambda _node, _settings: None
    )
    thread = threading.Thread(target=instance.run, daemon=True)
    thread.start()
    assert bus.asked.wait(20.0)
    instance.stop()
    thread.join(50.0)
    assert not thread.is_alive()


def test_token_query_is_empty_when_the_session_is_closed(router_endpoint: str) -> None:
    bus = Bus("rescuebot", router_endpoint)
    bus.close()
    assert bus.look(f"{PREFIX}/**", 1.0) == frozenset()
