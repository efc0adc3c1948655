"""The card of a calibration, with its figures: accuracy first, then what was learned, parameters and provenance."""

from dataclasses import dataclass
from pathlib import Path

from pisigma.hybrid.result import HybridResult
from pisigma.judging.calibration_summary import CalibrationSummary
from pisigma.judging.calibration_validation import CalibrationValidation
from pisigma.judging.trained_calibrations import Result, geometric_result
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting import calibration_figures as figures
from pisigma.reporting import calibration_tables as tables
from pisigma.reporting.rendering import write_card


@dataclass(frozen=True)
class CardTexts:
    """What a card says in words of its own: what the model is, and what nobody checked."""

    description: str
    not_validated: str


def write_calibration_card(
    model: CalibratedModel,
    result: Result,
    rows: Measurements,
    validation: CalibrationValidation | None,
    summary: CalibrationSummary,
    texts: CardTexts,
    folder: Path,
) -> None:
    """Write the card, its CSV files and its figures into a model folder.

    Args:
        model: the model of the folder.
        result: the calibration.
        rows: the rows it was calibrated with.
        validation: errors of held-out rows for the figures, or None.
        summary: all figures of the calibration.
        texts: description, and what was not validated.
        folder: where to write.
    """
    tables.write_parameters(summary.parameters, folder / tables.PARAMETERS_CSV)
    geometric = geometric_result(result)
    correlations = (geometric.pairwise.lengths, geometric.pairwise.angles)
    tables.write_correlations(correlations, folder / tables.CORRELATION_CSV)
    figures.draw_correlations(correlations, folder / figures.CORRELATION_PNG)
    figures.draw_residuals(
        geometric.residuals,
        folder / figures.RESIDUALS_PNG,
        ", geometric" if isinstance(result, HybridResult) else "",
    )
    if validation is not None:
        lengths = {name: errors.position.numpy() for name, errors in validation.all_errors.items()}
        figures.draw_held_out(lengths, folder / figures.HELD_OUT_PNG)
        spread = validation.all_spread
        if spread is not None and spread.values:
            figures.draw_spread(spread, folder / figures.SPREAD_PNG)
    if isinstance(result, HybridResult) and result.learned is not None:
        figures.draw_corrections(result.learned.correction, rows, folder / figures.CORRECTIONS_PNG)
    if summary.learning_curve is not None:
        figures.draw_learning_curve(summary.learning_curve, folder / figures.CURVE_PNG)
    drawn = {entry.name for entry in folder.glob("*.png")}
    write_card(
        folder, "calibration_card.md.j2", model=model, result=geometric, summary=summary, texts=texts, drawn=drawn,
        figures=figures, say=tables,
    )  # fmt: skip
