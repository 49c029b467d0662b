"""The numbers of the planner, with their units and reasons."""

import math
from dataclasses import dataclass
from typing import Final

from smal.obstacles.strange import LOOKS_S
from smal.sought.sight import TARGET_CONFIG, TargetConfig


@dataclass(frozen=True)
class PlannerConfig:
    """Times are in seconds of driving at full speed unless they say otherwise."""

    #: How far ahead on the taught way the robot aims: less follows noise, more cuts corners.
    lookahead_s: float = 0.7
    #: Cost of changing the turn rate by the full rate, against swinging to and fro.
    restless_s: float = 0.01
    #: Directions of particles that differ by more about their mean are none to drive in.
    wide_deg: float = 25.0
    #: It looks to one side first, since a robot is seldom turned further away from its way.
    look_aside_deg: float = 45.0
    #: Share of its speed at which a car looks around, in as sharp a bend as it can.
    look_speed: float = 0.5
    #: Time of driving by its best guess, before it looks around again.
    guess_s: float = 2.0
    #: Without a view that speaks for its place it stands after this time. So it stands within a second of driving after
    #: its camera has failed, with the time that its decision and its brakes take.
    blind_s: float = 0.5
    #: What going over to another drive must save: how two drives stand to each other is less certain than either.
    go_over_s: float = 2.0
    #: Probability of being near the goal with which it has arrived.
    arrived: float = 0.99
    #: Distance from the goal within which it is near: half of what is usually called found.
    goal_s: float = 1.25
    #: Way, in correlation lengths, on which it must have been followed to arrive without having looked around: a few
    #: views may show another place.
    tracked: float = 2.0
    #: Time, by the clock, that a car stands at the end before it decides that its goal is not here.
    stands_s: float = 1.0
    #: Time, by the clock, that it waits before what nothing leads round: people have walked on by then.
    waits_s: float = 5.0
    #: Time, by the clock, for which it takes another taught way after it has waited in vain.
    closed_s: float = 60.0
    #: Strange ground slows it down from this time before it, to a share of its speed, and stops it: indoors the ground
    #: shows from 1.5 s on.
    slows_s: float = LOOKS_S
    slowly: float = 0.5
    stops_s: float = 2.0
    #: A target that is seen is found nearer than this many times how near the taught ways ended.
    as_near: float = 1.3
    target: TargetConfig = TARGET_CONFIG
    #: Time, by the clock, after which a robot without a decision stands: it has not gone on turning since.
    stands_after_s: float = 0.5

    @property
    def look_rad(self) -> float:
        """Turn of looking around: to one side, back, and once round to where it began."""
        return math.tau + 2.0 * math.radians(self.look_aside_deg)

    def search_rad(self, field_deg: float) -> float:
        """Return the turn of a search at the goal: once round and a view more, since a base may slip in turning."""
        return math.tau + math.radians(field_deg)


PLANNER_CONFIG: Final = PlannerConfig()
