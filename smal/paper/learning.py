"""From demonstrations to the paper's model: Algorithms 1, 3 and 4, the reward and the policy."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from smal.features import Centering, FeatureSettings
from smal.paper.action_space import learn_action_space
from smal.paper.model import PaperModel
from smal.paper.policy import check_discount, policy_iteration
from smal.paper.reward import learn_reward
from smal.paper.state_matching import usual_lambda
from smal.paper.state_space import learn_state_space
from smal.paper.transitions import learn_transitions
from smal.teaching.demonstration import Demonstration, check_features


@dataclass(frozen=True)
class LearningSettings:
    """Parameters of learning.

    Attributes
    ----------
    sequence_length
        l, frames in a sequence and atoms in an action.
    lambda1, lambda2
        Weights of Eq. 7, by default `usual_lambda`.
    tau
        Threshold of Eq. 8, per query frame. A sequence without a match of more weight is a new state.
    gamma
        Discount factor.
    max_bytes
        Maximum memory of the templates.
    """

    features: FeatureSettings = field(default_factory=FeatureSettings)
    sequence_length: int = 5
    lambda1: float | None = None
    lambda2: float | None = None
    tau: float = 0.5
    gamma: float = 0.95
    max_bytes: int | None = None

    def __post_init__(self) -> None:
        if self.sequence_length < 1:
            raise ValueError(f"sequence_length must be at least 1, got {self.sequence_length}")
        for name in ("lambda1", "lambda2"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and positive, got {value}")
        if not (math.isfinite(self.tau) and self.tau >= 0.0):
            raise ValueError(f"tau must be finite and not negative, got {self.tau}")
        check_discount(self.gamma)

    @property
    def lambdas(self) -> tuple[float, float]:
        """lambda1 and lambda2 of Eq. 7."""
        default = usual_lambda(self.sequence_length)
        return self.lambda1 or default, self.lambda2 or default


def learn(
    demonstrations: Sequence[Demonstration],
    settings: LearningSettings | None = None,
    progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None,
) -> PaperModel:
    """Learn states, actions, transitions, reward and policy from demonstrations, at least one of them successful.

    `progress` is called with the stage ("centering", "states", "transitions", "reward", "policy"), the finished number
    and the total.

    Raises
    ------
    ValueError
        If no successful demonstration has a sequence, or features do not fit the settings.
    MemoryBoundError
        If the templates need more than `max_bytes`.
    RewardError
        If the reward program was not solved.
    """
    settings = LearningSettings() if settings is None else settings
    check_features(demonstrations, settings.features.size)
    length = settings.sequence_length
    lambdas = settings.lambdas
    atoms = [drive.atoms for drive in demonstrations]
    successful = [drive.successful for drive in demonstrations]
    raw = [drive.rows for drive in demonstrations]
    centering = Centering.fit(raw, settings.features)
    frames = [centering.apply(rows) for rows in raw]
    progress("centering", 1, 1)
    space = learn_state_space(
        frames, length, lambdas, settings.tau,
        max_bytes=settings.max_bytes, progress=lambda done, total: progress("states", done, total),
    )  # fmt: skip
    actions = learn_action_space(atoms, length)
    transitions = learn_transitions(space.streams, actions.streams, successful, space.states)
    progress("transitions", 1, 1)
    reward = learn_reward(transitions, settings.gamma).state_reward
    progress("reward", 1, 1)
    policy = policy_iteration(transitions, reward, settings.gamma)
    progress("policy", 1, 1)
    return PaperModel(
        feature_settings=settings.features,
        mean=centering.mean,
        sequence_length=length,
        lambda1=lambdas[0],
        lambda2=lambdas[1],
        templates=space.templates,
        actions=actions.actions,
        state_streams=space.streams,
        atoms=tuple(atoms),
        names=tuple(drive.name for drive in demonstrations),
        successful=tuple(successful),
        recovery=tuple(drive.recovery for drive in demonstrations),
        transitions=transitions,
        reward=reward,
        policy=policy.action,
        value=policy.value,
        gamma=settings.gamma,
    )
