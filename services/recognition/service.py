"""Recognition service: localises the robot by each observation."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from schemas.array import Float32Array
from schemas.base import Velocity
from schemas.command import CommandApplied
from schemas.motion import Odometry
from schemas.observation import Observation
from schemas.rpc import LoadReply
from schemas.state import State
from schemas.taught_map import TaughtMap
from services.kit.belief import belief_of, fields_of
from services.kit.model_service import AnyModel, LoadedModel, Wheels
from services.kit.node import Detail, ServiceError
from smal.features import FeaturesError
from smal.features.detectors import Detection
from smal.features.percept import Percept
from smal.map import in_common_axes
from smal.model import Model
from smal.movement import Atom
from smal.paper.model import PaperModel
from smal.robot import NO_GROUND, Localizer

# Frames whose odometry and commands are kept until their observation arrives.
_KEPT: Final = 100
_MOST_DRIVES: Final = 1000  # Maximum drives in a message of the map.


class RecognitionService:
    """Localises the robot by the filter or by the paper's scheme.

    If a newer frame already waits, the filter skips a frame, since the odometry of the next covers
    it; the paper's scheme stores it without an answer. Otherwise the newest answer is delayed. In
    lockstep this never happens. With `watches`, states include the distance of unexpected ground,
    for a robot without a depth camera. For a model taught without odometry, the filter uses the
    commands of the actuator instead.
    """

    def __init__(self, watches: bool = False) -> None:
        self._watches = watches
        self.behind: Callable[[], bool] = lambda: False  # Whether newer observations wait.
        #: Receives the poses of the keyframes before the first belief of an episode.
        self.announce: Callable[[TaughtMap], None] = lambda _map: None
        self._loaded: LoadedModel | None = None
        self._localizer: _ByFilter | _ByPaper | None = None
        self._last: State | None = None
        self._odometry: dict[tuple[str, int], Wheels] = {}
        self._applied: dict[tuple[str, int], CommandApplied] = {}
        self._waiting: Observation | None = None

    def load(self, loaded: LoadedModel) -> LoadReply:
        """Work with another model; with the same keyframes the belief is kept."""
        model = loaded.model
        before = self._loaded
        handed = self.hands_on()
        if self._watches and (not isinstance(model, Model) or model.ground is None):
            raise ServiceError(NO_GROUND)
        localizer = (
            _ByFilter(model, loaded, self._watches)
            if isinstance(model, Model)
            else _ByPaper(model, loaded)
        )
        self._loaded = loaded
        self._localizer = localizer
        self._last = None
        self._waiting = None
        if handed is not None and before is not None and _same_keyframes(model, before.model):
            self.resume(*handed)
        return loaded.reply()

    @property
    def loaded(self) -> LoadedModel | None:
        """The model in use."""
        return self._loaded

    def hands_on(self) -> tuple[State, Wheels | None] | None:
        """Return the last state and the odometry of its frame, or None."""
        last = self._last
        return None if last is None else (last, self._odometry.get((last.episode, last.tick)))

    def resume(self, state: State, wheels: Wheels | None) -> None:
        """Continue from another instance's belief if it fits the model."""
        if self._localizer is not None and self._localizer.resume(state, wheels):
            self._last = state

    def see(self, odometry: Odometry) -> State | None:
        """Store the odometry of a frame, which can arrive before or after its observation."""
        self._odometry[odometry.episode, odometry.tick] = odometry.pose
        _forget(self._odometry)
        waiting = self._waiting
        if waiting is None or (waiting.episode, waiting.tick) != (odometry.episode, odometry.tick):
            return None
        return self._answer(waiting)

    def see_applied(self, applied: CommandApplied) -> None:
        """Store the actuator's motion from a frame on; the last report of a frame counts."""
        last = self._applied.get((applied.episode, applied.tick))
        if last is None or applied.sequence > last.sequence:
            self._applied[applied.episode, applied.tick] = applied
        _forget(self._applied)

    def _atoms(self, episode: str, since: int, until: int) -> list[Atom | Velocity]:
        """Return the actuator's motion between two frames; unknown frames repeat the motion before.

        The policy's velocities are shares of the taught speeds; those of other sources are shares
        of the robot's.
        """
        atoms: list[Atom | Velocity] = [Atom.STOP]
        for tick in range(since, until):
            applied = self._applied.get((episode, tick))
            if applied is None:
                atoms.append(atoms[-1])
            else:
                atoms.append(
                    applied.velocity if applied.source == "policy" else Atom[applied.atom.upper()]
                )
        return atoms[1:]

    def handle(self, observation: Observation) -> State | None:
        """Return the state at one frame, or None while its odometry is missing.

        Without a due decision the status is ``collecting``.

        Raises
        ------
        ServiceError
            If the observation has other features than the model.
        """
        if self._loaded is None or self._localizer is None:
            return State.after(observation, status="idle")
        wanted = self._loaded.model.feature_settings.fingerprint
        if observation.fingerprint != wanted:
            raise ServiceError(
                f"observations have the features {observation.fingerprint}, the model {wanted}; "
                "learn the model again"
            )
        last = self._last
        waiting = self._waiting
        if last is not None and (last.episode, last.tick) == (
            observation.episode,
            observation.tick,
        ):
            # The simulator resent the frame after a lost answer: repeat the answer.
            return last
        again = waiting is not None and (waiting.episode, waiting.tick) == (
            observation.episode,
            observation.tick,
        )
        known = (observation.episode, observation.tick) in self._odometry
        if self._localizer.by_odometry and not known and not again:
            self._waiting = observation
            return None
        return self._answer(observation)

    def _answer(self, observation: Observation) -> State | None:
        assert self._localizer is not None  # noqa: S101 - observations wait only with a model
        self._waiting = None
        last = (
            self._last
            if self._last is not None and self._last.episode == observation.episode
            else None
        )
        if last is None:
            self._localizer.reset()
        since = 0 if last is None else last.tick
        atoms = (
            []
            if self._localizer.by_odometry
            else self._atoms(observation.episode, since, observation.tick)
        )
        odometry = self._odometry.get((observation.episode, observation.tick))
        try:
            found = self._localizer.observe(observation, odometry, atoms, behind=self.behind())
        except FeaturesError as error:
            raise ServiceError(
                f"episode {observation.episode}, frame {observation.tick}: {error}"
            ) from None
        if found is None:
            return None
        if last is None:
            for known in self._localizer.taught_map():
                self.announce(TaughtMap.after(found, model=found.model, **known))
        self._last = found
        return found

    def detail(self) -> Detail:
        """Return the loaded model."""
        # This runs on a thread of the bus: the model can change at any time.
        loaded = self._loaded
        return {"model": None} if loaded is None else loaded.detail()


def _same_keyframes(one: AnyModel, other: AnyModel) -> bool:
    """Return whether two maps have the same keyframes, as after an update with view variants."""
    if not isinstance(one, Model) or not isinstance(other, Model):
        return False
    return np.array_equal(one.mapped.key_poses, other.mapped.key_poses)


def _forget(kept: dict[tuple[str, int], Any]) -> None:
    """Remove the oldest entries."""
    while len(kept) > _KEPT:
        del kept[next(iter(kept))]


class _ByFilter:
    def __init__(self, model: Model, loaded: LoadedModel, watches: bool) -> None:
        self._identity = loaded.identity
        self._mapped = model.mapped
        self._localizer = Localizer(model, goal=loaded.goal, watches=watches)
        self.by_odometry = self._mapped.odometry
        self.reset()

    def reset(self) -> None:
        self._localizer.reset()
        self._stamp_ns: int | None = None

    def resume(self, state: State, wheels: Wheels | None) -> bool:
        if not state.weights.any() or state.keyframes.max() >= len(self._mapped.keyframes):
            return False
        self._localizer.reset(belief_of(state), wheels)
        self._stamp_ns = state.stamp_ns
        return True

    def observe(
        self,
        observation: Observation,
        odometry: Wheels | None,
        atoms: Sequence[Atom | Velocity],
        *,
        behind: bool,
    ) -> State | None:
        if behind:
            return None
        elapsed_s = observation.since(self._stamp_ns)
        detected = tuple(Detection(one.label, one.score, one.box) for one in observation.detected)
        percept = Percept(observation.features.to_numpy(), observation.small(), detected)
        located = self._localizer.locate(percept, odometry, atoms, elapsed_s)
        self._stamp_ns = observation.stamp_ns
        return State.after(observation, model=self._identity, **fields_of(located))

    def taught_map(self) -> Iterator[dict[str, Any]]:
        """Yield the poses of the keyframes as message fields."""
        drives = self._mapped.key_drives
        begins = np.flatnonzero(np.diff(drives, prepend=-1))[:_MOST_DRIVES].tolist()
        poses = in_common_axes(self._mapped).astype(np.float32)
        yield {"keyframes": Float32Array.from_numpy(poses), "begins": tuple(begins)}


class _ByPaper:
    by_odometry = False

    def __init__(self, model: PaperModel, loaded: LoadedModel) -> None:
        from smal.paper.recognition import Recognizer  # noqa: PLC0415 - unused with a map

        self._length = model.sequence_length
        self._loaded = loaded
        self._recognizer = Recognizer(model)

    def reset(self) -> None:
        self._recognizer.reset()

    def resume(self, _state: State, _wheels: Wheels | None) -> bool:
        return False  # Its window consists of frames, which are not stored.

    def taught_map(self) -> Iterator[dict[str, Any]]:
        """Yield nothing: the paper's states have no places."""
        yield from ()

    def observe(
        self,
        observation: Observation,
        _odometry: Wheels | None,
        _atoms: Sequence[Atom | Velocity],
        *,
        behind: bool,
    ) -> State:
        # The first decision is due with the first full window, the others follow at a fixed
        # interval.
        first = self._length - 1
        due = (observation.tick - first) % self._loaded.stride == 0 and not behind
        found = asdict(
            self._recognizer.observe(observation.tick, observation.features.to_numpy(), due)
        )
        return State.after(observation, model=self._loaded.identity, **found)
