"""Rows that were left out because they contradict the others."""

import math
from collections.abc import Sequence

from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements
from pisigma.validation.held_out.calibration_validation import ErrorPredictor, pose_errors_of


class ContradictingRowFigures(Section):
    """A row that was left out because it contradicts the others.

    Attributes:
        row: index in the measurements, from 0.
        place: file and line.
        residual_mm: length of its error under the model fitted to the other rows [mm].
        residual_deg: angle of its orientation error [deg].
    """

    row: int
    place: str
    residual_mm: float | None = None
    residual_deg: float | None = None

    @property
    def sentence(self) -> str:
        """Sentence that states which row was left out, why, and what to do."""
        sizes = ((self.residual_mm, "mm"), (self.residual_deg, "deg"))
        missed = " and ".join(f"{size:.3g} {unit}" for size, unit in sizes if size is not None)
        return (
            f"{self.place} was left out: it deviates by {missed} from its prediction by the others; "
            "measure it again."
        )


def contradicting_rows(
    result: ErrorPredictor, rows: Measurements, wrong_rows: Sequence[int]
) -> tuple[ContradictingRowFigures, ...]:
    """Return the figures of rows that were left out.

    Args:
        result: calibration with the other rows.
        rows: all rows.
        wrong_rows: indices of the rows that were left out.

    Raises:
        IdentificationError: such a row has a frame, target or anchor that was not calibrated.
    """
    errors = pose_errors_of(result, rows)
    sizes = {"residual_mm": (errors.position, 1e3), "residual_deg": (errors.rotation, math.degrees(1.0))}
    figures = []
    for row in wrong_rows:
        off = {
            name: float(those[row]) * factor
            for name, (those, factor) in sizes.items()
            if those is not None and math.isfinite(those[row])
        }
        figures.append(ContradictingRowFigures(row=row, place=rows.place(row), **off))
    return tuple(figures)
