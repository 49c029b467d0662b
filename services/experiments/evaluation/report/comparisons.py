"""What the report says in words: SMAL against every other method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.stats import binomtest

from services.experiments.evaluation.plan import DEFAULT_LENGTH
from services.experiments.evaluation.report.summary import Recognized, Success

_CERTAIN: Final = 0.05


@dataclass(frozen=True)
class Comparison:
    """A sentence with its numbers, mostly of SMAL against a peer.

    The verdict is "ahead" or "behind" where the difference is more than chance (95 %), otherwise "open".
    """

    world: str
    verdict: str
    text: str


def compare_recognition(world: str, found: Sequence[Recognized]) -> list[Comparison]:
    """Compare the areas under the curves: Eq. 9 at its default length against every other method."""
    compared = []
    for ours in found:
        if not ours.recognizer.eq9 or ours.recognizer.length != DEFAULT_LENGTH:
            continue
        for peer in found:
            if peer.degradation != ours.degradation or (peer.recognizer.eq9 and peer.recognizer.length != 1):
                continue
            low, high = np.nanpercentile(ours.areas - peer.areas, [2.5, 97.5])
            verdict = "ahead" if low > 0.0 else "behind" if high < 0.0 else "open"
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
        for peer in found:
            same = replace(peer.trial, controller="smal", runs=ours.trial.runs) == ours.trial
            if ours.trial.controller != "smal" or peer is ours or not same:
                continue
            verdict, chance = _sign_test(ours, peer)
            drives = f"{ours.trial.drives} drive{'s' if ours.trial.drives > 1 else ''}"
            text = (
                f"searches after {drives}, {ours.trial.condition}: {ours.said} found by {ours.trial.title} "
                f"against {peer.said} by {peer.trial.title}, {_said('SMAL', verdict)} (p = {chance:.2g})"
            )
            compared.append(Comparison(world, verdict, text))
    return compared


def _sign_test(ours: Success, peer: Success) -> tuple[str, float]:
    pairs = [(one == "found", other == "found") for one, other in zip(ours.outcomes, peer.outcomes, strict=False)]
    wins, losses = pairs.count((True, False)), pairs.count((False, True))
    chance = float(binomtest(wins, wins + losses).pvalue) if wins != losses else 1.0
    if chance >= _CERTAIN:
        return "open", chance
    return ("ahead" if wins > losses else "behind"), chance


def _said(ours: str, verdict: str) -> str:
    return "the difference may be chance" if verdict == "open" else f"{ours} is {verdict}"
