"""Large traverses: time of a match over one product of all features, memory; and an index of views on disk.

A made-up way is driven twice, at changing speed; its features have the size of those that `smal match` takes by
default, and are held as it holds them. The index is asked for views that were disturbed, and compared with looking at
all views. All times are compared within one process.
"""

from __future__ import annotations

import resource
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from smal.place_index import PlaceIndex
from smal.place_recognition.matches import ignore
from smal.place_recognition.methods import FEATURES, METHODS, MatchSettings
from tests.benchmarks.recognition.benchmark import seconds_of
from tests.benchmarks.reporting import Parser, Record, say, table, verdict

#: Cosine of a scene with the next one, entries of what lies behind features, and entries of an indexed view.
_SCENE, _LATENT, _VIEW = 0.97, 64, 128
#: Length of noise beside that of what is shown, in references, queries and views that the index is asked for.
_NOISE: Final = (1.0, 2.0, 1.0)
_ASKED, _BLOCK = 200, 500


@dataclass(frozen=True)
class Plan:
    """Frames of both traverses, views of indices, and candidates that an index is asked for."""

    frames: tuple[int, ...] = (2_500, 10_000)
    views: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
    candidates: tuple[int, ...] = (200, 1_000, 5_000)


QUICK: Final = Plan(frames=(500, 1_000), views=(1_000, 10_000, 100_000))


def scenes(rng: np.random.Generator, count: int, size: int) -> NDArray[np.float32]:
    """Return a scene (count, size) that changes smoothly."""
    steps = np.sqrt(1.0 - _SCENE**2) * rng.standard_normal((count, size), dtype=np.float32)
    for number in range(1, count):
        steps[number] += _SCENE * steps[number - 1]
    return steps


def seen(rng: np.random.Generator, shown: NDArray[np.float32], noise: float, size: int) -> NDArray[np.float16]:
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
    rng, method = np.random.default_rng(frames), METHODS["smal"]
    shown = scenes(rng, frames, _LATENT)
    places = (
        np.cumsum(np.repeat(rng.choice([0.75, 1.0, 1.25, 1.5], frames // 50 + 1), 50))[:frames].astype(int) % frames
    )
    references = seen(rng, shown, _NOISE[0], FEATURES.size)
    queries = seen(rng, shown[places], _NOISE[1], FEATURES.size)
    part = max(1, frames // 10)
    floats = references.astype(np.float32), queries[:part].astype(np.float32)
    product_s, _ = seconds_of(partial(lambda known, asked: asked @ known.T, *floats))
    del floats
    match_s, found = seconds_of(lambda: method.match(references, queries, MatchSettings(FEATURES), ignore))
    product_s *= frames / part
    return {
        "frames": frames, "product_s": product_s, "match_s": match_s, "ratio": match_s / product_s,
        "right": float((np.abs(found.reference - places) <= 5).mean()), "score": float(found.score.mean()),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }  # fmt: skip


def indexed(views: int, candidates: tuple[int, ...], folder: Path) -> list[Record]:
    """Index views on disk, and ask for disturbed ones; an answer is right that looking at all views gives too."""
    rng = np.random.default_rng(views)
    vectors = np.lib.format.open_memmap(folder / f"{views}.npy", "w+", np.float16, (views, _VIEW))
    shown = scenes(rng, views, _VIEW)
    vectors[:] = shown / np.linalg.norm(shown, axis=1, keepdims=True)
    asked = shown[rng.integers(0, views, _ASKED)]
    asked = asked + _NOISE[2] * rng.standard_normal(asked.shape, dtype=np.float32)
    build_s, index = seconds_of(lambda: PlaceIndex.build(vectors))
    all_s, best = seconds_of(lambda: (np.asarray(vectors, np.float32) @ asked.T).argmax(axis=0))

    def ask(count: int) -> list[tuple[int, int]]:
        near = [index.near(query, count) for query in asked]
        return [(int(some[(vectors[some].astype(np.float32) @ query).argmax()]), some.size)
                for some, query in zip(near, asked, strict=True)]  # fmt: skip

    rows: list[Record] = []
    for count in candidates:
        query_s, found = seconds_of(lambda count=count: ask(count))
        off = np.abs(np.array([one for one, _ in found]) - best)
        rows.append({"views": views, "build_s": build_s, "looked_at": float(np.mean([size for _, size in found])),
                     "query_ms": 1e3 * query_s / _ASKED, "all_ms": 1e3 * all_s / _ASKED,
                     "recall": float((off == 0).mean()), "recall_within_5": float((off <= 5).mean())})  # fmt: skip
    return rows


def benchmark(plan: Plan) -> dict[str, Any]:
    """Measure everything."""
    traverses = [over_product(frames) for frames in tqdm(plan.frames, desc="matching", dynamic_ncols=True)]
    with tempfile.TemporaryDirectory(prefix="smal-bench-") as folder:
        index = [row for views in tqdm(plan.views, desc="indexing", dynamic_ncols=True)
                 for row in indexed(views, plan.candidates, Path(folder))]  # fmt: skip
    last = traverses[-1]
    targets = [
        verdict("seconds", float(str(last["match_s"])), 60.0),
        verdict("gigabytes", float(str(last["peak_gb"])), 2.0),
    ]
    return {"benchmark": "places", "traverses": traverses, "index": index, "targets": targets}


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    flags = Parser("places", __doc__).parse(arguments)
    results = benchmark(QUICK if flags.quick else Plan())
    text = table("Matching two traverses, over one product of their features", results["traverses"])
    text += table("An index of views on disk: a query, beside looking at all views", results["index"])
    say(flags, results, text + table("Of the largest traverses", results["targets"]))
