"""Large traverses: time of a match over one product of all features, and memory.

A made-up way is driven twice, at changing speed; its features have the size of those that `smal match` takes by
default, and are held as it holds them. All times are compared within one process.
"""

import resource
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from smal.place_recognition.matches import ignore
from smal.place_recognition.methods import FEATURES, METHODS, MatchSettings
from tests.benchmarks.recognition.benchmark import seconds_of
from tests.benchmarks.reporting import Parser, Record, say, table, verdict

#: Cosine of a scene with the next one, and entries of what lies behind features.
_SCENE = 0.97
_LATENT = 64
_NOISE: Final = (
    1.0,
    2.0,
)  # Length of noise beside that of what is shown, in references and queries.
_BLOCK = 500


FRAMES = (2_500, 10_000)
QUICK = (500, 1_000)


def scenes(rng: np.random.Generator, count: int, size: int) -> NDArray[np.float32]:
    """Return a scene (count, size) that changes smoothly."""
    steps = np.sqrt(1.0 - _SCENE**2) * rng.standard_normal((count, size), dtype=np.float32)
    for number in range(1, count):
        steps[number] += _SCENE * steps[number - 1]
    return steps


def seen(
    rng: np.random.Generator, shown: NDArray[np.float32], noise: float, size: int
) -> NDArray[np.float16]:
    """Return features (n, size) of scenes, as large as those of images are."""
    mixing = np.random.default_rng(0).standard_normal((shown.shape[1], size), dtype=np.float32)
    features = np.empty((len(shown), size), np.float16)
    for start in range(0, len(shown), _BLOCK):
        some = shown[start : start + _BLOCK] @ mixing / np.float32(np.sqrt(shown.shape[1]))
        some += noise * rng.standard_normal(some.shape, dtype=np.float32)
        features[start : start + _BLOCK] = some / np.float32(np.sqrt(size))
    return features


def over_product(frames: int) -> Record:
    """Match two traverses of so many frames; say how long that takes, and one product of their features."""
    rng = np.random.default_rng(frames)
    method = METHODS["smal"]
    shown = scenes(rng, frames, _LATENT)
    places = (
        np.cumsum(np.repeat(rng.choice([0.75, 1.0, 1.25, 1.5], frames // 50 + 1), 50))[
            :frames
        ].astype(int)
        % frames
    )
    references = seen(rng, shown, _NOISE[0], FEATURES.size)
    queries = seen(rng, shown[places], _NOISE[1], FEATURES.size)
    part = max(1, frames // 10)
    floats = references.astype(np.float32), queries[:part].astype(np.float32)
    product_s, _ = seconds_of(partial(lambda known, asked: asked @ known.T, *floats))
    del floats
    match_s, found = seconds_of(
        lambda: method.match(references, queries, MatchSettings(FEATURES), ignore)
    )
    product_s *= frames / part
    return {
        "frames": frames, "product_s": product_s, "match_s": match_s, "ratio": match_s / product_s,
        "right": float((np.abs(found.reference - places) <= 5).mean()), "score": float(found.score.mean()),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }  # fmt: skip


def benchmark(frames: tuple[int, ...]) -> dict[str, Any]:
    """Measure everything."""
    traverses = [over_product(count) for count in tqdm(frames, desc="matching", dynamic_ncols=True)]
    last = traverses[-1]
    targets = [
        verdict("seconds", float(str(last["match_s"])), 60.0),
        verdict("gigabytes", float(str(last["peak_gb"])), 2.0),
    ]
    return {"benchmark": "places", "traverses": traverses, "targets": targets}


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    flags = Parser("places", __doc__).parse(arguments)
    results = benchmark(QUICK if flags.quick else FRAMES)
    text = table("Matching two traverses, over one product of their features", results["traverses"])
    say(flags, results, text + table("Of the largest traverses", results["targets"]))
