"""From demonstrations to the paper's model: Algorithms 1, 3 and 4, the reward and the policy."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.demonstration import Demonstration, check_features
from smal.features import Centering, FeatureSettings
from smal.mapping import demonstrations_of
from smal.movement import Atom
from smal.paper.action_space import ActionSpace, learn_action_space
from smal.paper.model import Model
from smal.paper.novelty import neighbour_agreement, novelty_test
from smal.paper.policy import check_discount, policy_iteration
from smal.paper.reward import learn_reward
from smal.paper.state_space import StateSpace, learn_state_space
from smal.paper.template_store import TemplateStore
from smal.paper.transitions import Transitions, learn_transitions

# Called with the stage, what is done of it and how much there is of it.
StageProgress = Callable[[str, int, int], None]


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
        Of the reward program (`smal.paper.reward`).
    tolerance : float
        Relative duality gap of each match.
    max_bytes : int, optional
        Bound on the memory of templates.
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

    def __post_init__(self) -> None:
        if self.sequence_length < 1:
            raise ValueError(f"sequence_length must be at least 1, got {self.sequence_length}")
        for name in ("lambda_scale", "lambda1", "lambda2"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and positive, got {value}")
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
        Called with the stage ("centering", "states", "transitions", "reward", "policy"), done and total.

    Returns
    -------
    (Model, LearningReport)

    Raises
    ------
    ValueError
        No successful demonstration of at least one sequence, or features that do not fit the settings.
    """
    settings = LearningSettings() if settings is None else settings
    check_features(demonstrations, settings.features.size)
    stages = _Stages(progress)
    frames = [one.features for one in demonstrations]
    centering = Centering.fit(frames, settings.features)
    centred = [centering.apply(each) for each in frames]
    settings = _calibrated(settings, demonstrations, centred)
    stages.end("centering")
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
    return _plan(demonstrations, settings, centering, space, stages)


def fit(drives: Sequence[tuple[Any, ...]], settings: LearningSettings | None = None) -> Model:
    """Learn from images and what was done at each of them; see `smal.mapping.fit`."""
    settings = LearningSettings() if settings is None else settings
    return learn(demonstrations_of(drives, settings.features), settings)[0]


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
        template_bytes=TemplateStore.bytes_for(*space.templates.shape),
        seconds=seconds,
    )
