"""What the soak says of samples that grow, and of those that do not; and its command line."""

import numpy as np
import pytest

from tests.benchmarks.soak import Held, Sample, judge, judge_page, warmed_up


def hour(
    growth: float = 0.0, descriptors: int = 0, threads: int = 0, pids: tuple[int, ...] = (7,)
) -> list[Sample]:
    rng = np.random.default_rng(1)
    samples = []
    for k in range(361):
        share = k / 360.0
        warming = 3e7 * min(1.0, k / 12)  # what is allocated in the first two minutes is no growth
        size = int(warming + 2e8 * (1.0 + growth * share) + rng.normal(0.0, 1e6))
        comes_and_goes = int(rng.integers(0, 2))
        samples.append(
            Sample(10.0 * k, "policy", pids[int(share * (len(pids) - 1))], size,
                   20 + round(descriptors * share) + comes_and_goes, 9 + round(threads * share))
        )  # fmt: skip
    return samples


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        (hour(), "met"),
        (hour(growth=0.10), "NOT MET: memory"),
        (hour(descriptors=4), "NOT MET: descriptors"),
        (hour(threads=3), "NOT MET: threads"),
        (hour(pids=(7, 8)), "NOT MET: restarted"),
    ],
)
def test_a_service_that_grows_or_has_died_is_named(samples: list[Sample], said: str) -> None:
    (found,) = judge(samples)
    assert found[""] == said


def watching(kilobytes: int = 0, nodes: int = 0, listeners: int = 0) -> list[Held]:
    """Return what a page holds in ten minutes of which it grows by so much after the warm-up."""
    rng = np.random.default_rng(2)
    samples = []
    for minute in range(11):
        share = max(0, minute - 2) / 8
        size = int(9e5 + 1e5 * min(minute, 2) + 1000 * kilobytes * share + rng.normal(0.0, 3e4))
        lines = min(50, 5 * minute) * 4
        samples.append(
            Held(
                60.0 * minute,
                size,
                400 + lines + round(nodes * share),
                54 + round(listeners * share),
            )
        )
    return samples


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        (watching(), "met"),  # it fills up
        (watching(kilobytes=900), "NOT MET: memory"),
        (watching(nodes=480), "NOT MET: nodes"),  # one a second
        (watching(listeners=8), "NOT MET: listeners"),  # one a minute
    ],
)
def test_a_page_that_grows_is_named(samples: list[Held], said: str) -> None:
    assert judge_page(warmed_up(samples))[""] == said
