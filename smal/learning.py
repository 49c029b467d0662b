"""From demonstrations to a model: the map of views, then Algorithms 1, 3 and 4, the reward and the policy."""

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from smal.action_space import ActionSpace, Atom, learn_action_space
from smal.features import Centering, FeatureSettings, extract, select
from smal.model import Model
from smal.novelty import neighbour_agreement, novelty_test
from smal.policy import check_discount, policy_iteration
from smal.reward import learn_reward
from smal.state_space import StateSpace, learn_state_space
from smal.stitches import stitched
from smal.template_store import TemplateStore
from smal.transitions import Transitions, learn_transitions
from smal.virtual_views import Image
from smal.visual_map import GOAL_NAME, ImageChain, MappedDrive, VisualMap, learn_visual_map

#: Where drives lead that do not say so.
USUAL_GOAL = "victim"

_F = TypeVar("_F", bound=np.floating[Any])
# Called with the stage, what is done of it and how much there is of it.
StageProgress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One drive of the expert.

    Parameters
    ----------
    name : str
        Its episode.
    features : float32 array (f, m)
        Raw features of every frame (`smal.features.extract`), without dropped frames.
    atoms : int8 array (f,)
        `Atom` k was executed between frames k and k + 1; the last one after the last frame.
    successful : bool
        Whether it ended at the goal.
    recovery : bool
        Whether it began off the route, to show the way back to it.
    images : sequence of uint8 arrays (height, width, 3), optional
        RGB of every frame; read when they are wanted. Without them it adds nothing to the map of views.
    odometry : float64 array (f, 3), optional
        x, y and heading in radians of every frame by the wheels.
    episode : str
        Which drive it is a part of, where frames between parts were lost; its name if empty.
    goal : str
        Where it leads.
    focal : float, optional
        Focal length of the camera over the width of its image, above 0; estimated from the images if not given.
    ahead : float32 array (f,), optional
        How fast the robot went ahead in the atoms of turning, -1 to 1 times its speed straight on, as a car does; on
        the spot if not given.
    """

    name: str
    features: NDArray[np.float32]
    atoms: NDArray[np.int8]
    successful: bool = True
    recovery: bool = False
    images: Sequence[Image] | None = None
    odometry: NDArray[np.float64] | None = None
    episode: str = ""
    goal: str = USUAL_GOAL
    focal: float | None = None
    ahead: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if self.features.ndim != 2 or self.atoms.shape != (self.features.shape[0],):
            raise ValueError(
                f"demonstration {self.name}: features (f, m) and atoms (f,) do not fit: "
                f"{self.features.shape} and {self.atoms.shape}"
            )
        frames = len(self.atoms)
        if self.images is not None and len(self.images) != frames:
            raise ValueError(f"demonstration {self.name}: {len(self.images)} images for {frames} frames")
        if re.fullmatch(GOAL_NAME, self.goal) is None:
            said = f"{self.goal[:80]!r} is no name of a goal: up to 64 letters, digits, spaces, '.', '_' and '-'"
            raise ValueError(f"demonstration {self.name}: {said}")
        if self.focal is not None and not (math.isfinite(self.focal) and self.focal > 0.0):
            raise ValueError(
                f"demonstration {self.name}: the focal length must be finite and positive, got {self.focal}"
            )
        if self.ahead is not None and not (self.ahead.shape == (frames,) and (np.abs(self.ahead) <= 1.0).all()):
            raise ValueError(f"demonstration {self.name}: ahead must be {frames} numbers of -1 to 1")
        if self.odometry is not None and self.odometry.shape != (frames, 3):
            raise ValueError(f"demonstration {self.name}: odometry {self.odometry.shape} for {frames} frames")


@dataclass(frozen=True)
class LearningSettings:
    """How to learn.

    Parameters
    ----------
    features : FeatureSettings
    sequence_length : int
        l, frames in a sequence and atoms in an action.
    lambda_scale : float
        a in lambda1 = lambda2 = a * sqrt(l), unless they are given: an active row or column of W has about
        l entries, so that its norm grows with sqrt(l).
    lambda1, lambda2 : float, optional
    novelty : str
        Name of the novelty test: "agreement" or the paper's "weight" (Eq. 8).
    novelty_parameters : dict
        Parameters of the test; where not given, defaults, or measured on the demonstrations.
    gamma : float
        Discount factor.
    sparsity, r_max : float
        Of the reward program (`smal.reward`).
    tolerance : float
        Relative duality gap of each match.
    max_bytes : int, optional
        Bound on the memory of templates.
    tick_s : float
        Time between two frames.
    map_views : bool
        Whether to make the map of views; the paper's scheme has none.
    """

    features: FeatureSettings = field(default_factory=FeatureSettings)
    sequence_length: int = 5
    lambda_scale: float = 0.1
    lambda1: float | None = None
    lambda2: float | None = None
    novelty: str = "agreement"
    novelty_parameters: dict[str, float] = field(default_factory=dict)
    gamma: float = 0.95
    sparsity: float = 0.5
    r_max: float = 1.0
    tolerance: float = 1e-3
    max_bytes: int | None = None
    tick_s: float = 0.1
    map_views: bool = True

    def __post_init__(self) -> None:
        if self.sequence_length < 1:
            raise ValueError(f"sequence_length must be at least 1, got {self.sequence_length}")
        for name in ("lambda_scale", "lambda1", "lambda2"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and positive, got {value}")
        if not (math.isfinite(self.tick_s) and self.tick_s > 0.0):
            raise ValueError(f"tick_s must be finite and positive, got {self.tick_s}")
        novelty_test(self.novelty, self.novelty_parameters)
        check_discount(self.gamma)

    @property
    def lambdas(self) -> tuple[float, float]:
        """lambda1 and lambda2 of Eq. 7."""
        default = self.lambda_scale * math.sqrt(self.sequence_length)
        return self.lambda1 or default, self.lambda2 or default


@dataclass(frozen=True)
class LearningReport:
    """What was learned, in numbers.

    Parameters
    ----------
    demonstrations, frames, sequences, states, actions, goals : int
    shared_states : int
        States that occur in at least two demonstrations: without them the transition graph is a set of chains.
    dead_ends : int
        States that nothing is known to follow.
    reward_states : int
        States with a reward above 1e-6.
    keyframes : int
        Of the map of views; 0 without one.
    template_bytes : int
        Memory that templates and their inner products took while the states were learned: 4 n (n + m) for n template
        frames of m features.
    seconds : dict
        Per stage.
    """

    demonstrations: int
    frames: int
    sequences: int
    states: int
    actions: int
    goals: int
    shared_states: int
    dead_ends: int
    reward_states: int
    keyframes: int
    template_bytes: int
    seconds: dict[str, float]


class _Stages:
    """Times the stages and reports their progress."""

    def __init__(self, progress: StageProgress | None) -> None:
        self._progress = progress
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def report(self, stage: str) -> Callable[[int, int], None]:
        def advance(done: int, total: int) -> None:
            if self._progress is not None:
                self._progress(stage, done, total)

        return advance

    def end(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = now - self._since
        self._since = now
        self.report(stage)(1, 1)


def learn(
    demonstrations: Sequence[Demonstration],
    settings: LearningSettings | None = None,
    progress: StageProgress | None = None,
) -> tuple[Model, LearningReport]:
    """Learn states, actions, transitions, reward and policy.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        At least one successful.
    settings : LearningSettings, optional
    progress : callable, optional
        Called with the stage ("centering", "views", "states", "transitions", "reward", "policy"), done and total.

    Returns
    -------
    (Model, LearningReport)

    Raises
    ------
    ValueError
        No successful demonstration of at least one sequence, or features that do not fit the settings.
    """
    settings = LearningSettings() if settings is None else settings
    if not demonstrations:
        raise ValueError("there is no demonstration to learn from")
    for one in demonstrations:
        if one.features.shape[1] != settings.features.size:
            raise ValueError(
                f"demonstration {one.name}: {one.features.shape[1]} features a frame, "
                f"the settings ask for {settings.features.size}"
            )
    stages = _Stages(progress)
    frames = [one.features for one in demonstrations]
    centering = Centering.fit(frames, settings.features)
    centred = [centering.apply(each) for each in frames]
    settings = _calibrated(settings, demonstrations, centred)
    stages.end("centering")
    visual_map = None
    if settings.map_views:
        visual_map = _map_views(demonstrations, centering, settings.tick_s, stages.report("views"))
    stages.end("views")
    space = learn_state_space(
        centred,
        settings.sequence_length,
        *settings.lambdas,
        novelty_test(settings.novelty, settings.novelty_parameters),
        settings.tolerance,
        settings.max_bytes,
        stages.report("states"),
    )
    stages.end("states")
    return _plan(demonstrations, settings, centering, visual_map, space, stages)


def _map_views(
    demonstrations: Sequence[Demonstration],
    centering: Centering,
    tick_s: float,
    progress: Callable[[int, int], None],
) -> VisualMap | None:
    """Make the map of views of the drives that reached the goal and have images; None if there are none.

    Parts of one drive are put together: by its wheels the robot knows how far it went between them.
    """
    of_images = centering.of_images()
    if of_images is None:
        return None
    drives: dict[str, list[Demonstration]] = {}
    for one in demonstrations:
        drives.setdefault(one.episode or one.name, []).append(one)
    usable = []
    for parts in drives.values():
        whole = parts if all(part.odometry is not None for part in parts) else parts[-1:]
        if whole[-1].successful and all(part.images is not None for part in whole):
            usable.append(whole)
    if not usable:
        return None
    return stitched(
        learn_visual_map([_mapped(parts, centering, of_images) for parts in usable], of_images, tick_s, progress)
    )


def _mapped(parts: Sequence[Demonstration], centering: Centering, of_images: Centering) -> MappedDrive:
    raw = np.concatenate([part.features for part in parts])
    return MappedDrive(
        ImageChain([part.images for part in parts if part.images is not None]),
        select(raw, centering.settings, of_images.settings),
        np.concatenate([part.atoms for part in parts]),
        _joined([part.odometry for part in parts]),
        parts[-1].goal,
        tuple(part.name for part in parts),
        parts[-1].focal,
        _joined([part.ahead for part in parts]),
    )


def _joined(parts: Sequence[NDArray[_F] | None]) -> NDArray[_F] | None:
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


def fit(
    drives: Sequence[tuple[Any, ...]],
    settings: LearningSettings | None = None,
    progress: StageProgress | None = None,
    goals: Sequence[str] | None = None,
    focal: float | None = None,
) -> Model:
    """Learn from images and what was done at each of them.

    Parameters
    ----------
    drives : sequence of (images, atoms) or (images, atoms, odometry)
        Of drives that reached the goal: images (height, width, 3) uint8 RGB, an `Atom` for each, and the pose of each
        by the wheels (x, y, heading in radians), if there is any.
    settings : LearningSettings, optional
    progress : callable, optional
        See `learn`.
    goals : sequence of str, optional
        Where each drive leads; all to one goal if not given.
    focal : float, optional
        Focal length of the camera over the width of its image; estimated from the images if not given.

    Examples
    --------
    >>> model = smal.fit([(images, atoms)])  # doctest: +SKIP
    >>> robot = smal.Robot(model)  # doctest: +SKIP
    >>> atom = robot.step(image)  # doctest: +SKIP
    """
    settings = LearningSettings() if settings is None else settings
    goals = [USUAL_GOAL] * len(drives) if goals is None else goals
    taught = []
    for number, ((images, atoms, *odometry), goal) in enumerate(zip(drives, goals, strict=True)):
        features = np.stack([extract(image, settings.features) for image in images])
        way = np.asarray(odometry[0], dtype=np.float64) if odometry else None
        made = np.asarray(atoms, dtype=np.int8)
        taught.append(
            Demonstration(f"drive-{number}", features, made, images=images, odometry=way, goal=goal, focal=focal)
        )
    return learn(taught, settings, progress)[0]


def _calibrated(
    settings: LearningSettings, demonstrations: Sequence[Demonstration], centred: Sequence[NDArray[np.float32]]
) -> LearningSettings:
    """Fill in the parameter of the novelty test that depends on the demonstrations."""
    if settings.novelty != "agreement" or "min_agreement" in settings.novelty_parameters:
        return settings
    measured = neighbour_agreement(centred, [one.atoms != Atom.STOP for one in demonstrations])
    return replace(settings, novelty_parameters=settings.novelty_parameters | {"min_agreement": measured})


def _plan(
    demonstrations: Sequence[Demonstration],
    settings: LearningSettings,
    centering: Centering,
    visual_map: VisualMap | None,
    space: StateSpace,
    stages: _Stages,
) -> tuple[Model, LearningReport]:
    """Everything after the states."""
    actions = learn_action_space([one.atoms for one in demonstrations], settings.sequence_length)
    successful = [one.successful for one in demonstrations]
    transitions = learn_transitions(space.streams, actions.streams, successful, space.states)
    stages.end("transitions")
    reward = learn_reward(transitions, settings.gamma, settings.sparsity, settings.r_max)
    stages.end("reward")
    policy = policy_iteration(transitions, reward.state_reward, settings.gamma)
    stages.end("policy")
    lambda1, lambda2 = settings.lambdas
    model = Model(
        feature_settings=settings.features,
        mean=centering.mean,
        sequence_length=settings.sequence_length,
        lambda1=lambda1,
        lambda2=lambda2,
        novelty=settings.novelty,
        novelty_parameters=settings.novelty_parameters,
        templates=space.templates,
        actions=actions.actions,
        state_streams=space.streams,
        atoms=tuple(one.atoms for one in demonstrations),
        names=tuple(one.name for one in demonstrations),
        successful=tuple(successful),
        recovery=tuple(one.recovery for one in demonstrations),
        transitions=transitions,
        reward=reward.state_reward,
        policy=policy.action,
        value=policy.value,
        gamma=settings.gamma,
        visual_map=visual_map,
    )
    return model, _report(demonstrations, space, actions, transitions, model, stages.seconds)


def _report(
    demonstrations: Sequence[Demonstration],
    space: StateSpace,
    actions: ActionSpace,
    transitions: Transitions,
    model: Model,
    seconds: dict[str, float],
) -> LearningReport:
    return LearningReport(
        demonstrations=len(demonstrations),
        frames=sum(len(one.atoms) for one in demonstrations),
        sequences=sum(len(stream) for stream in space.streams),
        states=space.states,
        actions=len(actions.actions),
        goals=transitions.goals.size,
        shared_states=model.shared_states,
        dead_ends=space.states - np.unique(transitions.state).size,
        reward_states=int((model.reward > 1e-6).sum()),
        keyframes=0 if model.visual_map is None else len(model.visual_map.keyframes),
        template_bytes=TemplateStore.bytes_for(*space.templates.shape),
        seconds=seconds,
    )
