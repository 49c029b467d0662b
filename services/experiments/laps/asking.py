"""Learn one lap and localize each frame of the others, open loop, with every method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.laps.finding import Lap
from services.experiments.laps.source import JUDGED
from services.kit.errors import JobError
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.reliability import Reliability
from smal.evaluation.teach_and_repeat import TeachAndRepeat
from smal.features import Centering
from smal.model import Model
from smal.movement import Atom
from smal.robot import Localizer
from smal.teaching.demonstration import Demonstration
from smal.teaching.mapping import learn

# Fraction of a lap within which an answer is correct; probabilities refer to it.
WITHIN: Final = 0.1
# A robot is lost above this probability, and confident below that one.
LOST = 0.5
SURE = 0.1
#: For each frame (f, 3): the taught frame, its probability, and the probability of being lost. NaN
#: marks missing values.
Answers = NDArray[np.float64]
_Method = Callable[[Demonstration], Answers]


@dataclass(frozen=True, eq=False)
class Judged:
    """Answers (q, 3) to all queries, their errors in laps (q,), and figures with 95 % intervals."""

    answers: Answers
    off: NDArray[np.float64]
    reliability: Reliability | None
    figures: dict[str, float | list[float]]


def ask(
    laps: Sequence[tuple[Demonstration, Lap]], advance: Callable[[str, int, int], None]
) -> dict[str, Judged]:
    """Learn the first lap, localize on all others, and evaluate; raise JobError if learning fails."""
    (taught, _), *asked = laps
    found = {}
    for name, method in _methods(taught, advance).items():
        answers = []
        for done, (drive, _) in enumerate(asked, 1):
            answers.append(method(drive))
            advance(f"localizing with {name}", done, len(asked))
        found[name] = judge(answers, [lap.shows for _, lap in asked], len(taught.atoms))
    return found


def judge(answers: Sequence[Answers], truths: Sequence[NDArray[np.intp]], lap: int) -> Judged:
    """Compare the answers to each lap with the ground truth, in frames of a taught lap."""
    said = np.concatenate(answers)
    frames, likely, lost = said.T
    off = _apart(frames, np.concatenate(truths), lap)
    right = off <= WITHIN
    probable = not np.isnan(likely).any()
    shares = {"right within a twentieth": off <= WITHIN / 2.0, "right within a tenth": right}
    shares |= {"lost": lost > LOST, "wrong and sure": ~right & (lost < SURE)} if probable else {}
    figures: dict[str, float | list[float]] = {}
    drawn = np.random.default_rng(0).integers(len(truths), size=(2000, len(truths)))
    for name, share in shares.items():
        parts = np.split(share, np.cumsum([len(truth) for truth in truths])[:-1])
        hits, frames_ = np.array([(part.sum(), len(part)) for part in parts])[drawn].sum(axis=1).T
        figures |= {
            name: float(share.mean()),
            f"{name}, 95 %": np.quantile(hits / frames_, (0.025, 0.975)).tolist(),
        }
    every = np.ones(len(said), dtype=np.bool_)
    reliability = (
        Reliability.of(Judgement(likely, every, right, every, every)) if probable else None
    )
    return Judged(
        said,
        off,
        reliability,
        figures | ({"calibration error": reliability.error} if reliability else {}),
    )


def _apart(frames: NDArray[Any], others: NDArray[Any] | float, lap: int) -> NDArray[np.float64]:
    """Return the circular distances of frames as a share of a lap; 1 for a missing frame."""
    share = np.abs(frames - others) / lap % 1.0
    return np.where(np.isnan(share), 1.0, np.minimum(share, 1.0 - share))


def _methods(taught: Demonstration, advance: Callable[[str, int, int], None]) -> dict[str, _Method]:
    """Return the methods by name; methods by odometry only if the lap has odometry."""
    found: dict[str, _Method] = {
        f"nearest {count}": partial(_nearest, taught, count) for count in (1, 5)
    }
    try:
        blind = learn([replace(taught, odometry=None)], JUDGED, progress=advance)
        found = {"SMAL without odometry": partial(_smal, blind)} | found
        if taught.odometry is not None:
            model = learn([taught], JUDGED, progress=advance)
            repeat = TeachAndRepeat([taught], model.mapped.field_rad, told=True)
            found = (
                {"SMAL": partial(_smal, model)}
                | found
                | {"teach and repeat": partial(_repeating, repeat)}
            )
    except ValueError as error:
        raise JobError(f"cannot learn from {taught.name}: {error}") from None
    return found


def _smal(model: Model, asked: Demonstration) -> Answers:
    """Run the filter, with odometry if the map has it."""
    robot = Localizer(model)
    keyframes = model.mapped.keyframes
    answers = []
    for frame, raw in enumerate(asked.features):
        made = [Atom(int(asked.atoms[frame - 1]))] if frame else []
        belief = robot.observe(
            raw, None if asked.odometry is None else asked.odometry[frame].tolist(), made
        )
        best = int(keyframes[belief.summary(1).keyframes[0]])
        near = belief.share(_apart(keyframes, best, len(model.mapped.poses)) <= WITHIN)
        answers.append((best, min((1.0 - belief.lost) * near, 1.0), belief.lost))
    return np.array(answers, dtype=np.float64)


def _nearest(taught: Demonstration, window: int, asked: Demonstration) -> Answers:
    """Return the frame whose window on the closed lap has the largest sum of cosines.

    The first windows are shorter.
    """
    centering = Centering.fit(taught.rows, JUDGED)
    rows = centering.apply(asked.rows) @ centering.apply(taught.rows).T
    for_each = [
        np.pad(np.roll(rows, back, axis=1), ((back, 0), (0, 0)))[: len(rows)]
        for back in range(window)
    ]
    return _only(np.sum(for_each, axis=0).argmax(axis=1))


def _repeating(repeat: TeachAndRepeat, asked: Demonstration) -> Answers:
    """Run teach and repeat from the first goal and return its interval between goals, open loop."""
    assert asked.images is not None and asked.odometry is not None  # noqa: S101, PT018 - only such laps are asked
    repeat.reset()
    places = []
    for image, pose in zip(asked.images, asked.odometry.tolist(), strict=True):
        repeat.step(image, pose)
        places.append(np.nan if repeat.place is None else repeat.place.frame)
    return _only(np.array(places))


def _only(frames: NDArray[Any]) -> Answers:
    return np.column_stack([frames, np.full(len(frames), np.nan), np.zeros(len(frames))])
