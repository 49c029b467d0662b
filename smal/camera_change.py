"""Change of the camera's pitch since teaching: estimate it against the map, and undo it in percepts.

A camera that was mounted anew points up or down by a few degrees. The views of the map are level:
5 degrees halve the cosine of a view with the taught view of its place. A camera that sits higher
or lower looks nearly like a pitched camera. Zoom needs no correction, because it hardly changes
how alike views are.

Each pitch is a hypothesis. At places where the robot is certain, the small picture of a frame is
warped by every hypothesis, and each result is compared with all taught views near the place. So an
error of the estimated place has no influence. The log likelihoods of the views add up, each for the
part that is new. The taught pitch has the prior; another pitch replaces the present one only if it
is clearly more likely.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from smal.arrays import Float32s, Uint8s
from smal.camera import STEP_DEG, Maps, remapped
from smal.features import Centering, extract
from smal.features.percept import Percept
from smal.features.resizing import PIXELS, fitted, resized, small
from smal.files.packed import unpacked
from smal.likelihood import ANY_DAY, standing_out
from smal.map import VisualMap, beside


@dataclass(frozen=True)
class PitchConfig:
    """Parameters of the estimation of the camera's pitch."""

    #: Hypotheses: half of the turn between virtual views apart, within which a view hardly changes.
    pitches_deg: tuple[float, ...] = tuple(STEP_DEG / 2.0 * step for step in range(-3, 4))
    #: Prior probability that the camera has changed.
    changed: float = 0.01
    #: Probability from which a pitch replaces the present pitch.
    clear: float = 0.95
    #: Probability of being near one place, and not lost, from which a view is compared.
    certain: float = 0.5
    #: Way, in correlation lengths, over which older evidence loses half of its weight.
    half_lengths: float = 10.0
    #: Way between compared views, in correlation lengths, when the pitch is clear.
    apart_lengths: float = 1.0
    #: Hypotheses that are compared in a frame: about 2 ms each.
    in_a_frame: int = 2


PITCH_CONFIG: Final = PitchConfig()


@dataclass
class _Comparison:
    """The comparison of one frame, a few hypotheses at a time."""

    picture: Uint8s
    #: (n, r) taught views near the place.
    views: Float32s
    #: Way since the last compared frame, in correlation lengths.
    lengths: float
    scores: list[float]


class CameraPitch:
    """Estimates how far the camera points down from its taught pitch, and levels percepts.

    Parameters
    ----------
    visual_map : VisualMap
    centering : Centering
    config : PitchConfig
    """

    def __init__(
        self, visual_map: VisualMap, centering: Centering, config: PitchConfig = PITCH_CONFIG
    ) -> None:
        self._map = visual_map
        self._centering = centering
        self._config = config
        width, height = visual_map.size
        self._shape = fitted((height, width), PIXELS)
        self._spacing = 1.0 / visual_map.config.views_a_length
        self._computable = centering.settings.computable
        self.reset()

    def reset(self, pitch_deg: float = 0.0) -> None:
        """Start a new episode; `pitch_deg` is held until another pitch is clearly more likely."""
        count = len(self._config.pitches_deg)
        pitches_deg = np.array(self._config.pitches_deg)
        level = pitches_deg == 0.0
        prior = np.where(level, 1.0 - self._config.changed, self._config.changed / (count - 1))
        self._prior = np.log(prior)
        self._evidence = np.zeros(count)
        self._held = int(np.abs(pitches_deg - pitch_deg).argmin())
        self._apart = self._spacing
        self._lengths = math.inf
        self._comparing: _Comparison | None = None

    @property
    def pitch_deg(self) -> float:
        """Estimated angle by which the camera points further down than when it was taught."""
        return self._config.pitches_deg[self._held]

    def levelled(self, percept: Percept) -> Percept:
        """Return the percept that the taught camera has at this place."""
        if percept.picture is None or self.pitch_deg == 0.0:
            return percept
        view = self._warped(percept.picture, self._held)
        return Percept(extract(view, self._centering.settings), small(view), percept.detected)

    def compare(
        self, picture: Uint8s | None, keyframe: int, certainty: float, lengths: float
    ) -> None:
        """Take the picture of a frame into account, as far as the time of a frame allows.

        Without the network of the features the pitch is not estimated.

        Parameters
        ----------
        picture : array, optional
            Small picture of the frame, not levelled.
        keyframe : int
            Most likely keyframe.
        certainty : float
            Probability of being near it.
        lengths : float
            Way since the frame before, in correlation lengths.
        """
        self._lengths += lengths
        if self._comparing is None:
            self._comparing = self._begun(picture, keyframe, certainty)
        if self._comparing is not None:
            self._go_on(self._comparing)

    def _begun(self, picture: Uint8s | None, keyframe: int, certainty: float) -> _Comparison | None:
        """Begin a comparison if the view is new and the place is certain."""
        certain = certainty >= self._config.certain and self._lengths >= self._apart
        if picture is None or not certain or not self._computable:
            return None
        near = beside(self._map, keyframe, self._map.config.neighbours)
        views = unpacked(self._map.views[near]).reshape(-1, self._map.basis.shape[1])
        lengths = min(self._lengths, 1.0)
        self._lengths = 0.0
        return _Comparison(picture, views, lengths, [])

    def _go_on(self, comparing: _Comparison) -> None:
        """Compare the next hypotheses; after the last, add the evidence and choose."""
        done = len(comparing.scores)
        count = len(self._config.pitches_deg)
        some = range(done, min(done + self._config.in_a_frame, count))
        pictures = [self._warped(comparing.picture, number) for number in some]
        raw = np.stack([extract(view, self._centering.settings) for view in pictures])
        described = map(self._map.described, self._centering.apply(raw))
        comparing.scores += [self._log_likelihood(row, comparing.views) for row in described]
        if len(comparing.scores) < count:
            return
        self._comparing = None
        way = comparing.lengths * self._map.correlation_length
        same = self._map.expected(np.array([way, 0.0, 0.0]))
        newness = (1.0 - same) / (1.0 + same)
        kept = 0.5 ** (comparing.lengths / self._config.half_lengths)
        self._evidence = kept * self._evidence + newness * np.array(comparing.scores)
        self._choose()

    def _choose(self) -> None:
        """Hold the most likely pitch if it is clearly more likely than the present pitch."""
        log_odds = self._prior + self._evidence
        second, best = np.argsort(log_odds)[-2:].tolist()
        clear = math.log(self._config.clear / (1.0 - self._config.clear))
        if log_odds[best] - log_odds[self._held] > clear:
            self._held = best
        is_clear = best == self._held and log_odds[best] - log_odds[second] > clear
        self._apart = self._config.apart_lengths if is_clear else self._spacing

    def _log_likelihood(self, components: Float32s, views: Float32s) -> float:
        """Return the log likelihood ratio of components (r,) near a place to elsewhere."""
        z = standing_out((views @ components).max(), self._map.sample @ components)
        return math.log(float(self._map.likelihood.mixed(ANY_DAY, z, 1.0)))

    def _warped(self, picture: Uint8s, number: int) -> Uint8s:
        """Return the level view of a small picture under a hypothesis."""
        return remapped(resized(picture, *self._shape), self._maps[number])

    @cached_property
    def _maps(self) -> list[Maps]:
        """Positions of the pixels of the level view under each hypothesis."""
        still = (0.0, 0.0, 0.0)
        return [
            self._map.taught_scene.maps(self._shape, still, pitch_rad=math.radians(pitch))
            for pitch in self._config.pitches_deg
        ]
