"""A calibration as text: verdict, warnings, errors of held-out rows, joint correction, and all parameters."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from pisigma.reporting import calibration_tables as tables
from pisigma.reporting.calibration_tables import parameter_table, undetermined_lines
from pisigma.reporting.result_text import Block, ResultText, Table, sentence_block, table_block
from pisigma.reporting.tables import distance_table
from pisigma.reporting.verdict import Verdict, count_text, rms_text, rounded_text
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, ScaleFigures
from pisigma.validation.held_out.validation_figures import ValidationFigures

_LIKELY_SCALE, _POSSIBLE_SCALE = 1.0, 0.1
"""Odds above which a common factor on all lengths leads to a warning or a remark, if the resulting error matters."""
_MIN_SCALE_SHARE = 0.5
"""Share of the held-out RMS error above which the error that results from a wrong scale matters."""
_MIN_COVERAGE = 0.9
"""Share of held-out coordinates within their predicted 95 % intervals below which the intervals are called too
narrow."""
_SHOWN = {"rms": "RMS", "p95": "95 %", "max": "largest"}


def error_table(figures: ValidationFigures) -> Table:
    """Return a table of RMS, 95 % quantile and maximum of the errors, one column per calibration."""
    models = figures.models
    named = [errors.figures_by_name for errors in models.values()]
    rows = []
    for key in named[0]:
        statistic, unit = key.rsplit("_", 1)
        if statistic in _SHOWN:
            quantity = "position" if unit == "mm" else "orientation"
            cells = (rounded_text(errors[key], figures.rows) for errors in named)
            rows.append((f"{quantity}, {_SHOWN[statistic]} [{unit}]", *cells))
    return Table(("error", *models), tuple(rows))


def held_out_text(figures: ValidationFigures, summary: CalibrationSummary) -> str:
    """Return a text on the rows to which the errors belong."""
    if figures is summary.cross_validation:
        repeats = f", {figures.repeats} repeats" if figures.repeats else ""
        if (figures.folds or 1) > 1:
            return f"held out in {figures.folds}-fold cross-validation of {figures.rows} rows{repeats}"
        return f"{figures.rows} rows, held out once"
    if figures is summary.held_out:
        return f"{figures.rows} other simulated rows"
    return (
        f"{figures.rows} rows of the set 'test'" if figures is summary.test else f"fit to {figures.rows} rows"
    )


def error_quantity(summary: CalibrationSummary) -> str:
    """Return a text on the quantity of the errors and the frame in which they are measured."""
    sensors = {noise.sensor for noise in summary.noise}
    if "corner" in sensors:
        return "the poses that images give, camera relative to board"
    if "socket" in sensors:
        return "the ball about the mean of its socket"
    return "the measured point in the sensor's frame" if "position" in sensors else "the measured values"


def calibration_verdict(summary: CalibrationSummary, folder: Path | None, warning_count: int) -> Verdict:
    """Return the verdict on a calibration.

    Args:
        summary: figures of the calibration.
        folder: folder of the model; None if no folder was written.
        warning_count: number of warnings.
    """
    return Verdict(
        _accuracy(summary), _trust(summary, warning_count), _next_step(summary, folder, warning_count)
    )


def _accuracy(summary: CalibrationSummary) -> str:
    figures, implausible = (
        summary.validation_errors,
        any(one.severity == "implausible" for one in summary.diagnostics),
    )
    images = any(noise.sensor == "corner" for noise in summary.noise)
    scatter = ", with the scatter of the images" if images else ""
    if figures is None and summary.predicted_rms_mm is not None and not implausible:
        return (
            f"{rounded_text(summary.predicted_rms_mm, 0)} mm RMS at other poses{scatter}, as predicted from the "
            "uncertainty of the calibration; no row was held out."
        )
    figures = figures or summary.training_errors
    if figures is None or not figures.models:
        return "not known, because no row was judged."
    (first, nominal), *_ = figures.models.items()
    *_, best = figures.models.values()
    than = f"; {first} {rms_text(nominal, figures.rows)}" if best is not nominal else ""
    return f"{rms_text(best, figures.rows)} RMS{scatter}, {held_out_text(figures, summary)}{than}."


def _trust(summary: CalibrationSummary, warnings: int) -> str:
    implausible = [one for one in summary.diagnostics if one.severity == "implausible"]
    if implausible:
        return f"no: {implausible[0].sentence}"
    judged = summary.validation_errors
    if judged is None:
        return "not known: no row was held out, so the calibration was not validated."
    share = judged.coverage
    covered = share is None or share >= _MIN_COVERAGE
    cautions = ["the sensor's scale may be wrong"] if scale_matters(summary) else []
    cautions += [] if covered else ["the predicted accuracy is too good"]
    intervals = (
        ""
        if share is None
        else f"; {100 * share:.0f} % of the held-out coordinates are within their predicted 95 % intervals"
    )
    if cautions or warnings:
        which = f": {', '.join(cautions)}" if cautions else ""
        return f"with caution ({count_text(warnings, 'warning')}){which}{intervals}."
    return f"yes, for joint values like the measured ones{intervals}."


def _next_step(summary: CalibrationSummary, folder: Path | None, warnings: int) -> str:
    if folder is None or any(one.severity == "implausible" for one in summary.diagnostics):
        unwritten = "; no model was written" if folder is None else ""
        return f"correct the problem named above and calibrate again{unwritten}."
    if summary.validation_errors is None:
        return "measure more poses and calibrate again, or start from the prior of a fleet (--prior)."
    first = "follow the warnings, then verify" if warnings else "verify"
    return f"{first} with other poses: `pisigma verify {folder} ROWS.csv`."


def scale_matters(summary: CalibrationSummary, odds: float = _LIKELY_SCALE) -> bool:
    """Return whether a wrong scale of the sensor has at least these odds and causes an error that matters."""
    scale, judged = summary.scale, summary.validation_errors
    if scale is None or judged is None or scale.odds < odds:
        return False
    *_, best = judged.models.values()
    return best.rms_mm is not None and scale.rms_mm_if_sensor_error >= _MIN_SCALE_SHARE * best.rms_mm


def scale_text(scale: ScaleFigures) -> str:
    """Return a sentence on the odds of a wrong scale of the sensor, and the error that it would cause."""
    digits = 1 - math.floor(math.log10(scale.sigma)) if scale.sigma > 0 else 5
    return (
        f"scale of the sensor: the estimated lengths of the arm are {scale.factor:.{digits}f} +- "
        f"{scale.sigma:.{digits}f} times the nominal ones; the odds of one common factor, such as a wrong scale of the "
        f"sensor, against independent errors of the links are {scale.odds:.2g} to 1. {scale_error_text(scale)}"
    )


def scale_error_text(scale: ScaleFigures) -> str:
    """Return a sentence on the consequence of a wrong scale of the sensor."""
    return (
        f"If the sensor's scale is wrong, true positions are off by {scale.rms_mm_if_sensor_error:.2g} mm RMS in "
        "addition to the errors shown; check it with a scale bar."
    )


def calibration_text(
    summary: CalibrationSummary,
    folder: Path | None,
    seconds: float,
    first_blocks: Sequence[Block] = (),
) -> ResultText:
    """Lay out a calibration: the verdict, warnings, and errors of held-out rows; on demand all tables and parameters.

    Args:
        summary: figures of the calibration.
        folder: folder to which the model was written; None if it was not written.
        seconds: duration of the calibration [s].
        first_blocks: blocks that are shown first.
    """
    warnings = [*tables.implausible_lines(summary)[1:], *tables.warning_lines(summary)]
    found = [one.sentence for one in summary.diagnostics if one.kind == "scale"]
    remarks = []
    if summary.scale is not None and found:
        warnings = [f"{one} {scale_error_text(summary.scale)}" if one in found else one for one in warnings]
    elif summary.scale is not None and scale_matters(summary):
        warnings = [scale_text(summary.scale), *warnings]
    elif summary.scale is not None and scale_matters(summary, _POSSIBLE_SCALE):
        remarks = [scale_text(summary.scale)]
    written = f"Model written to {folder} in {seconds:.1f} s; its README.md has all figures."
    return ResultText(
        calibration_verdict(summary, folder, len(warnings)),
        tuple(warnings),
        (*first_blocks, *_accuracy_blocks(summary), sentence_block("scale of the sensor", remarks)),
        (*_learned(summary), *_fit(summary), *_parameters(summary)),
        () if folder is None else (written,),
    )


def _accuracy_blocks(summary: CalibrationSummary) -> Iterator[Block]:
    """Lay out the errors of rows that were held out, and the remarks on them."""
    judged = [one for one in (summary.cross_validation, summary.held_out, summary.test) if one is not None]
    for figures in judged:
        title = f"errors of {error_quantity(summary)}, {held_out_text(figures, summary)}"
        yield table_block(title, *error_table(figures), "errors of held-out rows")
        if figures.socket_distance is not None:
            what = "stated distances between sockets, under calibrations without them"
            yield table_block(what, *distance_table(figures.socket_distance), "distances between sockets")
        yield sentence_block("remarks on the held-out rows", tables.held_out_lines(figures))


def _learned(summary: CalibrationSummary) -> Iterator[Block]:
    """Return the joint correction, and other corrections that were tried, as text."""
    if summary.hybrid is not None:
        yield sentence_block("joint correction", tables.learned_lines(summary.hybrid))
        yield table_block("joint corrections that were tried", *tables.trial_table(summary.hybrid), "trials")
    if summary.validation_errors is not None and (
        coverage := tables.coverage_line(summary.validation_errors)
    ):
        yield sentence_block("predicted intervals", [coverage])
    if summary.learning_curve is not None:
        what = "errors of held-out rows by number of training rows"
        yield table_block(what, *tables.curve_table(summary.learning_curve), "learning curve")


def _fit(summary: CalibrationSummary) -> Iterator[Block]:
    """Lay out the errors of the calibration rows, and how the search ended."""
    if summary.training_errors is not None:
        what = (
            f"errors of the rows used in the calibration, {held_out_text(summary.training_errors, summary)}"
        )
        yield table_block(what, *error_table(summary.training_errors), "errors of the fit")
    count = len(summary.outliers)
    worst = f"; the worst is {summary.outliers[0].place}" if count else ""
    line = f"Rank {summary.rank}, {summary.iterations} iterations, {count} outliers{worst}."
    yield sentence_block("outliers", [line])


def _parameters(summary: CalibrationSummary) -> Iterator[Block]:
    """Yield a table of all parameters, and the parameters that the data cannot determine."""
    yield table_block(
        "parameters", *parameter_table(summary.parameters), f"{len(summary.parameters)} parameters"
    )
    lines = ["What these data cannot determine:", *(f"- {one}" for one in undetermined_lines(summary))]
    yield sentence_block("undetermined parameters", lines, "  ")
