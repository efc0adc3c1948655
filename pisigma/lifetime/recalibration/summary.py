"""The figures of a recalibration as one typed value, which cards, tables and JSON render and a model folder keeps."""

from pisigma.files.yaml_file import Section
from pisigma.lifetime.recalibration.candidates import Kept
from pisigma.lifetime.recalibration.movement import SummaryMovement
from pisigma.validation.held_out.distillation_summary import ParentFigures
from pisigma.validation.held_out.summary import AbstractSummary


class LeftOutFigures(Section):
    """Errors of left-out rows under one candidate; None where the rows are too few for it."""

    rms_mm: float | None


class WrongRowFigures(Section):
    """One row that was left out, because it does not go with the others whatever has drifted.

    Attributes:
        row: number in the measurements, from 0.
        place: file and line.
        residual_mm: length of its error under the model that the other rows give [mm].
        residual_deg: the same of an orientation [deg].
    """

    row: int
    place: str
    residual_mm: float | None = None
    residual_deg: float | None = None

    @property
    def sentence(self) -> str:
        """Which row was left out, and why."""
        sizes = ((self.residual_mm, "mm"), (self.residual_deg, "deg"))
        missed = " and ".join(f"{size:.3g} {unit}" for size, unit in sizes if size is not None)
        return f"{self.place} was left out: it is off by {missed} from what the other rows say; measure it again."


class RecalibrationSummary(AbstractSummary):
    """All figures of a recalibration.

    Attributes:
        parent: the model that the rows were added to; its `sha256` is that of its `model.yaml`.
        date: of the recalibration, such as "2026-11-22".
        rows: number of rows that count.
        outliers: the other ones.
        kept: which candidate the model is.
        verdict: which candidate won and by how much, in a sentence.
        left_out: number of rows that were left out in turn and count.
        cross_validation: errors of left-out rows, by candidate.
        changed: what moved, in a sentence.
        moved: what moved clearly.
        elsewhere: bases and tools that stand elsewhere than when the parent was made.
        effective_parameters: how many directions of the unknowns the rows determine.
        noise: per sensor, its standard deviation [m or rad], or a factor where the rows state it.
        warnings: what to heed, a sentence each.
    """

    kinds = ("recalibration",)

    parent: ParentFigures
    date: str
    rows: int
    outliers: tuple[WrongRowFigures, ...] = ()
    kept: Kept
    verdict: str
    left_out: int
    cross_validation: dict[str, LeftOutFigures]
    changed: str
    moved: tuple[SummaryMovement, ...]
    elsewhere: tuple[str, ...]
    effective_parameters: float
    noise: dict[str, float]
    warnings: tuple[str, ...] = ()
