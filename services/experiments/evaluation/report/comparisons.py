"""What the report says in words: SMAL against every other method, long sequences against short ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from scipy.stats import binomtest

from services.experiments.evaluation.plan import CONTROLLERS, DEFAULT_LENGTH, Trial
from services.experiments.evaluation.report.summary import Recognized, Success, WorldResults, success_of

_CERTAIN: Final = 0.05
#: Frames from which on a sequence is a long one.
_LONG: Final = 20


@dataclass(frozen=True)
class Comparison:
    """What the report says in words: mostly SMAL against a peer.

    Attributes
    ----------
    verdict
        "ahead" or "behind" where the difference is more than chance (95 %), otherwise "open"; "counts" where nothing is
        tested.
    text
        One sentence with its numbers.
    """

    world: str
    verdict: Literal["ahead", "behind", "open", "counts"]
    text: str


def comparisons(found: WorldResults) -> list[Comparison]:
    """Return all that the report says of a world."""
    name = found.world.title
    return [
        *compare_recognition(name, found.recognized[0]),
        *compare_searches(name, found.successes),
        *long_sequences(name, found.successes),
    ]


def compare_recognition(world: str, found: Sequence[Recognized]) -> list[Comparison]:
    """Compare the areas under the curves: Eq. 9 at its default length against every other method."""
    compared = []
    for ours in found:
        if (ours.recognizer.name, ours.recognizer.length) != ("smal", DEFAULT_LENGTH):
            continue
        for peer in found:
            if peer.degradation != ours.degradation or (peer.recognizer.name == "smal" and peer.recognizer.length != 1):
                continue
            low, high = np.nanpercentile(ours.areas - peer.areas, [2.5, 97.5])
            verdict: Literal["ahead", "behind", "open"] = "ahead" if low > 0.0 else "behind" if high < 0.0 else "open"
            text = (
                f"recognition, {ours.degradation}: area {ours.curve.auc:.3f} of {ours.recognizer.title} against "
                f"{peer.curve.auc:.3f} of {peer.recognizer.title}, {_said('Eq. 9', verdict)} "
                f"(difference {low:+.3f} to {high:+.3f})"
            )
            compared.append(Comparison(world, verdict, text))
    return compared


def compare_searches(world: str, found: Sequence[Success]) -> list[Comparison]:
    """Compare success on the same drives, seeds and conditions: SMAL against every other, by the exact sign test."""
    compared = []
    for ours in found:
        if ours.trial.controller != "smal":
            continue
        for name in CONTROLLERS:
            peer = success_of(found, replace(ours.trial, controller=name))
            if peer is None or peer is ours:
                continue
            verdict, chance = _sign_test(ours, peer)
            drives = f"{ours.trial.drives} drive{'s' if ours.trial.drives > 1 else ''}"
            text = (
                f"searches after {drives}, {ours.trial.condition}: {ours.said} found by {ours.trial.title} "
                f"against {peer.said} by {peer.trial.title}, {_said('SMAL', verdict)} (p = {chance:.2g})"
            )
            compared.append(Comparison(world, verdict, text))
    return compared


def _sign_test(ours: Success, peer: Success) -> tuple[Literal["ahead", "behind", "open"], float]:
    seeds = ours.findings.keys() & peer.findings.keys()
    pairs = [tuple(one.findings[seed]["outcome"] == "found" for one in (ours, peer)) for seed in seeds]
    wins, losses = pairs.count((True, False)), pairs.count((False, True))
    if wins == losses:
        return "open", 1.0
    chance = float(binomtest(wins, wins + losses).pvalue)
    if chance >= _CERTAIN:
        return "open", chance
    return ("ahead" if wins > losses else "behind"), chance


def _said(ours: str, verdict: str) -> str:
    return "the difference may be chance" if verdict == "open" else f"{ours} is {verdict}"


def long_sequences(world: str, found: Sequence[Success]) -> list[Comparison]:
    """Compare, for every degradation, the longest sequences of the paper's scheme with the best of the short ones."""
    said = []
    paper = [one for one in found if one.trial.controller == "paper"]
    groups: dict[Trial, list[Success]] = {}
    for one in paper:
        groups.setdefault(replace(one.trial, length=1, runs=1), []).append(one)
    for trial, group in groups.items():
        each = sorted(group, key=lambda one: one.trial.length)
        short, long = ([one for one in each if (one.trial.length >= _LONG) == is_long] for is_long in (False, True))
        if not short or not long:
            continue
        best = max(short, key=lambda one: one.rate)
        counts = ", ".join(f"{one.said} at l = {one.trial.length}" for one in each)
        text = f"lengths of the paper's scheme, {trial.condition}: {counts}; {_long_against_short(long, best)}"
        said.append(Comparison(world, "counts", text))
    return said


def _long_against_short(long: Sequence[Success], best: Success) -> str:
    if not any(one.found for one in (*long, best)):
        return "no length finds the victim"
    losing = [one.trial.length for one in long if _sign_test(one, best)[0] == "behind"]
    if losing:
        return f"l = {', '.join(map(str, losing))} lose against l = {best.trial.length}"
    if all(one.rate >= best.rate for one in long):
        return "long sequences are as good as the best short one"
    return f"long sequences find it less often than l = {best.trial.length}, which may be chance"
