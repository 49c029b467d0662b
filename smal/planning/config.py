"""Parameters of the planner, with their units and reasons."""

import math
from dataclasses import dataclass
from typing import Final

from smal.obstacles.ground import INSPECTS_S
from smal.target.appearance import TARGET_CONFIG


@dataclass(frozen=True)
class PlannerConfig:
    """Parameters of the planner. Times are seconds of driving at full speed, unless they are by the clock."""

    #: Distance to the aim on the taught way: a shorter one follows noise, a longer one cuts corners.
    lookahead_s: float = 0.7
    #: Radius of a robot without a depth camera, whose mount would give it. Usual bases drive their
    #: radius in 0.3 to 0.5 s.
    radius_s: float = 0.4
    #: Cost of changing the turn rate by the full rate, against oscillation.
    restless_s: float = 0.01
    #: Maximum deviation of the particles' directions from their mean for driving.
    wide_deg: float = 25.0
    #: Turn to the first side in looking around: a robot is seldom turned further away from its way.
    look_aside_deg: float = 45.0
    #: Share of its speed at which a car looks around, in the sharpest bend.
    look_speed: float = 0.5
    #: Likelihood ratio of all views to views of elsewhere from which a robot drives without looking
    #: around first: "decisive" on the scale of Jeffreys (1961).
    decisive: float = 100.0
    #: Time of driving by the best guess before the robot looks around again, beside the time to turn round.
    guess_s: float = 2.0
    #: Time of driving without a supporting view after which the robot stands. With the time of its decision and its
    #: brakes, it stands within a second of driving after its camera has failed.
    blind_s: float = 0.5
    #: Time, by the clock, that it stands until it looks around again: about as long as it takes to look around.
    blind_again_s: float = 10.0
    #: Minimum saving for changing drives: the offset between two drives is less certain than either drive.
    go_over_s: float = 2.0
    #: Probability of being near the goal that counts as arrived.
    arrived: float = 0.99
    #: Usual distance of "found" from the goal.
    found_s: float = 2.5
    #: Way, in correlation lengths, that must have been tracked to arrive without looking around: a few views can match
    #: another place.
    tracked: float = 2.0
    #: Time, by the clock, that a car stands at the end before it reports that the goal is not there.
    stands_s: float = 1.0
    #: Time, by the clock, for which an obstacle stops the robot before it backs off, and backs off.
    stalls_s: float = 1.0
    #: Time, by the clock, that the robot waits before an obstacle without a way round: people have left by then.
    waits_s: float = 5.0
    #: Time, by the clock, that a blocked way stays closed.
    closed_s: float = 60.0
    #: Distances at which unexpected ground slows the robot down to a share of its speed, and stops it. Indoors the
    #: ground is visible from 1.5 s on.
    slows_s: float = INSPECTS_S
    slowly: float = 0.5
    stops_s: float = 2.0
    #: A visible target counts as found within this multiple of the distance at which the taught ways ended.
    as_near: float = 1.3
    #: The same where an obstacle stops the approach: a person can drive nearer than the robot may by itself.
    as_near_as_it_can: float = 2.0
    #: Probability from which the target counts as in view, as in learning.
    in_view: float = TARGET_CONFIG.sure
    #: Probability from which unexpected ground ahead counts as the target: more likely than not.
    likely: float = 0.5
    #: Time, by the clock, for which a new obstacle in the direction of the target counts, as for views of it.
    moment_s: float = TARGET_CONFIG.moment_s
    #: Time, by the clock, after which a robot without a decision stands.
    stands_after_s: float = 0.5

    @property
    def goal_s(self) -> float:
        """Distance that counts as near the goal: half of the usual distance of "found"."""
        return self.found_s / 2.0

    @property
    def look_rad(self) -> float:
        """Total turn of looking around: to one side, back, and once round to the start."""
        return math.tau + 2.0 * math.radians(self.look_aside_deg)

    def search_rad(self, field_rad: float) -> float:
        """Return the turn of a search at the goal: once round and a field of view more, for a base that slips."""
        return math.tau + field_rad


PLANNER_CONFIG: Final = PlannerConfig()
