"""A comparison of models as figures for `--json`."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.judging.model_comparison import Compared, ModelComparison, ModelErrors


def report_comparison(comparison: ModelComparison) -> dict[str, Any]:
    """Everything that is said of a comparison, in mm and deg.

    Returns:
        Counts of rows and configurations, how the intervals were found, and per model its figures (those of
        `PoseErrors.in_file_units`), their confidence "intervals", "axes", "inside_domain" and "outside_domain" where
        it knows a domain, and from the second model on what it differs by from the first.
    """
    bootstrap = comparison.position.bootstrap
    quantities = {"position": comparison.position, "orientation": comparison.orientation}
    there = {name: compared for name, compared in quantities.items() if compared is not None}
    intervals = {name: compared.intervals() for name, compared in there.items()}
    differences = {name: compared.to_first() for name, compared in there.items()}
    models = []
    for index, model in enumerate(comparison.models):
        found: dict[str, Any] = {
            "name": model.name,
            "rows_not_predicted": model.not_predicted,
            **model.vectors.sizes.in_file_units(),
            "intervals": {
                f"{name}_{there[quantity].unit}": _ends(ends[index], there[quantity])
                for quantity, by_name in intervals.items()
                for name, ends in by_name.items()
            },
            "axes": model.vectors.axes_in_file_units(),
            **_parts(model),
        }
        if index:
            found["difference_to_first"] = {
                quantity: paired[index].in_file_units(there[quantity].unit)
                for quantity, paired in differences.items()
            }
        models.append(found)
    return {
        "rows_compared": comparison.rows,
        "rows_without_position": comparison.unmeasured,
        "configurations": comparison.position.configurations,
        "bootstrap": {
            "resamples": bootstrap.resamples,
            "seed": bootstrap.seed,
            "confidence": bootstrap.confidence,
        },
        "models": models,
    }


def _ends(ends: Tensor, compared: Compared) -> list[float] | None:
    factor = 1e3 if compared.unit == "mm" else float(np.rad2deg(1.0))
    return None if bool(ends.isnan().any()) else (ends * factor).tolist()


def _parts(model: ModelErrors) -> dict[str, Any]:
    """Figures of the rows inside and outside the domain, each with their number; None where there are none."""
    if model.inside is None:
        return {}
    return {"inside_domain": _part(model, model.inside), "outside_domain": _part(model, ~model.inside)}


def _part(model: ModelErrors, rows: Bool[Tensor, " rows"]) -> dict[str, Any] | None:
    errors = model.vectors.only(rows).sizes
    count = int(torch.isfinite(errors.position).sum())
    if not count:
        return None
    if errors.rotation is not None and not torch.isfinite(errors.rotation).any():
        errors = type(errors)(errors.position, None)
    return {"rows": count, **errors.in_file_units()}
