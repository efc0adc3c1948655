"""Cards of calibrations and of trained networks, with their figures."""

import math
from dataclasses import dataclass
from pathlib import Path

from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files import model_files
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting import calibration_tables as tables
from pisigma.reporting.rendering import write_card
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.calibration_validation import CalibrationValidation
from pisigma.validation.held_out.trained_calibrations import Result, geometric_result
from pisigma.validation.held_out.training_summary import TrainingRun, TrainingSummary


@dataclass(frozen=True)
class CardTexts:
    """Texts of a card: description of the model, and limits of its validation."""

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
    pictures: bool = True,
) -> None:
    """Write the card of a calibration, its CSV files and its figures into a model folder.

    Args:
        model: model of the folder.
        result: calibration.
        rows: rows of the calibration.
        validation: errors of held-out rows for the figures, or None.
        summary: all figures of the calibration.
        texts: description of the model, and limits of its validation.
        folder: model folder.
        pictures: whether to draw figures.
    """
    tables.write_parameters(summary.parameters, folder / model_files.PARAMETERS_CSV)
    geometric = geometric_result(result)
    correlations = (geometric.pairwise_redundancy.lengths, geometric.pairwise_redundancy.angles)
    tables.write_correlations(correlations, folder / model_files.CORRELATION_CSV)
    if pictures:
        _draw_calibration(result, rows, validation, summary, folder)
    drawn = {entry.name for entry in folder.glob("*.png")}
    write_card(
        folder, "calibration_card.md.j2", model=model, result=geometric, summary=summary, texts=texts, drawn=drawn,
        files=model_files, say=tables,
    )  # fmt: skip


def _draw_calibration(
    result: Result,
    rows: Measurements,
    validation: CalibrationValidation | None,
    summary: CalibrationSummary,
    folder: Path,
) -> None:
    """Draw the figures of `write_calibration_card`."""
    from pisigma.reporting import (
        calibration_figures as figures,
    )  # imported late because matplotlib takes 30 MB

    geometric = geometric_result(result)
    correlations = (geometric.pairwise_redundancy.lengths, geometric.pairwise_redundancy.angles)
    figures.draw_correlations(correlations, folder / model_files.CORRELATION_PNG)
    figures.draw_residuals(
        geometric.residuals,
        folder / model_files.RESIDUALS_PNG,
        ", geometric" if isinstance(result, HybridResult) else "",
    )
    if validation is not None:
        lengths = {name: errors.position.numpy() for name, errors in validation.all_errors.items()}
        figures.draw_held_out_errors(lengths, folder / model_files.HELD_OUT_PNG)
        spread = validation.predicted_spread
        if spread is not None and spread.value_count:
            figures.draw_spread(spread, folder / model_files.SPREAD_PNG)
    if isinstance(result, HybridResult) and result.learned is not None:
        figures.draw_corrections(result.learned.correction, rows, folder / model_files.CORRECTIONS_PNG)
    if summary.learning_curve is not None:
        figures.draw_learning_curve(summary.learning_curve, folder / model_files.CURVE_PNG)


def write_training_card(
    name: str, texts: CardTexts, run: TrainingRun, summary: TrainingSummary, folder: Path
) -> None:
    """Write the card of a trained network and its figures into a model folder.

    Args:
        name: name of the model.
        texts: description of the model, and limits of its validation.
        run: result of the training.
        summary: all figures.
        folder: model folder.
    """
    from pisigma.reporting import figures as training_figures

    joints, energies = run.history.joints, run.history.energies
    training_figures.write_energy_csv(joints, energies, folder / model_files.ENERGY_CSV)
    training_figures.draw_energy(joints, energies, folder / model_files.ENERGY_PNG)
    shown = run.held_out or run.training
    robot = run.model.robot
    names = [joint.name for joint in robot.joints]
    index = [names.index(joint) for joint in joints]
    units = ["deg" if robot.revolute[i] else "mm" for i in index]
    scale = shown.before.new_tensor([math.degrees(1) if unit == "deg" else 1e3 for unit in units])
    before, after = shown.before[:, index] * scale, shown.after[:, index] * scale
    training_figures.draw_errors_over_workspace(
        joints, units, shown.T[:, :3, 3], before, after, folder / model_files.WORKSPACE_PNG
    )
    groups = run.model.network.groups if run.model.network else ()
    inputs = dict.fromkeys(name for group in groups for name in group.inputs.names)
    write_card(
        folder, "training_card.md.j2", name=name, texts=texts, run=run, summary=summary, inputs=inputs,
        files=model_files,
    )  # fmt: skip
