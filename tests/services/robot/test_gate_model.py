"""The command gate against a model of it, for any sequence of events."""

import math
from collections.abc import Callable
from itertools import pairwise

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from schemas.base import SOURCES, STANDING, Atom, Source
from schemas.command import Command, StopCause
from services.robot.gate import LEASE_S, SILENCE_S, Applied, CommandGate
from tests.services.robot.gating import beat, command

SESSIONS = st.sampled_from(["", "o", "p"])

#: Causes of a stop, the gravest last.
GRAVITY: list[StopCause] = ["not_armed", "operator_lost", "fault", "emergency_stop"]


class GateMachine(RuleBasedStateMachine):
    """Against a model that keeps everything that was said for ever, and picks by definition."""

    @initialize(
        driver=st.sampled_from(SOURCES[1:]),
        attended=st.booleans(),
        max_age_s=st.sampled_from([0.25, 0.5]),
    )
    def start(self, driver: Source, attended: bool, max_age_s: float) -> None:
        self.attended = attended
        self.max_age_s = max_age_s
        self.now = 0.0
        self.restart()
        self.next_episode(driver)

    @rule()
    def restart(self) -> None:
        """Kill the process and start it again."""
        self.gate = CommandGate(self.max_age_s, attended=self.attended)
        self.stop = self.gate.latched_stop
        self.cause: StopCause = "not_armed"
        self.operator: str | None = None
        self.answered_s = -math.inf
        self.pulses = [(7, -math.inf)]
        self.beats = getattr(self, "beats", 0)
        self.last_beat = ("none", -1)
        self.forget("none", "policy")

    def forget(self, episode: str, driver: Source) -> None:
        self.episode = episode
        self.driver = driver
        self.taken_over = False
        self.tick = 0
        self.captured: dict[int, float] = {}
        self.accepted: list[tuple[Command, float]] = []
        self.leased: dict[str, tuple[str, float]] = {}
        self.expired = 0

    @rule(step=st.sampled_from([0.01, 0.1, 0.2, 0.3, 2.0]))
    def wait(self, step: float) -> None:
        self.now += step
        self.gate.watch(self.now)
        if self.operator is not None and self.now - self.answered_s > self.gate.absent_s:
            self.operator = None
            self.latched("operator_lost")

    def latched(self, cause: StopCause) -> None:
        assert self.gate.latched_stop not in (0, self.stop), "every stop has a number of its own"
        causes = (cause, self.cause) if self.stop else (cause,)
        self.cause = max(causes, key=GRAVITY.index)
        assert self.gate.stop_cause == self.cause
        self.stop = self.gate.latched_stop

    @rule()
    def frame(self) -> None:
        self.tick += 1
        self.captured[self.tick] = self.now
        self.gate.captured(self.tick, self.now)

    @rule()
    def pulse(self) -> None:
        self.pulses.append((self.gate.pulse(self.now), self.now))

    @rule(
        session=SESSIONS,
        present=st.sampled_from([True, True, True, False]),
        again=st.booleans(),
        back=st.sampled_from([0, 0, 1, 2, 9]),
    )
    def hear(self, session: str, present: bool, again: bool, back: int) -> None:
        self.beats += not again
        number, sent_s = self.pulses[max(-1 - back, -len(self.pulses))]
        self.gate.hear(beat(session, self.beats, number, present=present), self.now)
        if self.now - sent_s > self.gate.absent_s:
            return  # it tells of long ago
        if self.last_beat == (session, self.beats) or self.operator not in (None, session):
            return  # it was heard before, or somebody else is there
        left = self.operator is not None and not present
        known_s = self.answered_s if self.last_beat[0] == session else -math.inf
        self.operator = session if present else None
        self.answered_s = max(known_s, sent_s)
        self.last_beat = session, self.beats
        if left and self.attended:
            self.latched("operator_lost")

    @rule(cause=st.sampled_from(["emergency_stop", "fault"]))
    def latch(self, cause: StopCause) -> None:
        self.gate.stop(cause)
        self.latched(cause)

    @rule(session=SESSIONS, off=st.sampled_from([0, 0, 0, 1, -1]))
    def arm(self, session: str, off: int) -> None:
        may = self.operator == session or (self.operator is None and not self.attended)
        done = self.gate.arm((self.stop or 7) + off, session) is None
        assert done == (may and self.stop != 0 and off == 0)
        if done:
            self.stop = 0
            self.taken_over = self.episode != "none"
            self.expired = len(self.accepted)

    @rule(back=st.integers(0, 2), episode=st.sampled_from(["e", "e", "old"]), session=SESSIONS)
    def resume(self, back: int, episode: str, session: str) -> None:
        tick = max(0, self.tick - back)
        mine = [c.tick for c, _ in self.accepted if c.source == "teleop"][-1:]
        resumed = self.gate.resume(episode, tick, session) is None
        assert resumed == (
            episode == self.episode
            and max(mine, default=0) <= tick
            and self.operator in (None, session)
        )
        if resumed:
            self.taken_over = False
            self.expired = len(self.accepted)

    @rule(driver=st.sampled_from(SOURCES[1:]))
    def next_episode(self, driver: Source) -> None:
        self.gate.begin("e", driver)
        self.forget("e", driver)
        self.captured = {0: self.now}
        self.gate.captured(0, self.now)

    @rule(
        source=st.sampled_from(SOURCES),
        session=SESSIONS,
        back=st.integers(-1, 6),
        sequence=st.integers(0, 2),
        atom=st.sampled_from(["forward", "left", "stop"]),
        episode=st.sampled_from(["e", "e", "e", "old"]),
    )
    def offer(
        self, source: Source, session: str, back: int, sequence: int, atom: Atom, episode: str
    ) -> None:
        offered = command(
            max(0, self.tick - back),
            sequence=sequence,
            source=source,
            atom=atom,
            episode=episode,
            session=session,
        )
        refusal = self.gate.offer(offered, self.now)
        if source == "emergency_stop":
            assert refusal is None
            self.latched("emergency_stop")
            return
        holder, held_s = self.leased.get(source, (session, 0.0))
        last = [
            c for c, _ in self.accepted if c.source == source and c.session == session == holder
        ][-1:]
        may = (
            offered.episode == self.episode
            and source in ("teleop", self.driver)
            and (source != "teleop" or self.operator in (None, session))
            and (holder == session or self.now - held_s > LEASE_S)
            and all((c.tick, c.sequence) < (offered.tick, sequence) for c in last)
            and self.now - self.captured.get(offered.tick, -math.inf) <= self.max_age_s
        )
        assert (refusal is None) == may, refusal
        if may:
            self.leased[source] = (session, self.now)
            self.accepted.append((offered, self.now))
            self.taken_over |= source != self.driver

    @invariant()
    def only_the_last_accepted_fresh_command_of_whoever_drives_moves_the_robot(self) -> None:
        if not hasattr(self, "gate"):
            return
        applied = self.gate.applied(self.now)
        who = "teleop" if self.taken_over else self.driver
        theirs = [(c, at) for c, at in self.accepted[self.expired :] if c.source == who][-1:]
        fresh = [
            c
            for c, at in theirs
            if self.now <= min(self.captured[c.tick] + self.max_age_s, at + SILENCE_S)
        ]
        assert (self.gate.taken_over, self.gate.operator) == (self.taken_over, self.operator)
        assert self.gate.latched_stop == self.stop
        if self.stop:
            assert (applied.velocity, applied.reason) == (STANDING, "latched_stop")
        elif not fresh:
            assert applied == Applied(
                STANDING, None, "taken_over" if self.taken_over else "silence"
            )
        else:
            assert applied == Applied(fresh[0].velocity, who, "command", fresh[0].tick)
        if applied.velocity != STANDING:
            assert not self.attended or self.operator is not None

    @invariant()
    def commands_of_one_process_are_in_order(self) -> None:
        if not hasattr(self, "gate"):
            return
        for (one, _), (other, _) in pairwise(
            [pair for pair in self.accepted if pair[0].source == self.driver]
        ):
            assert one.session != other.session or (one.tick, one.sequence) < (
                other.tick,
                other.sequence,
            )

    @invariant()
    def a_frame_is_answered_when_the_newest_command_of_the_driver_is_for_it(self) -> None:
        if not hasattr(self, "gate"):
            return
        mine = [c.tick for c, _ in self.accepted if c.source == self.driver]
        assert self.gate.answered(self.tick) == (mine[-1:] == [self.tick])


GateMachine.TestCase.settings = settings(max_examples=75, stateful_step_count=40, deadline=None)
TestGateMachine: Callable[[], object] = GateMachine.TestCase
