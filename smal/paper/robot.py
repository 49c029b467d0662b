"""`PaperRobot`: from an image to an atom by the paper's scheme."""

from collections.abc import Sequence

from smal.arrays import Uint8s
from smal.features import extract
from smal.movement import Atom
from smal.paper.execution import DecisionMaker, PaperDecision
from smal.paper.model import PaperModel
from smal.paper.recognition import Recognizer


class PaperRobot:
    """Drives as in the paper: l frames, their state (Eq. 9), the l atoms of its action; decides every stride, or l."""

    #: The last decision, without "wait".
    decision: PaperDecision

    def __init__(self, model: PaperModel, stride: int | None = None) -> None:
        self._model = model
        self._stride = stride or model.sequence_length
        self._recognizer = Recognizer(model)
        self._maker = DecisionMaker(model)
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._recognizer.reset()
        self._maker.reset()
        self._tick = 0
        self.decision = PaperDecision("wait", ())

    def step(
        self,
        image: Uint8s,
        odometry: Sequence[float] | None = None,
        elapsed_s: float | None = None,
    ) -> Atom:
        """Return the atom until the next image (height, width, 3), RGB; odometry and time are ignored."""
        del odometry, elapsed_s
        raw = extract(image, self._model.feature_settings)
        # The first decision is due with the first whole window, the others follow at equal distances.
        due = (self._tick - (self._model.sequence_length - 1)) % self._stride == 0
        decision = self._maker.decide(self._recognizer.observe(self._tick, raw, due))
        self._tick += 1
        if decision.kind != "wait":
            self.decision = decision
        return self._maker.next_atom()

    @property
    def done(self) -> bool:
        """Whether the robot has announced its arrival."""
        return self.decision.kind == "goal"
