"""What a calibration gave, as figures for tables, cards and `--json`."""

import csv
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pisigma.hybrid.result import HybridResult
from pisigma.identification.result import CalibrationResult
from pisigma.judging.calibration_validation import CalibrationValidation
from pisigma.reporting.hybrid_report import report_hybrid

PARAMETERS_CSV = "parameters.csv"

_UNITS = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1.0))}
_FIGURES = ("nominal", "estimated", "change", "standard_error")


def report_calibration(
    found: CalibrationResult | HybridResult,
    validation: CalibrationValidation | None = None,
    test: CalibrationValidation | None = None,
) -> dict[str, Any]:
    """Everything that is said of a calibration, in millimetres and degrees; what is not known is None.

    Args:
        found: the calibration; of a hybrid, what it learned beyond the geometric one is under "hybrid".
        validation: of rows held out in turn.
        test: of rows that the file marks as test.
    """
    result = found.geometric if isinstance(found, HybridResult) else found
    report: dict[str, Any] = {
        "status": result.status.value,
        "iterations": result.iterations,
        "rank": result.rank,
        "condition_number": _or_none(result.condition_number),
        "observability": asdict(result.observability),
        "noise": [_noise(item) for item in result.noise],
        "parameters": parameter_rows(result),
        "redundancy": report_redundancy(result),
        "weak_directions": list(result.weak_directions),
        "outliers": [
            {
                "row": o.row,
                "place": o.place,
                "sensor": o.sensor,
                "deviations": o.deviations,
                **_residual(o.residual, o.sensor),
            }
            for o in result.outliers
        ],
        "warnings": list(result.warnings),
        "rmse_mm": [value * 1e3 for value in result.rms_path],
    }
    if isinstance(found, HybridResult):
        report["hybrid"] = report_hybrid(found)
    if validation is not None:
        report["cross_validation"] = validation.in_file_units()
    if test is not None:
        figures = test.in_file_units()
        report["test"] = {name: value for name, value in figures.items() if name != "folds"}
    return report


def parameter_rows(result: CalibrationResult) -> list[dict[str, Any]]:
    """The parameter table in millimetres and degrees."""
    rows = []
    for parameter in result.parameters:
        unit, factor = _UNITS[parameter.unit]
        figures = {name: _or_none(getattr(parameter, name) * factor) for name in _FIGURES}
        rows.append({"name": parameter.name, "unit": unit, **figures, "remark": parameter.remark})
    return rows


def report_redundancy(result: CalibrationResult) -> dict[str, Any]:
    """What the data cannot tell, exactly and the paper's way (Pearson correlation of columns in pairs)."""
    exact, pairwise = result.redundancy, result.pairwise
    return {
        "kept": list(exact.kept),
        "removed": list(exact.removed),
        "no_effect": list(exact.no_effect),
        "dependencies": [dependency.sentence for dependency in exact.dependencies],
        "pairwise_sets": [list(members) for members in pairwise.sets],
        "pairwise_kept": list(pairwise.kept),
    }


def write_parameters(result: CalibrationResult, path: Path) -> None:
    """Write the parameter table as CSV; a cell is empty where there is no figure."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["name", "unit", *_FIGURES, "remark"])
        for row in parameter_rows(result):
            figures = ["" if row[name] is None else repr(row[name]) for name in _FIGURES]
            writer.writerow([row["name"], row["unit"], *figures, row["remark"]])


def _noise(noise: Any) -> dict[str, Any]:
    figures = {"sensor": noise.sensor, "values": noise.values, "used_by_parameters": noise.used}
    if noise.unit == "given":
        return {**figures, "factor_on_given_sigma": noise.sigma}
    unit, factor = _UNITS[noise.unit]
    return {**figures, f"sigma_{unit}": noise.sigma * factor}


def _residual(value: float, sensor: str) -> dict[str, float]:
    return {"residual_deg": math.degrees(value)} if sensor == "rotation" else {"residual_mm": value * 1e3}


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
