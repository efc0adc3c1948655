"""Acceptance of a cell's robot: instrument, uncertainty budget, measured errors, and the person who accepted it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pisigma.lifetime.cell.events import Event
from pisigma.validation.held_out.model_comparison import QuantityErrors
from pisigma.validation.iso9283.repeats import CYCLES, RepeatedPose, pooled_scatter
from pisigma.validation.uncertainty.budget import UncertaintyBudget
from pisigma.validation.uncertainty.components import SCATTER
from pisigma.validation.uncertainty.instrument import Instrument

_EXPLAINED = 0.999
"""Probability with which errors that the budget explains pass the test of `is_contradicted`."""
_MAX_FREEDOM = 1e9
"""Degrees of freedom that are treated as infinite."""
_NO_PATHS = "AT and RT: the sessions of a cell contain no measured paths."


@dataclass(frozen=True)
class MeasuredAccuracy:
    """Errors of the model in use on a session to which it was not fitted.

    Attributes:
        session: name of the session.
        day: day of the session (ISO 8601).
        rows: number of rows.
        fitted_frames: "base" or "tool" or both, if they were changed after the calibration and therefore fitted to the
            rows.
        errors: position errors of the model in use [mm].
        distrust_reason: reason why the rows must not be trusted; empty if they can be trusted.
    """

    session: str
    day: str
    rows: int
    fitted_frames: tuple[str, ...]
    errors: QuantityErrors
    distrust_reason: str = ""

    @property
    def coordinate_p95_mm(self) -> float:
        """Largest 95 % quantile of the absolute errors along any axis [mm]."""
        return max(axis["p95"] for axis in self.errors.axes.values())

    def to_json(self) -> dict[str, Any]:
        """Return plain values, lengths in mm."""
        return {
            "session": self.session,
            "day": self.day,
            "rows": self.rows,
            "fitted": list(self.fitted_frames),
            "position_mm": dict(self.errors.statistics),
            "axes_mm": {name: dict(axis) for name, axis in self.errors.axes.items()},
            "distrust_reason": self.distrust_reason,
        }


@dataclass(frozen=True)
class Acceptance:
    """Statements on which the acceptance of a cell's robot is based.

    Attributes:
        model: name of the model in use.
        limit_mm: limit on the 95 % quantile of the position errors [mm]; None if the cell has none.
        instrument: the instrument, with the data that are stated.
        repeatability_mm: pose repeatability RP stated by the manufacturer of the robot [mm]; None if it is not stated.
        temperatures: mean temperature of every valid session [deg C], by name of the session; None if unknown.
        budget: uncertainty budget.
        measured: errors on the newest session to which the model was not fitted; None if there is no such session.
        repeats: ISO 9283 figures of the poses that were measured more than once in valid sessions.
        acceptance_events: acceptances of models of this cell, newest last.
        missing_statements: missing statements, one sentence each, apart from components of the budget.
    """

    model: str
    limit_mm: float | None
    instrument: Instrument
    repeatability_mm: float | None
    temperatures: Mapping[str, float | None]
    budget: UncertaintyBudget
    measured: MeasuredAccuracy | None
    repeats: tuple[RepeatedPose, ...]
    acceptance_events: tuple[Event, ...]
    missing_statements: tuple[str, ...]

    @property
    def temperature_span(self) -> tuple[float, float] | None:
        """Lowest and highest mean temperature of a session [deg C]; None if no session states it."""
        known = [value for value in self.temperatures.values() if value is not None]
        return (min(known), max(known)) if known else None

    @property
    def is_contradicted(self) -> bool:
        """Whether the measured errors are larger than the budget and chance explain.

        It is False for a budget without the scatter of the calibration. Otherwise the ratio of the mean square of the
        measured coordinates to `u_c²` is compared with the quantile `_EXPLAINED` of the F distribution. The degrees of
        freedom are the number of rows, because the coordinates of a row may be correlated, and those of the budget.
        """
        if self.measured is None or all(one.name != SCATTER for one in self.budget.components):
            return False
        from scipy import stats

        square = (self.measured.errors.statistics["rms"] / 1e3) ** 2 / 3
        freedom = min(self.budget.effective_degrees_of_freedom, _MAX_FREEDOM)
        limit = float(stats.f.ppf(_EXPLAINED, self.measured.rows, freedom))
        return square > limit * self.budget.combined_uncertainty**2

    @property
    def not_stated_sentences(self) -> tuple[str, ...]:
        """Sentences about everything that is not stated."""
        return (*self.budget.missing_components, *self.missing_statements)

    def to_json(self) -> dict[str, Any]:
        """Return plain values, lengths in mm."""
        span, scatter = self.temperature_span, pooled_scatter(self.repeats)
        return {
            "model": self.model,
            "limit_mm": self.limit_mm,
            "instrument": self.instrument.model_dump(),
            "repeatability_mm": self.repeatability_mm,
            "temperature_c": None if span is None else list(span),
            "budget": self.budget.to_json(),
            "contradicted": self.is_contradicted,
            "measured": None if self.measured is None else self.measured.to_json(),
            "repeats": {}
            if scatter is None
            else {"deviation_mm": scatter[0] * 1e3, "degrees_of_freedom": scatter[1]},
            "iso9283": [one.to_json() for one in self.repeats],
            "accepted": [one.to_json() for one in self.acceptance_events],
            "not_stated": list(self.not_stated_sentences),
        }


def missing_statements(
    instrument: Instrument,
    repeatability_mm: float | None,
    unmeasured_reason: str,
    repeats: tuple[RepeatedPose, ...],
) -> tuple[str, ...]:
    """Return sentences about the statements that an acceptance lacks.

    Args:
        instrument: the instrument.
        repeatability_mm: pose repeatability stated by the manufacturer [mm]; None if it is not stated.
        unmeasured_reason: reason why there are no measured errors; empty if there are some.
        repeats: figures of repeated poses.
    """
    names = ("name", "serial", "certificate", "calibrated")
    lines = [
        f"instrument: instrument.{name} in cell.yaml." for name in names if not getattr(instrument, name)
    ]
    if repeatability_mm is None:
        lines.append("pose repeatability of the maker: pose_repeatability_mm in cell.yaml.")
    if unmeasured_reason:
        lines.append(f"measured errors: {unmeasured_reason}")
    if not repeats:
        lines.append("AP and RP: no pose was measured more than once.")
    elif (fewest := min(one.rows for one in repeats)) < CYCLES:
        lines.append(f"AP and RP of {CYCLES} cycles, as ISO 9283 requires: one pose has {fewest}.")
    return (*lines, _NO_PATHS)
