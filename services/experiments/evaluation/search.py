"""One search in this process, with the objects of the services, in lockstep and without messages.

A tick consists of image, decision and movement. In lockstep the services compute the same: the
image is the camera's JPEG, the world waits for the answer to every frame, and the answer applies
from that frame on. A test checks that the same seed gives the same poses.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from schemas.base import TICK_S, Velocity
from schemas.episode import Outcome, Said
from schemas.rpc import ResetRequest
from services.experiments.evaluation.degradation import Degrader
from services.experiments.evaluation.plan import Criterion
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg
from services.robot.episode import Ended
from services.robot.lockstep import PosedView, SteppedEpisode
from services.robot.messages import rounded
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from services.simulator.world.route import route_length_m
from smal.evaluation.driver import Depth, Driver, PlaceEstimate
from smal.movement import Atom, placed, seen_from

P = TypeVar("P", bound=PosedView)
PICTURE_TICKS: Final = 10  # Spacing of the images of an example route, frames.


@dataclass(frozen=True, eq=False)
class SearchRun:
    """Record of one search."""

    outcome: Outcome  # See `schemas.episode.Episode`.
    poses: NDArray[np.float64]  # (ticks + 1, 3): x, y in metres, heading in radians.
    atoms: NDArray[np.int8]  # (ticks,): action from each frame to the next.
    # (ticks + 1,): from the robot's side to the nearest obstacle or person.
    clearance_m: NDArray[np.float64]
    shortest_m: float  # Length of the route from the start to where the victim counts as found.
    places: tuple[PlaceEstimate | None, ...]  # Estimated place at every frame; None while lost.
    arrival_m: float  # Distance to the victim, or to its taught place, at the end.
    decision_ms: NDArray[np.float64]  # Wall time of each decision.
    # At chosen ticks, (height, width, 3) RGB.
    pictures: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    kidnap_tick: int = 0
    right: bool | None = None  # Whether a "not here" was correct.

    @property
    def ways(self) -> list[NDArray[np.float64]]:
        """Poses before and after the kidnapping, which is no driving."""
        return np.split(
            self.poses, [self.kidnap_tick] if 0 < self.kidnap_tick <= len(self.atoms) else []
        )

    @property
    def driven_m(self) -> float:
        """Driven distance, metres."""
        return float(sum(np.hypot(*np.diff(way[:, :2], axis=0).T).sum() for way in self.ways))

    @property
    def turns(self) -> int:
        """Number of starts of a turn, at half the turn rate or more."""
        turning = np.isin(self.atoms, (Atom.LEFT, Atom.RIGHT))
        return int((turning & (np.diff(self.atoms, prepend=Atom.STOP) != 0)).sum())

    @property
    def jerk_m_s3(self) -> float:
        """Root mean square jerk, from third differences of the position."""
        jerks = (
            np.concatenate([np.hypot(*np.diff(way[:, :2], 3, axis=0).T) for way in self.ways])
            / TICK_S**3
        )
        return float(np.sqrt(np.mean(jerks**2))) if jerks.size else 0.0


class _Camera:
    """The robot's camera: degrades images and keeps each n-th (0: no image)."""

    def __init__(self, degrader: Degrader | None, every: int) -> None:
        self._degrader = degrader
        self._every = every
        self.kept: dict[int, NDArray[np.uint8]] = {}

    def see(self, tick: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._degrader is not None:
            image = self._degrader.apply(tick, image)
        if self._every and tick % self._every == 0:
            self.kept[tick] = image
        return image


def search(
    simulation: Simulation,
    driver: Driver,
    request: ResetRequest,
    degrader: Degrader | None = None,
    picture_ticks: int = 0,
) -> SearchRun:
    """Run one search of a driver in a simulation; see `search_in`."""
    episode = LockstepEpisode(simulation, request)
    return search_in(episode, driver, lambda: simulation.clearance_m, degrader, picture_ticks)


def search_in(
    episode: SteppedEpisode[P],
    driver: Driver,
    clearance_m: Callable[[], float],
    degrader: Degrader | None = None,
    picture_ticks: int = 0,
) -> SearchRun:
    """Run one search of a driver, until its announcement or the end of the episode.

    Parameters
    ----------
    episode
        Episode of any body that knows the route and its true pose, with a frame every `TICK_S`.
    driver
        Driver to evaluate.
    clearance_m
        Returns the distance from the robot's side to the nearest obstacle, metres.
    degrader
        Degradation of the images.
    picture_ticks
        Spacing of the images to keep, frames (0: no image).
    """
    beginning = episode.beginning
    driver.reset(episode.request.seed)
    # The search ends where the victim counts as found.
    shortest_m = max(route_length_m(np.array(beginning.route)) - (beginning.found_m or 0.0), 0.0)
    camera = _Camera(degrader, picture_ticks)
    poses = [_true_pose(episode.view)]
    clearances_m = [clearance_m()]
    atoms = list[Atom]()
    places = list[PlaceEstimate | None]()
    decision_ms = list[float]()
    said: Said | None = None
    while True:
        view = episode.view
        image = camera.see(episode.tick, decode_jpeg(view.jpeg))
        if episode.outcome is not None:
            break
        began_s = time.perf_counter()
        motion = driver.step(image, _odometry(view), _depth(episode), TICK_S)
        decision_ms.append(1e3 * (time.perf_counter() - began_s))
        places.append(driver.place)
        if (said := driver.said) is not None:
            break
        velocity = Velocity(*motion)
        poses.append(_true_pose(episode.step(velocity)))
        clearances_m.append(clearance_m())
        atoms.append(Atom[velocity.atom().upper()])
    ended = Ended(cast("Outcome", episode.outcome)) if said is None else episode.end(said)
    return SearchRun(
        ended.outcome,
        poses=np.array(poses),
        atoms=np.array(atoms, dtype=np.int8),
        clearance_m=np.array(clearances_m),
        shortest_m=shortest_m,
        places=tuple(places),
        arrival_m=math.dist(beginning.victim or beginning.route[-1], poses[-1][:2]),
        decision_ms=np.array(decision_ms),
        pictures=camera.kept,
        kidnap_tick=episode.request.kidnap_tick or 0,
        right=ended.right,
    )


def _true_pose(view: PosedView) -> tuple[float, float, float]:
    x, y, heading = view.true_pose
    return x, y, heading


def _odometry(view: PosedView) -> tuple[float, float, float]:
    if view.odometry is None:
        raise JobError("the body has no odometry; drivers of a comparison need it")
    x, y, heading, *_ = rounded(view.odometry)
    return x, y, heading


def _depth(episode: SteppedEpisode[P]) -> Depth | None:
    """Return a copy of the depth image, because the guard reads it after the driver."""
    depth = episode.view.depth
    return None if depth is None or episode.mount is None else (depth.copy(), episode.mount)


def finding(found: SearchRun, taught: NDArray[np.float64], criterion: Criterion) -> dict[str, Any]:
    """Return the result of a search for JSON.

    Parameters
    ----------
    taught
        True poses of all taught frames, (n, 3).
    criterion
        Criterion of a correct estimate.
    """
    aside_m = np.asarray(KDTree(taught[:, :2]).query(found.poses[:, :2])[0], dtype=np.float64)
    result: dict[str, Any] = {
        "outcome": found.outcome,
        "right": found.right,
        "ticks": len(found.atoms),
        "shortest_m": round(found.shortest_m, 2),
        "driven_m": round(found.driven_m, 2),
        "aside_rms_m": round(float(np.sqrt(np.mean(aside_m**2))), 4),
        "aside_max_m": round(float(aside_m.max()), 4),
        "clearance_p5_m": round(float(np.percentile(found.clearance_m, 5)), 4),
        "turns": found.turns,
        "jerk_m_s3": round(found.jerk_m_s3, 3),
        "arrival_m": round(found.arrival_m, 3),
    }
    confident = np.array([place is not None for place in found.places])
    right = np.array(
        [
            _is_right(*pair, taught, criterion)
            for pair in zip(found.places, found.poses, strict=False)
        ]
    )
    result["sure_share"] = round(float(confident.mean()), 4)
    result["wrong_share"] = round(float((confident & ~right).mean()), 4)
    if 0 < found.kidnap_tick <= len(found.atoms):
        result["right_after_s"] = _right_after_s(right[found.kidnap_tick :])
    return result


def _right_after_s(right: NDArray[np.bool_]) -> float | None:
    """Return the time until the estimate is correct for a second, or to the end; None if never."""
    second = round(1.0 / TICK_S)
    ticks = (tick for tick in range(right.size) if right[tick : tick + second].all())
    return next((round(tick * TICK_S, 1) for tick in ticks), None)


def _is_right(
    place: PlaceEstimate | None,
    true: NDArray[np.float64],
    taught: NDArray[np.float64],
    criterion: Criterion,
) -> bool:
    if place is None:
        return False
    believed = placed(np.array([place.ahead, place.left, place.turned_rad]), taught[place.frame])
    x, y, turned = seen_from(believed, true)
    return bool(
        np.hypot(x, y) <= criterion.distance_m and abs(turned) <= math.radians(criterion.angle_deg)
    )
