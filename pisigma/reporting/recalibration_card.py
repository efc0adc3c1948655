"""Card of a recalibrated model, and its table."""

from pathlib import Path

from pisigma.lifetime.recalibration.summary import RecalibrationSummary
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.reporting.rendering import write_card
from pisigma.reporting.tables import Table
from pisigma.reporting.verdict import rounded

CANDIDATES = {
    "recalibrated": "recalibrated",
    "old": "old, with base and tool of these rows",
    "scratch": "from scratch",
}
OF_FLEET = CANDIDATES | {"recalibrated": "fleet and these rows", "old": "mean robot of the fleet"}


def write_recalibration_card(model: CalibratedModel, summary: RecalibrationSummary, folder: Path) -> None:
    """Write the card into a model folder.

    Args:
        model: model of the folder.
        summary: figures of the recalibration.
        folder: model folder.
    """
    write_card(
        folder, "recalibration_card.md.j2", model=model, summary=summary, candidates=candidate_table(summary)
    )


def candidate_names(summary: RecalibrationSummary) -> dict[str, str]:
    """Name the candidates, by their keys in the figures."""
    return OF_FLEET if summary.parent.kind == FLEET_PRIOR else CANDIDATES


def candidate_table(summary: RecalibrationSummary) -> Table:
    """Make a table of the candidates: RMS error of held-out rows, and which was kept."""
    names = candidate_names(summary)
    rows = (
        (
            names[name],
            "too few rows" if errors.rms_mm is None else rounded(errors.rms_mm, summary.left_out),
            "yes" if name == summary.kept else "no",
        )
        for name, errors in summary.cross_validation.items()
    )
    return Table(("model", "held-out rows, RMS [mm]", "kept"), tuple(rows))
