"""A calibrated base, tool or hand-eye transform, and the bases of several arms, as text and tables."""

import math
from collections.abc import Mapping
from pathlib import Path

from pisigma.calibration.frames.misfit_causes import CAUSES
from pisigma.estimation.alternatives import CLEAR
from pisigma.reporting.calibration_text import calibration_verdict
from pisigma.reporting.result_text import ResultText, Table, sentence_block, table_block
from pisigma.reporting.verdict import Verdict, count_text, rounded_text
from pisigma.validation.held_out.arms_summary import ArmBaseFigures, ArmsSummary
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.frame_calibration_summary import CoordinateFigures, FrameCalibrationSummary

_REMEDIES = {
    "arm": "calibrate the arm with 40 images or more (`pisigma calibrate` without --only), or state a calibrated model",
    "joint zeros": "set the joint zeros again, or calibrate the arm with `--set free=joint_offsets`",
    "joint noise": "read the joint values when the arm has settled, and check clocks and backlash",
    "camera": "calibrate the camera again with `pisigma camera`",
    "board": "measure the squares of the board and correct `square_mm`",
}
"""What to do about a cause, by the name of the cause."""
COLUMNS = ("coordinate", "unit", "before", "estimated", "standard error")
BASE_COLUMNS = ("arm", "in the base of", "coordinate", "unit", "value", "standard error")
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
MAX_DIRECTIONS = 3
"""Number of weak directions that are shown, weakest first; JSON contains all of them."""
CAUSE_TITLE = "possible causes of the residuals, each alone compared with noise alone"


def coordinate_table(summary: FrameCalibrationSummary) -> Table:
    """Return a table of the coordinates in mm and deg, rounded according to their standard errors."""
    return Table(COLUMNS, tuple(map(_coordinate_row, summary.coordinates)))


def _coordinate_row(one: CoordinateFigures) -> tuple[str, ...]:
    error = one.standard_error
    digits = 4 if not error else min(max(1 - math.floor(math.log10(error)), 1), 6)
    before, estimated = (f"{value + 0.0:.{digits}f}" for value in (one.nominal, one.estimated))
    return (
        one.name,
        one.unit,
        before,
        estimated,
        "not determined" if error is None else f"{error:.{digits}f}",
    )


def cause_table(summary: FrameCalibrationSummary) -> Table:
    """Return a table of the possible causes of the residuals."""
    columns = ("cause", "log Bayes factor", "explains alone [%]", "most probable size", "named")
    rows = (
        (
            CAUSES[one.cause],
            f"{one.log_bayes_factor:.1f}",
            f"{100 * one.explained_share:.0f}",
            one.size if one.log_bayes_factor > 0 else "",
            "yes" if one.is_supported else "no",
        )
        for one in summary.causes
    )
    return Table(columns, tuple(rows))


def cause_sentence(summary: FrameCalibrationSummary) -> tuple[str, ...]:
    """Return what causes the residuals and what to do; "" if the residuals are only noise."""
    named = [one for one in summary.causes if one.is_supported]
    if not named:
        return ()
    first = named[0]
    rivals = [
        CAUSES[one.cause]
        for one in summary.causes
        if not one.is_supported and one.log_bayes_factor > first.log_bayes_factor - CLEAR
    ]
    which = " and the ".join(f"{CAUSES[one.cause]}, {one.size}" for one in named)
    unclear = f" The rows hardly distinguish this cause from: {', '.join(rivals)}." if rivals else ""
    remedies = ", and ".join(_REMEDIES[one.cause] for one in named)
    return (
        f"The residuals are larger than their noise because of the {which}.{unclear} Remedy: {remedies}.",
    )


def coordinate_title(summary: FrameCalibrationSummary) -> str:
    """Return the names of the frames to which the coordinates belong."""
    bases = "base of the robot in the measuring frame"
    tools = "tool in the flange of the robot"
    return {"tool": tools, "base": bases, "hand-eye": f"{bases}, and {tools}"}[summary.only]


def fit_lines(summary: FrameCalibrationSummary) -> list[str]:
    """Return sentences on the residuals, and on directions that the rows hardly determine."""
    sizes = [
        f"{rounded_text(value, summary.rows)} {unit}"
        for value, unit in ((summary.rms_mm, "mm"), (summary.rms_deg, "deg"))
        if value is not None
    ]
    lines = [f"The residuals of the rows are {' and '.join(sizes)} RMS."] if sizes else []
    return lines + [f"{one[0].upper()}{one[1:]}." for one in summary.weak_directions[:MAX_DIRECTIONS]]


def frame_text(summary: FrameCalibrationSummary, folder: Path | None, seconds: float) -> ResultText:
    """Lay out calibrated frames.

    Args:
        summary: figures of the frames.
        folder: folder to which the model was written; None if it was not written.
        seconds: duration of the calibration [s].
    """
    warnings = (*cause_sentence(summary), *(one.sentence for one in summary.outliers), *summary.warnings)
    written = () if folder is None else (f"Model written to {folder} in {seconds:.1f} s.",)
    return ResultText(
        _verdict(summary, folder, len(warnings)),
        warnings,
        (
            table_block(coordinate_title(summary), *coordinate_table(summary)),
            *([table_block(CAUSE_TITLE, *cause_table(summary), "causes")] if summary.causes else []),
            sentence_block("the fit", fit_lines(summary)),
        ),
        (),
        written,
    )


def _verdict(summary: FrameCalibrationSummary, folder: Path | None, warnings: int) -> Verdict:
    worst = {
        unit: max((one.standard_error or 0.0 for one in summary.coordinates if one.unit == unit), default=0.0)
        for unit in ("mm", "deg")
    }
    accuracy = " and ".join(f"{rounded_text(value, 0)} {unit}" for unit, value in worst.items() if value > 0)
    lost = [one.name for one in summary.coordinates if one.standard_error is None]
    arm = "of the model" if summary.parent else "as drawn"
    cautions = [count_text(warnings, "warning")] if warnings else []
    cautions += [f"{', '.join(lost)} not determined"] if lost else []
    trust = "yes" if not warnings and not summary.weak_directions else "with caution"
    trust += f" ({', '.join(cautions)})." if cautions else "."
    follow = f"verify with other poses: `pisigma verify {folder} ROWS.csv`." if folder else "write the model."
    if lost:
        follow = "measure more orientations, because some coordinates are not determined."
    for one in summary.diagnostics:
        if one.severity == "implausible":
            unwritten = "; no model was written" if folder is None else ""
            trust = f"no: {one.sentence}"
            follow = f"correct the problem named above and calibrate again{unwritten}."
            break
    return Verdict(f"largest standard error {accuracy or 'unknown'}, with the arm {arm}.", trust, follow)


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
        rows.append((figures.arm, figures.other_arm, axis, unit, f"{value:.{digits}f}", shown))
    return rows


def rotation_lines(summary: ArmsSummary) -> list[str]:
    """Return a sentence on the standard errors of the rotation of every base, and on what bases include."""
    return [
        "A base belongs to the calibrated model of its arm: it includes the errors of the height and zero of the first "
        "joint (such as base_z + d_1 and base_roll + theta_1), by which it differs from the mounting of the arm.",
        *(
            f"The rotation of the base of '{one.arm}' about x, y, z of '{one.other_arm}' has standard errors of "
            f"{', '.join(rounded_text(error, 0) for error in one.standard_errors[3:])} deg."
            for one in summary.bases
        ),
    ]


def tip_lines(summary: ArmsSummary) -> list[str]:
    """Return a sentence on every touching tip that was found together with the bases."""
    return [
        f"The tip '{one.name}' of '{one.arm}' is at {one.x_mm:.3f}, {one.y_mm:.3f}, {one.z_mm:.3f} mm on the last row "
        f"(standard errors {', '.join(rounded_text(error, 0) for error in one.standard_errors)} mm)."
        for one in summary.tips
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
        (one.kind, one.name, " and ".join(one.arms), rounded_text(one.largest_disagreement_mm, 0))
        for one in summary.shared
    ]
    arms = [
        f"{name}: {calibration_verdict(one, None, len(one.warnings)).short.removeprefix('Verdict: ')}"
        for name, one in calibrations.items()
    ]
    agreement = (
        f"The RMS difference between the arms is {math.sqrt(summary.misfit / summary.degrees_of_freedom):.2g} standard "
        f"deviations ({summary.degrees_of_freedom} differences)."
        if summary.degrees_of_freedom
        else "The arms share too little to check their bases; share a second frame, or four sockets."
    )
    return ResultText(
        _arms_verdict(summary, calibrations, folder, len(warnings)),
        warnings,
        (
            table_block("bases of the arms relative to each other", BASE_COLUMNS, rows, "bases"),
            sentence_block("rotations", rotation_lines(summary)),
            *((sentence_block("tips", tip_lines(summary)),) if summary.tips else ()),
            table_block("shared by the arms", ("kind", "name", "arms", "apart [mm]"), shared),
            sentence_block("agreement", [agreement]),
            sentence_block("arms", arms),
        ),
        (),
        () if folder is None else (f"Models and frames.yaml written to {folder} in {seconds:.1f} s.",),
    )


def _arms_verdict(
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
        f"tool to tool {rounded_text(between, 0)} mm RMS, as predicted from the uncertainty of the calibrations.",
        trust,
        "correct the problem that the first warning names."
        if summary.diagnostics or doubtful or folder is None
        else f"verify every arm with other poses: `pisigma verify {folder}/ARM ROWS.csv`.",
    )
