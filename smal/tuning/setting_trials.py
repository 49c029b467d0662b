"""Trying settings on two traverses whose features were made once, with all modalities that are candidates."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from smal.evaluation.ground_truth import Judgement, Truth, judge
from smal.features import FeatureSettings, select
from smal.place_recognition import Matches
from smal.place_recognition.matches import ignore
from smal.place_recognition.methods import METHODS, MatchSettings
from smal.place_recognition.traverse_centering import centre_traverses
from smal.place_recognition.traverse_matching import OrderedSettings, TraverseProducts, match_products

#: Methods that need only inner products, of which those of a weighted sum of modalities are made fast.
_BY_PRODUCTS: Final = ("smal", "image")
#: Where the inner products of all modalities take more than this, features are multiplied for every setting instead.
_MOST_BYTES: Final = 2**30


@dataclass(frozen=True, eq=False)
class TraversePair:
    """Two traverses and what is right.

    Parameters
    ----------
    references, queries : float32 arrays (n, m), (q, m)
        Raw features of `extract`.
    held : FeatureSettings
        Their modalities; the weights do not count.
    truth : Truth
        Of these q queries and n references.
    """

    references: NDArray[np.float32]
    queries: NDArray[np.float32]
    held: FeatureSettings
    truth: Truth


@dataclass(frozen=True, eq=False)
class ModalityProducts:
    """The inner products of two traverses by each modality alone.

    The features of several modalities are those of each, times its unit weight u, one after the other. So their
    inner products are the sums of those of each times u^2, and nothing is computed anew for other weights.
    """

    by_name: dict[str, TraverseProducts]

    @classmethod
    def of(cls, pair: TraversePair) -> Self:
        """Multiply the features of each modality, centred as the methods do."""
        found = {}
        for name, where in zip(pair.held.modalities, pair.held.slices, strict=True):
            alone = FeatureSettings.of((name,))
            centred = centre_traverses(pair.references[:, where], pair.queries[:, where], alone)
            found[name] = TraverseProducts.of(*centred)
        return cls(found)

    def weighted(self, features: FeatureSettings) -> TraverseProducts:
        """Return the inner products of the modalities together."""
        shares = [np.float32(weight * weight) for weight in features.unit_weights]
        parts = [self.by_name[name] for name in features.modalities]
        gram, products = np.zeros_like(parts[0].gram), np.zeros_like(parts[0].products)
        recent, squares = np.zeros_like(parts[0].recent), np.zeros_like(parts[0].norms)
        for share, part in zip(shares, parts, strict=True):
            gram += share * part.gram
            products += share * part.products
            recent += share * part.recent
            squares += float(share) * np.square(part.norms)
        return TraverseProducts(gram, products, np.sqrt(squares), recent)


class SettingTrials:
    """Evaluates settings of one method on pairs of traverses.

    Parameters
    ----------
    method : str
        A name in `METHODS`.
    pairs : sequence of TraversePair
        One trial each.
    """

    def __init__(self, method: str, pairs: tuple[TraversePair, ...]) -> None:
        self._method = method
        self._pairs = pairs
        self._products = [self._multiplied(pair) for pair in pairs] if method in _BY_PRODUCTS else []

    def __call__(self, settings: MatchSettings) -> list[Judgement]:
        """Match every pair and judge the matches."""
        return [judge(self.match(number, settings), pair.truth) for number, pair in enumerate(self._pairs)]

    def match(self, number: int, settings: MatchSettings) -> Matches:
        """Match one pair, as the method does."""
        products = self._products[number] if self._products else None
        if products is not None and settings.penalty is not None:
            own = OrderedSettings(length=settings.length, relative_penalty=settings.penalty)
            return match_products(products.weighted(settings.features), own, ignore)
        pair = self._pairs[number]
        references, queries = (select(raw, pair.held, settings.features) for raw in (pair.references, pair.queries))
        return METHODS[self._method].match(references, queries, settings, ignore)

    def _multiplied(self, pair: TraversePair) -> ModalityProducts | None:
        references, queries = pair.references.shape[0], pair.queries.shape[0]
        size = 4 * references * (references + queries) * len(pair.held.modalities) * len(self._pairs)
        return ModalityProducts.of(pair) if size <= _MOST_BYTES else None
