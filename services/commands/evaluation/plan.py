"""What an evaluation runs, as data: `QUICK` and `FULL`."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from typing import Final, Literal

from services.commands.evaluation.degradation import degradation_named
from smal.learning import LearningSettings

#: Sequences have this length by default; the filter has none.
DEFAULT_LENGTH: Final = LearningSettings().sequence_length
#: Seeds of what is learned from begin here, as in the README; those of what is recognised beyond all of them.
TEACHING_SEED, QUERY_SEED, RUN_SEED = 1, 1000, 1


@dataclass(frozen=True)
class Criterion:
    """When a place is recognised: the demonstrated frame that was taken for it was taken so near to the true pose."""

    distance_m: float
    angle_deg: float

    @property
    def meaning(self) -> str:
        """A few words for people."""
        return f"within {self.distance_m:g} m and {self.angle_deg:g}°"


#: Frames from one that is to be recognised to the next: ten frames a second show nearly the same.
JUDGED_TICKS: Final = 4
#: How SMAL decides: name, and one line for people.
SCHEMES: Final = {"paper": "the paper: a decision every l frames", "smal": "default: the filter, at every frame"}


@dataclass(frozen=True)
class Recogniser:
    """A way to say which demonstrated frame the robot is at: Eq. 9 ("smal") of a length, or a peer."""

    name: Literal["smal", "nearest", "seqslam"]
    length: int

    @property
    def key(self) -> str:
        """Short name."""
        return f"{self.name}-{self.length}"


#: Peers that recognise, beside Eq. 9 at all lengths of the plan (l = 1 is the single image).
PEER_RECOGNISERS: Final = (
    Recogniser("nearest", 1),
    Recogniser("nearest", 5),
    *(Recogniser("seqslam", length) for length in (10, 20, 40)),
)
#: Peers that search, beside SMAL and the paper's scheme with l = 1; the number is that of frames, if it matters.
PEERS: Final = ("nearest-1", "nearest-5", "seqslam", "cloning")


@dataclass(frozen=True)
class WorldPlan:
    """What is done in one world.

    Attributes
    ----------
    world
        Its name.
    drives, recoveries
        That are learned from.
    criteria
        Of right recognition; the first one is that of the figures.
    queries
        Held-out drives whose frames are to be recognised, every `JUDGED_TICKS`.
    lengths
        l for precision and recall.
    recognised
        Degradations of the queries.
    search_lengths
        l of the success rates of the paper's scheme; none for no searches of it.
    searched
        For every scheme the degradations under which it searches.
    runs
        Searches of every driver, length and degradation.
    peers
        Degradations under which the peers search.
    template_frames
        At most so many template frames for Algorithm 2, whose time grows with their cube.
    """

    world: str
    drives: int
    recoveries: int
    criteria: tuple[Criterion, ...]
    queries: int
    lengths: tuple[int, ...]
    recognised: tuple[str, ...]
    search_lengths: tuple[int, ...] = ()
    searched: dict[str, tuple[str, ...]] = field(default_factory=dict)
    runs: int = 0
    peers: tuple[str, ...] = ()
    template_frames: int = 1000

    def __post_init__(self) -> None:
        for name in {*self.recognised, *self.peers, *(each for names in self.searched.values() for each in names)}:
            degradation_named(name)
        unknown = [name for name in self.searched if name not in SCHEMES]
        if unknown:
            raise ValueError(f"unknown scheme {unknown[0]!r}; known are {', '.join(SCHEMES)}")
        if self.drives < 1 or not self.criteria:
            raise ValueError(f"{self.world}: a plan needs at least one drive and one criterion")

    @property
    def all_lengths(self) -> tuple[int, ...]:
        """Lengths for which a model is learned."""
        needed = {*self.lengths, *self.search_lengths, DEFAULT_LENGTH}
        return tuple(sorted(needed | ({1} if self.peers else set())))

    @property
    def first_judged_tick(self) -> int:
        """Frame of a held-out drive from which on every method has a whole window, and all are judged."""
        return max(one.length for one in self.recognisers) - 1

    @property
    def recognisers(self) -> tuple[Recogniser, ...]:
        """Who recognises."""
        return (*(Recogniser("smal", length) for length in self.lengths), *PEER_RECOGNISERS)


@dataclass(frozen=True)
class Plan:
    """An evaluation.

    Attributes
    ----------
    name
        "quick" or "full".
    worlds
        What is done in each.
    max_ticks
        Frames after which a search times out.
    camera
        Size of the image, pixels.
    omitted
        What it leaves out of the full one, for the report.
    """

    name: str
    worlds: tuple[WorldPlan, ...]
    max_ticks: int = 3000
    camera: tuple[int, int] = (320, 240)
    omitted: tuple[str, ...] = ()

    def teaching(self, world: WorldPlan) -> str:
        """Return a fingerprint of what is learned from in a world."""
        taught = [world.world, world.drives, world.recoveries, TEACHING_SEED, self.camera]
        return hashlib.sha256(json.dumps(taught).encode()).hexdigest()[:12]

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the whole plan, and of what all plans have in common."""
        everything = [asdict(self), SCHEMES, [asdict(one) for one in PEER_RECOGNISERS], PEERS, JUDGED_TICKS]
        return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()[:12]


_INDOOR: Final = (Criterion(0.35, 25.0), Criterion(0.2, 15.0))
_CAMPUS: Final = (Criterion(3.0, 25.0), Criterion(1.5, 15.0))
_LENGTHS: Final = (1, 5, 10, 20, 40)
#: All that a camera suffers at once: hidden frames, noise, shake.
_BOTH: Final = ("clean", "poor")

FULL: Final = Plan(
    "full",
    tuple(
        WorldPlan(
            world, drives, recoveries, criteria, queries=5, lengths=_LENGTHS, recognised=("clean", "occluded", "poor"),
            search_lengths=_LENGTHS, searched=dict.fromkeys(SCHEMES, _BOTH), runs=10, peers=_BOTH, template_frames=3000,
        )
        for world, drives, recoveries, criteria in (("indoor", 12, 60, _INDOOR), ("campus", 6, 30, _CAMPUS))
    ),
    max_ticks=1500,
)  # fmt: skip

QUICK: Final = Plan(
    "quick",
    (
        WorldPlan(
            "indoor", 6, 18, _INDOOR, queries=1, lengths=(1, 5, 20), recognised=_BOTH,
            search_lengths=(1, 5, 20), searched=dict.fromkeys(SCHEMES, _BOTH), runs=3, peers=_BOTH,
        ),
        WorldPlan("campus", 3, 0, _CAMPUS, queries=1, lengths=(1, 5, 20), recognised=_BOTH),
    ),
    max_ticks=800,
    omitted=(
        "lengths of 10 and 40 frames",
        "searches on the campus",
        "most of the runs (3 instead of 10) and of the drives, so that intervals are wide",
        "searches longer than 800 frames",
    ),
)  # fmt: skip
PLANS: Final = {plan.name: plan for plan in (QUICK, FULL)}
