"""Figures of a recalibration, which appear on cards, in tables and in JSON, and are stored in the model folder."""

from typing import Annotated

from pydantic import Field

from pisigma.files.yaml_file import Section
from pisigma.lifetime.recalibration.candidates import Kept
from pisigma.lifetime.recalibration.movement import SummaryMovement
from pisigma.validation.held_out.contradicting_row import ContradictingRowFigures
from pisigma.validation.held_out.distillation_summary import ParentFigures
from pisigma.validation.held_out.summary import AbstractSummary


class HeldOutFigures(Section):
    """RMS position error of held-out rows under a candidate [mm]; None if there are too few rows for the candidate."""

    rms_mm: float | None


class RecalibrationSummary(AbstractSummary):
    """All figures of a recalibration.

    Attributes:
        parent: model that was recalibrated; its `sha256` is the hash of its `model.yaml`.
        date: date of the recalibration, such as "2026-11-22".
        rows: number of rows that were used.
        outliers: rows that were left out.
        kept_candidate: candidate that was kept.
        verdict: sentence about the candidate that was kept, with the errors of all candidates.
        held_out_row_count: number of rows that were held out in cross-validation and used in the comparison.
        cross_validation: errors of held-out rows by candidate.
        change_sentence: sentence that states what moved.
        movements: significant movements.
        relocated_frames: bases and tools that have been moved since the parent was made.
        effective_parameters: number of directions of the unknowns that the rows determine.
        noise: standard deviation of each sensor [m or rad]; a factor if the rows state it.
        warnings: warnings, one sentence each.
    """

    kinds = ("recalibration",)

    parent: ParentFigures
    date: str
    rows: int
    outliers: tuple[ContradictingRowFigures, ...] = ()
    kept_candidate: Annotated[Kept, Field(alias="kept")]
    verdict: str
    held_out_row_count: Annotated[int, Field(alias="left_out")]
    cross_validation: dict[str, HeldOutFigures]
    change_sentence: Annotated[str, Field(alias="changed")]
    movements: Annotated[tuple[SummaryMovement, ...], Field(alias="moved")]
    relocated_frames: Annotated[tuple[str, ...], Field(alias="elsewhere")]
    effective_parameters: float
    noise: dict[str, float]
    warnings: tuple[str, ...] = ()
