"""Recognition by the paper: time of a match (Eq. 7) over one product X^T Y, against Algorithm 2 and CVXPY.

All processor times are compared within one process with one thread, on a synthetic video, and on 12 noisy drives of
one route. A ratio is the median over repetitions of a query, in which product and match take turns; of these the
median and the worst over queries are reported. Algorithm 2 as published runs until its objective is within 1e-4 of
ours, or until it has converged.
"""

import importlib
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from services.kit.errors import JobError
from smal.paper.objective import objective
from smal.paper.state_matching import solve, usual_lambda
from tests.benchmarks.recognition.algorithm2 import algorithm2
from tests.benchmarks.recognition.convergence import convergence, objective_figure
from tests.benchmarks.reporting import Parser, Record, say, table

TOLERANCE: Final = 1e-4
#: Cosine of successive frames of the video, of its scene alone, and of a query frame with its own frame.
SUCCESSIVE = 0.9
SCENE = 0.97
QUERY = 0.8
_REPETITIONS: Final = 5
_MAX_ITERATIONS: Final = 500
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Plan:
    """Sizes of everything: template frames n and lengths l of the ratios, and (n, l) of the comparisons with peers.

    The second problem of each length is a number of noisy drives of a route.
    """

    n: int = 10_000
    drives: int = 12
    route: int = 100
    lengths: tuple[int, ...] = (1, 5, 10, 20)
    features: int = 4096
    queries: int = 5
    repetitions: int = 3
    peers: tuple[tuple[int, int], ...] = ((500, 5), (500, 10), (1_000, 5), (1_000, 10))


QUICK: Final = Plan(n=2_000, queries=3, peers=((500, 5),))


class Problem(NamedTuple):
    """Templates (m, n), queries (m, l), l, and both lambda1 and lambda2."""

    templates: NDArray[np.float32]
    queries: list[NDArray[np.float32]]
    length: int
    penalty: float

    def solve(self, query: int = 0, tolerance: float = TOLERANCE) -> Any:
        """Match one of the queries."""
        return solve(
            self.templates, self.queries[query], self.length, self.penalty, self.penalty, tolerance
        )


def video(frames: int, features: int) -> NDArray[np.float32]:
    """Return unit vectors (frames, features) of a scene that changes smoothly, with noise in each frame."""
    rng = np.random.default_rng(1)
    share = np.sqrt(SUCCESSIVE / SCENE)
    noise, steps = (rng.standard_normal((frames, features), dtype=np.float32) for _ in range(2))
    scene = rng.standard_normal(features)
    shown = np.empty_like(noise)
    for k in range(frames):
        scene = SCENE * scene + np.sqrt(1.0 - SCENE**2) * steps[k]
        shown[k] = share * scene + np.sqrt(1.0 - share**2) * noise[k]
    return shown / np.linalg.norm(shown, axis=1, keepdims=True)


def noisy(shown: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return another view of each frame, with new noise."""
    noise = rng.standard_normal(shown.shape, dtype=np.float32)
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    return (QUERY * shown + np.sqrt(1.0 - QUERY**2) * noise).astype(np.float32)


def problem(shown: NDArray[np.float32], length: int, queries: int, drives: int = 0) -> Problem:
    """Take frames as templates, or noisy drives of them; queries are noisy views of them at any phase."""
    n = len(shown)
    rng = np.random.default_rng((n, length))
    starts = rng.integers(0, n - length, queries, endpoint=True)
    views = [noisy(shown[start : start + length], rng).T for start in starts]
    templates = [noisy(shown, rng) for _ in range(drives)] or [shown]
    return Problem(np.concatenate(templates).T, views, length, usual_lambda(length))


def seconds_of(call: Callable[[], Answer]) -> tuple[float, Answer]:
    """Call once; return the processor time and the answer."""
    began = time.process_time()
    answer = call()
    return time.process_time() - began, answer


def over_product(one: Problem, repetitions: int) -> Record:
    """Time all queries; the product and the match take turns."""
    answers = [one.solve(k) for k in range(len(one.queries))]
    times = np.array([
        [[seconds_of(partial(np.matmul, one.templates.T, query))[0], seconds_of(partial(one.solve, k))[0]]
         for _ in range(repetitions)]
        for k, query in enumerate(one.queries)
    ])  # fmt: skip
    ratios = np.median(times[..., 1] / times[..., 0], axis=1)
    product_s, match_s = np.median(times, axis=(0, 1))
    return {
        "n": one.templates.shape[1],
        "m": one.templates.shape[0],
        "l": one.length,
        "sequences": float(np.median([len(each.active_blocks) for each in answers])),
        "product_ms": 1e3 * float(product_s),
        "match_ms": 1e3 * float(match_s),
        "ratio": float(np.median(ratios)),
        "ratio_worst": float(ratios.max()),
        "duality_gap": max(each.duality_gap for each in answers),
        "converged": all(each.converged for each in answers),
    }


def against_algorithm2(one: Problem) -> Record:
    """Run Algorithm 2 as published until its objective is close to ours; where it never is, until it has converged."""
    ours_s, ours = _ours(one, TOLERANCE)
    run = partial(algorithm2, one.templates, one.queries[0], one.length, one.penalty, one.penalty)
    above = np.array(run(max_iterations=_MAX_ITERATIONS).objectives) / ours - 1.0
    close = np.flatnonzero(above <= TOLERANCE)
    iterations = int(close[0]) + 1 if close.size else len(above)
    seconds, _ = seconds_of(lambda: run(tolerance=0.0, max_iterations=iterations))
    return {"peer": "Algorithm 2", "n": one.templates.shape[1], "l": one.length, "iterations": iterations,
            "excess": float(above[iterations - 1]), "seconds": seconds, "our_seconds": ours_s,
            "times_faster": seconds / ours_s}  # fmt: skip


def against_cvxpy(one: Problem) -> Record:
    """Solve with CVXPY and Clarabel, after a QR factorisation of [X Y], which changes no residual."""
    try:
        cp: Any = importlib.import_module("cvxpy")  # takes seconds, and only developers have it
    except ImportError:
        raise JobError("CVXPY is not installed (deploy/requirements/dev.txt)") from None
    n = one.templates.shape[1]
    both = np.hstack([one.templates, one.queries[0]]).astype(np.float64)
    both = np.linalg.qr(both, mode="r") if both.shape[0] > both.shape[1] else both
    W = cp.Variable((n, one.length))
    blocks = [
        cp.norm(W[start : start + one.length], 2, axis=0) for start in range(0, n, one.length)
    ]
    penalties = cp.sum(cp.norm(W, 2, axis=1)) + cp.sum(cp.hstack(blocks))
    residuals = cp.sum(cp.norm(both[:, :n] @ W - both[:, n:], 2, axis=0))
    task = cp.Problem(cp.Minimize(residuals + one.penalty * penalties))
    seconds, _ = seconds_of(lambda: task.solve(solver=cp.CLARABEL))
    theirs = objective(one.templates, one.queries[0], W.value, one.length, one.penalty, one.penalty)
    ours_s, ours = _ours(one, TOLERANCE / 10.0)
    return {"peer": "CVXPY", "n": n, "l": one.length, "iterations": task.solver_stats.num_iters,
            "excess": theirs / ours - 1.0, "seconds": seconds, "our_seconds": ours_s,
            "times_faster": seconds / ours_s}  # fmt: skip


def _ours(one: Problem, tolerance: float) -> tuple[float, float]:
    """Return the median time of our solver, and its objective."""
    runs = [seconds_of(partial(one.solve, tolerance=tolerance)) for _ in range(_REPETITIONS)]
    return float(np.median([seconds for seconds, _ in runs])), runs[0][1].objective


def benchmark(plan: Plan) -> dict[str, Any]:
    """Measure everything."""
    shown = video(max(plan.n, *(n for n, _ in plan.peers)), plan.features)
    problems = [(plan.n, 0, length) for length in plan.lengths]
    problems += [(plan.route, plan.drives, length) for length in plan.lengths]
    matching = [over_product(problem(shown[:n], length, plan.queries, drives), plan.repetitions)
                for n, drives, length in tqdm(problems, desc="matching", dynamic_ncols=True)]  # fmt: skip
    peers = [compare(problem(shown[:n], length, 1))
             for n, length in tqdm(plan.peers, desc="comparing", dynamic_ncols=True)
             for compare in (against_algorithm2, against_cvxpy)]  # fmt: skip
    n, length = plan.peers[0]
    one = problem(shown[:n], length, 1)
    curves = convergence(one.templates, one.queries[0], one.length, (one.penalty, one.penalty))
    return {"benchmark": "recognition", "tolerance": TOLERANCE, "matching": matching, "peers": peers,
            "convergence": curves}  # fmt: skip


def main(arguments: list[str]) -> None:
    """Read the flags, measure, print and write."""
    flags = Parser("recognition", __doc__).parse(arguments)
    results = benchmark(QUICK if flags.quick else Plan())
    text = table(
        "Time over one float32 product X^T Y (median and worst over queries)", results["matching"]
    )
    say(flags, results, text + table("Against peers, to the same objective", results["peers"]))
    if flags.out is not None:
        objective_figure({"a synthetic video": results["convergence"]}).savefig(
            flags.out / "convergence.png", dpi=130
        )
        sys.stdout.write(f"picture: {flags.out / 'convergence.png'}\n")
