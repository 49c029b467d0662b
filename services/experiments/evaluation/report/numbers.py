"""The numbers of all figures, for ``results.json``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from services.experiments.evaluation.report.summary import Recognized, Results, Success
from services.experiments.evaluation.schedule import settings_of


def as_json(found: Sequence[Results]) -> dict[str, Any]:
    """Return the numbers of all figures."""
    return {
        one.world.title: {
            "recognition": [
                _recognized_json(each, criterion.meaning)
                for criterion, judged in zip(one.world.criteria, one.recognized, strict=True)
                for each in judged
            ],
            "searches": [_success_json(each) for each in one.successes],
            "errands": {
                name: {key: value for key, value in each.items() if key != "cpu_s"}
                for name, each in one.errands.items()
            },
            "objective": one.objective and {name: value for name, value in one.objective.items() if name != "cpu_s"},
        }
        for one in found
    }


def _recognized_json(one: Recognized, criterion: str) -> dict[str, Any]:
    curve = one.curve
    return {
        "method": one.recognizer.name,
        "length": one.recognizer.length,
        "degradation": one.degradation,
        "criterion": criterion,
        "queries": int(one.judgement.score.size),
        "findable": int(one.judgement.findable.sum()),
        "auc": curve.auc,
        "auc_95": list(one.auc_95),
        "auc_from_start": one.auc_from_start,
        "recall_at_100_precision": curve.recall_at_100_precision,
        "recall_at_100_precision_95": list(one.recall_95),
        "recall": curve.recall.round(5).tolist(),
        "precision": curve.precision.round(5).tolist(),
    }


def _success_json(one: Success) -> dict[str, Any]:
    return {
        **dict(settings_of(one.trial)),
        "condition": one.trial.condition,
        "found": one.found,
        "runs": one.runs,
        "success_rate": one.rate,
        "wilson_95": list(one.wilson_95),
        "spl": one.spl,
        "aside_rms_m": one.aside_rms_m,
        "aside_max_m": one.aside_max_m,
        "interventions_per_km": one.interventions_per_km,
        "wrong_share": one.wrong_share,
        "right_within_3_s": one.right_within(3.0),
        "outcomes": {str(seed): finding["outcome"] for seed, finding in one.findings.items()},
    }
