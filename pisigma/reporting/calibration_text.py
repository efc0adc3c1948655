"""A calibration as text: verdict, warnings, errors of held-out rows, what was learned, and all parameters."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from pisigma.reporting import calibration_tables as tables
from pisigma.reporting.calibration_tables import parameter_table, undetermined_lines
from pisigma.reporting.calibration_verdict import (
    POSSIBLE_SCALE,
    calibration_verdict,
    error_quantity,
    error_table,
    held_out_text,
    scale_error,
    scale_matters,
    scale_text,
)
from pisigma.reporting.result_text import Block, ResultText, sentences, table_block
from pisigma.reporting.tables import distance_table
from pisigma.validation.held_out.calibration_summary import CalibrationSummary


def calibration_text(
    summary: CalibrationSummary,
    folder: Path | None,
    seconds: float,
    also: Sequence[Block] = (),
) -> ResultText:
    """Lay out a calibration: the verdict, warnings, and errors of held-out rows; on demand all tables and parameters.

    Args:
        summary: its figures.
        folder: where the model was written; None if it was not.
        seconds: time it took [s].
        also: blocks that are shown first.
    """
    warnings = [*tables.implausible_lines(summary)[1:], *tables.warning_lines(summary)]
    found = [one.sentence for one in summary.diagnostics if one.kind == "scale"]
    remarks = []
    if summary.scale is not None and found:
        warnings = [f"{one} {scale_error(summary.scale)}" if one in found else one for one in warnings]
    elif summary.scale is not None and scale_matters(summary):
        warnings = [scale_text(summary.scale), *warnings]
    elif summary.scale is not None and scale_matters(summary, POSSIBLE_SCALE):
        remarks = [scale_text(summary.scale)]
    written = f"Model written to {folder} in {seconds:.1f} s; its README.md has all figures."
    return ResultText(
        calibration_verdict(summary, folder, len(warnings)),
        tuple(warnings),
        (*also, *_accuracy(summary), sentences("scale of the sensor", remarks)),
        (*_learned(summary), *_fit(summary), *_parameters(summary)),
        () if folder is None else (written,),
    )


def _accuracy(summary: CalibrationSummary) -> Iterator[Block]:
    """Lay out the errors of rows that were held out, and the remarks on them."""
    judged = [one for one in (summary.cross_validation, summary.held_out, summary.test) if one is not None]
    for figures in judged:
        title = f"errors of {error_quantity(summary)}, {held_out_text(figures, summary)}"
        yield table_block(title, *error_table(figures), "errors of held-out rows")
        if figures.socket_distance is not None:
            what = "stated distances between sockets, under calibrations without them"
            yield table_block(what, *distance_table(figures.socket_distance), "distances between sockets")
        yield sentences("remarks on the held-out rows", tables.held_out_lines(figures))


def _learned(summary: CalibrationSummary) -> Iterator[Block]:
    """Lay out the joint correction, and the others that were tried."""
    if summary.hybrid is not None:
        yield sentences("joint correction", tables.learned_lines(summary.hybrid))
        yield table_block("joint corrections that were tried", *tables.trial_table(summary.hybrid), "trials")
    if summary.validation_errors is not None and (
        coverage := tables.coverage_line(summary.validation_errors)
    ):
        yield sentences("predicted intervals", [coverage])
    if summary.learning_curve is not None:
        what = "errors of held-out rows by number of training rows"
        yield table_block(what, *tables.curve_table(summary.learning_curve), "learning curve")


def _fit(summary: CalibrationSummary) -> Iterator[Block]:
    """Lay out the errors of the calibration rows, and how the search ended."""
    if summary.calibrated is not None:
        what = f"errors of the rows used in the calibration, {held_out_text(summary.calibrated, summary)}"
        yield table_block(what, *error_table(summary.calibrated), "errors of the fit")
    count = len(summary.outliers)
    worst = f"; the worst is {summary.outliers[0].place}" if count else ""
    line = f"Rank {summary.rank}, {summary.iterations} iterations, {count} outliers{worst}."
    yield sentences("outliers", [line])


def _parameters(summary: CalibrationSummary) -> Iterator[Block]:
    """Lay out all parameters, and what the data cannot determine."""
    yield table_block(
        "parameters", *parameter_table(summary.parameters), f"{len(summary.parameters)} parameters"
    )
    lines = ["What these data cannot determine:", *(f"- {one}" for one in undetermined_lines(summary))]
    yield sentences("undetermined parameters", lines, "  ")
