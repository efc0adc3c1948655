"""Several calibrated arms as text: their bases relative to each other, and what they share."""

import math
from collections.abc import Mapping
from pathlib import Path

from pisigma.reporting.calibration_text import calibration_verdict
from pisigma.reporting.result_text import ResultText, sentences, table_block
from pisigma.reporting.verdict import Verdict, count_text, rounded
from pisigma.validation.held_out.arms_summary import ArmBaseFigures, ArmsSummary
from pisigma.validation.held_out.calibration_summary import CalibrationSummary

COLUMNS = ("arm", "in the base of", "coordinate", "unit", "value", "standard error")
AXES = ("x", "y", "z", "roll", "pitch", "yaw")


def base_rows(figures: ArmBaseFigures) -> list[tuple[str, ...]]:
    """Return the rows of the table of one base: values, and standard errors of shifts along x, y, z.

    Standard errors of rotations are about x, y, z and not of roll, pitch and yaw, so they have rows of their own.
    """
    units = ("mm",) * 3 + ("deg",) * 3
    values = (figures.x_mm, figures.y_mm, figures.z_mm, figures.roll_deg, figures.pitch_deg, figures.yaw_deg)
    rows: list[tuple[str, ...]] = []
    for number, (axis, unit, value) in enumerate(zip(AXES, units, values, strict=True)):
        error = figures.standard_errors[number] if number < 3 else max(figures.standard_errors[3:])
        digits = min(max(1 - math.floor(math.log10(max(error, 1e-6))), 1), 6)
        shown = f"{figures.standard_errors[number]:.{digits}f}" if number < 3 else ""
        rows.append((figures.arm, figures.in_base_of, axis, unit, f"{value:.{digits}f}", shown))
    return rows


def rotation_lines(summary: ArmsSummary) -> list[str]:
    """Return a sentence on the standard errors of the rotation of every base."""
    return [
        f"The rotation of the base of '{one.arm}' about x, y, z of '{one.in_base_of}' has standard errors of "
        f"{', '.join(rounded(error, 0) for error in one.standard_errors[3:])} deg."
        for one in summary.bases
    ]


def arms_text(
    summary: ArmsSummary,
    calibrations: Mapping[str, CalibrationSummary],
    warnings: tuple[str, ...],
    folder: Path | None,
    seconds: float,
) -> ResultText:
    """Lay out calibrated arms.

    Args:
        summary: figures of the bases.
        calibrations: figures of every arm, by its name.
        warnings: warnings of the arms.
        folder: folder to which the models were written; None if they were not written.
        seconds: duration of the calibration [s].
    """
    warnings = (*(one.sentence for one in summary.diagnostics), *warnings)
    rows = [row for one in summary.bases for row in base_rows(one)]
    shared = [
        (one.kind, one.name, " and ".join(one.arms), rounded(one.distance_mm, 0)) for one in summary.shared
    ]
    arms = [
        f"{name}: {calibration_verdict(one, None, len(one.warnings)).short.removeprefix('Verdict: ')}"
        for name, one in calibrations.items()
    ]
    agreement = (
        f"The RMS difference between the arms is {math.sqrt(summary.misfit / summary.redundancy):.2g} standard "
        f"deviations ({summary.redundancy} differences)."
        if summary.redundancy
        else "The arms share too little to check their bases; share a second frame, or four sockets."
    )
    return ResultText(
        _verdict(summary, calibrations, folder, len(warnings)),
        warnings,
        (
            table_block("bases of the arms relative to each other", COLUMNS, rows, "bases"),
            sentences("rotations", rotation_lines(summary)),
            table_block("shared by the arms", ("kind", "name", "arms", "apart [mm]"), shared),
            sentences("agreement", [agreement]),
            sentences("arms", arms),
        ),
        (),
        () if folder is None else (f"Models and frames.yaml written to {folder} in {seconds:.1f} s.",),
    )


def _verdict(
    summary: ArmsSummary, calibrations: Mapping[str, CalibrationSummary], folder: Path | None, warnings: int
) -> Verdict:
    between = max(one.tool_to_tool_mm for one in summary.bases)
    doubtful = [
        name
        for name, one in calibrations.items()
        if any(found.severity == "implausible" for found in one.diagnostics)
    ]
    if summary.diagnostics or doubtful:
        reasons = [f"arm '{name}' is implausible" for name in doubtful]
        reasons += ["the arms disagree"] if summary.diagnostics else []
        trust = f"no: {', and '.join(reasons)}."
    else:
        trust = f"with caution ({count_text(warnings, 'warning')})." if warnings else "yes."
    return Verdict(
        f"tool to tool {rounded(between, 0)} mm RMS, as predicted from the uncertainty of the calibrations.",
        trust,
        "correct the problem that the first warning names."
        if summary.diagnostics or doubtful or folder is None
        else f"verify every arm with other poses: `pisigma verify {folder}/ARM ROWS.csv`.",
    )
