"""Typed figures of a recalibration, which cards, tables and JSON render and a model folder keeps."""

from pisigma.files.yaml_file import Section
from pisigma.lifetime.recalibration.candidates import Kept
from pisigma.lifetime.recalibration.movement import SummaryMovement
from pisigma.validation.held_out.distillation_summary import ParentFigures
from pisigma.validation.held_out.summary import AbstractSummary


class HeldOutFigures(Section):
    """RMS position error of held-out rows under one candidate [mm]; None if the rows are too few for it."""

    rms_mm: float | None


class ContradictingRowFigures(Section):
    """A row that was left out because it contradicts the others under any drift.

    Attributes:
        row: index in the measurements, from 0.
        place: file and line.
        residual_mm: length of its error under the model from the other rows [mm].
        residual_deg: angle of its orientation error [deg].
    """

    row: int
    place: str
    residual_mm: float | None = None
    residual_deg: float | None = None

    @property
    def sentence(self) -> str:
        """Sentence on which row was left out, why, and what to do."""
        sizes = ((self.residual_mm, "mm"), (self.residual_deg, "deg"))
        missed = " and ".join(f"{size:.3g} {unit}" for size, unit in sizes if size is not None)
        return (
            f"{self.place} was left out: it deviates by {missed} from its prediction by the others; "
            "measure it again."
        )


class RecalibrationSummary(AbstractSummary):
    """All figures of a recalibration.

    Attributes:
        parent: model that was recalibrated; its `sha256` is that of its `model.yaml`.
        date: date of the recalibration, such as "2026-11-22".
        rows: number of rows that were used.
        outliers: rows that were left out.
        kept: candidate that was kept.
        verdict: sentence on which candidate was kept, with the errors of all.
        left_out: number of rows that were held out in cross-validation and used.
        cross_validation: errors of held-out rows by candidate.
        changed: sentence on what moved.
        moved: significant movements.
        elsewhere: bases and tools that were moved since the parent was made.
        effective_parameters: number of directions of the unknowns that the rows determine.
        noise: standard deviation of each sensor [m or rad]; a factor where the rows state it.
        warnings: warnings, one sentence each.
    """

    kinds = ("recalibration",)

    parent: ParentFigures
    date: str
    rows: int
    outliers: tuple[ContradictingRowFigures, ...] = ()
    kept: Kept
    verdict: str
    left_out: int
    cross_validation: dict[str, HeldOutFigures]
    changed: str
    moved: tuple[SummaryMovement, ...]
    elsewhere: tuple[str, ...]
    effective_parameters: float
    noise: dict[str, float]
    warnings: tuple[str, ...] = ()
