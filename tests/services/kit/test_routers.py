"""Two linked routers, open and with certificates: the bus goes on when one of them is gone."""

import os
import signal
import threading
from contextlib import closing, suppress
from pathlib import Path

import pytest

from schemas import topics
from schemas.codec import decode
from schemas.motion import Odometry
from schemas.rpc import EndRequest, Nothing
from services.cli.stack import Stack, StackPlan, free_endpoint
from services.kit.bus import Bus, BusError, RpcError, addresses
from services.kit.settings import ServiceSettings
from tests.schemas.messages import EXAMPLES
from tests.services.secured import ROBOT, make_keys
from tests.services.waiting import eventually

pytestmark = [pytest.mark.zenoh, pytest.mark.system]


def linked(folder: Path, *, secure: bool) -> Stack:
    """Return two routers."""
    keys = make_keys(folder / "keys") if secure else None
    both = ",".join(free_endpoint() for _ in range(2))
    endpoint = both if keys is None else both.replace("tcp/127.0.0.1", "tls/localhost")
    return Stack(StackPlan(("router",), ROBOT, endpoint, secure=keys, logs=folder / "logs"))


class Stream:
    """Endless odometry with a live subscriber, a recording subscriber, and calls beside it."""

    def __init__(self, stack: Stack, *, apart: bool) -> None:
        own = ",".join(reversed(addresses(stack.plan.endpoint))) if apart else stack.plan.endpoint
        at = stack.settings.model_copy(update={"router": own})
        self.robot = stack.settings.open_bus("robot")
        self.policy = at.open_bus("policy")
        self.recorder = at.open_bus("recorder")
        self.operator = at.open_bus("operator")
        self.buses = (self.robot, self.policy, self.recorder, self.operator)
        self.heard: list[int] = []
        self.recorded: list[int] = []
        self.robot.serve("robot", "end", lambda _request, reply: reply(EndRequest(episode="here")))
        for bus, ticks, replay in (
            (self.policy, self.heard, False),
            (self.recorder, self.recorded, True),
        ):
            bus.subscribe(
                topics.ODOMETRY,
                lambda *sample, ticks=ticks: self._note(ticks, *sample),
                replay=replay,
            )
        self.sent = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()
        eventually(lambda: self.heard and self.recorded and self.answered())

    def _note(
        self, ticks: list[int], payload: bytes, encoding: str, _transit_s: float | None
    ) -> None:
        ticks.append(decode(Odometry, payload, encoding).tick)

    def _send(self) -> None:
        # As many are kept as come in 45 s ten times a second: of an outage of nine seconds nothing is lost.
        while not self._ended.wait(0.02):
            self.sent += 1
            self.robot.publish(EXAMPLES[Odometry].model_copy(update={"tick": self.sent}))

    def answered(self) -> bool:
        try:
            return (
                self.operator.call("robot", "end", Nothing(), EndRequest, timeout_s=2.0).episode
                == "here"
            )
        except RpcError:
            return False

    def goes_on(self) -> None:
        """Wait until new samples are received and recorded, and a call is answered."""
        sent = self.sent
        eventually(lambda: self.heard[-1] > sent and self.recorded[-1] > sent)
        eventually(self.answered)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        for bus in self.buses:
            bus.close()


def routers_of(bus: Bus) -> set[str]:
    return {str(zid) for session in bus.sessions.values() for zid in session.info.routers_zid()}


def is_heard(settings: ServiceSettings) -> bool:
    """Whether a new subscriber receives the stream."""
    heard = threading.Event()
    with suppress(BusError), closing(settings.open_bus("console", patience_s=0.0)) as bus:
        bus.subscribe(topics.ODOMETRY, lambda *_sample: heard.set())
        return heard.wait(2.0)
    return False


@pytest.mark.parametrize(
    ("secure", "harm", "apart"),
    [
        (False, signal.SIGKILL, False),
        (True, signal.SIGSTOP, True),
    ],
)
def test_bus_goes_on_when_either_router_is_gone(
    tmp_path: Path, secure: bool, harm: signal.Signals, apart: bool
) -> None:
    with linked(tmp_path, secure=secure) as stack, closing(Stream(stack, apart=apart)) as stream:
        assert (routers_of(stream.robot) != routers_of(stream.policy)) == apart
        for gone, at in stack._routers.items():
            victim = stack.pid(gone)
            os.kill(victim, harm)
            stream.goes_on()
            assert routers_of(stream.robot) == routers_of(stream.policy)
            eventually(lambda: is_heard(stack.settings))
            if harm == signal.SIGSTOP:
                os.kill(victim, signal.SIGCONT)
            else:
                eventually(stack.restart_dead)
            # The one that is back is linked with the other again.
            eventually(lambda at=at: is_heard(stack.settings.model_copy(update={"router": at})))
            stream.goes_on()
    # Nothing twice, nothing late; and whoever wants all of it has that.
    assert stream.heard == sorted(set(stream.heard))
    assert stream.recorded == list(range(stream.recorded[0], stream.recorded[-1] + 1))


def test_session_gets_a_new_name_when_its_router_was_frozen(tmp_path: Path) -> None:
    plan = StackPlan(("router",), ROBOT, free_endpoint(), logs=tmp_path / "logs")
    with Stack(plan) as stack, closing(Stream(stack, apart=False)) as stream:
        sessions = [session for bus in stream.buses for session in bus.sessions.values()]
        os.kill(stack.pid("router"), signal.SIGSTOP)
        eventually(lambda: not any(session.info.routers_zid() for session in sessions))
        os.kill(stack.pid("router"), signal.SIGCONT)
        eventually(
            lambda: (
                not {id(one) for bus in stream.buses for one in bus.sessions.values()}
                & {*map(id, sessions)}
            )
        )
        stream.goes_on()
        eventually(lambda: sorted(stream.recorded) == list(range(1, max(stream.recorded) + 1)))
    assert stream.heard == sorted(set(stream.heard))


def test_stacks_of_two_machines_are_one_bus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = make_keys(tmp_path / "keys")
    addresses_of_both = [free_endpoint() for _ in range(2)]
    here, there = (one.replace("tcp/127.0.0.1", "tls/localhost") for one in addresses_of_both)

    def machine(at: str, other: str) -> Stack:
        monkeypatch.setenv("SMAL_PEERS", other)
        return Stack(StackPlan(("router",), ROBOT, at, secure=keys, logs=tmp_path / "logs"))

    with machine(here, there) as robots, machine(there, here) as desk:
        heard: list[bytes] = []
        with (
            closing(robots.settings.open_bus("robot")) as robot,
            closing(desk.settings.open_bus("policy")) as policy,
        ):
            policy.subscribe(topics.ODOMETRY, lambda payload, *_: heard.append(payload))

            def comes() -> bool:
                robot.publish(EXAMPLES[Odometry])
                return bool(heard)

            eventually(comes)
