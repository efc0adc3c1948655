"""A report as plain values, for programs."""

import math
from dataclasses import asdict
from typing import Any

from pisigma.reporting.page.content import ReportContent


def summary_of(content: ReportContent) -> dict[str, Any]:
    """The figures and sentences of a report, without single rows; what is no number is None."""
    verdict, rows = content.verdict, content.rows
    summary = {
        "model": content.model.name,
        "verdict": verdict.sentence,
        "held_out": verdict.held_out,
        "worst": verdict.worst,
        "limit": {
            "noise_rms_mm": content.limit.noise,
            "share": content.limit.share,
            "says": content.limit.sentence,
        },
        "accuracy": [
            {
                "of": one.title,
                "how": one.how,
                "held_out": one.held_out,
                "rows": one.rows,
                "models": dict(one.models),
            }
            for one in content.accuracies
        ],
        "rows": None
        if rows is None
        else {"count": rows.measurements.rows, "origin": rows.origin, "remarks": list(rows.remarks)},
        "residuals": [{"over": one.title, "says": one.sentence} for one in content.dependences],
        "frames": [asdict(one) for one in content.frames[0]],
        "targets": [asdict(one) for one in content.targets[0]],
        "not_identified": list(content.parameters.not_identified),
        "observability": {name: value for name, value, _ in content.parameters.observability},
        "correlated": [list(pair) for pair in content.parameters.pairs],
        "advice": list(content.advice),
        "missing": list(content.missing),
        "provenance": dict(content.provenance),
    }
    found: dict[str, Any] = _finite(summary)
    return found


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
