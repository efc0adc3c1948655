"""Figures of a base, a tool or a hand-eye transform that was calibrated with the arm held fixed."""

import math
from typing import Annotated, Literal

from pydantic import Field

from pisigma.calibration.frames.frame_fit import FrameFit
from pisigma.calibration.frames.misfit_causes import size_text
from pisigma.estimation.alternatives import Cause
from pisigma.files.yaml_file import StoredFigures
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.validation.held_out.calibration_summary import NoiseFigures, noise_figures
from pisigma.validation.held_out.contradicting_row import ContradictingRowFigures, contradicting_rows
from pisigma.validation.held_out.distillation_summary import ParentFigures
from pisigma.validation.held_out.summary import AbstractSummary


class CoordinateFigures(StoredFigures):
    """A coordinate of a base or a tool.

    Attributes:
        name: name, such as "tool_x" or, with several targets, "tool_ball_x".
        unit: unit of the figures: "mm" or "deg".
        nominal: value before the calibration.
        estimated: estimated value.
        standard_error: standard error of the estimate; None if the rows do not determine it.
        standard_error_by_noise: part of the standard error due to the noise of the rows, without the uncertainty of the
            arm.
    """

    name: str
    unit: str
    nominal: float
    estimated: float
    standard_error: float | None
    standard_error_by_noise: Annotated[float | None, Field(alias="by_noise")]


class CauseFigures(StoredFigures):
    """A possible cause of the residuals of a hand-eye calibration.

    Attributes:
        cause: "arm", "joint zeros", "joint noise", "camera" or "board".
        log_bayes_factor: log evidence with this cause alone, minus that with noise alone [nats].
        explained_share: share of the squared residuals, in units of their noise, that this cause alone explains.
        size: most probable size of its errors, with units.
        is_supported: whether the evidence supports it.
    """

    cause: str
    log_bayes_factor: float
    explained_share: Annotated[float, Field(alias="share")]
    size: str
    is_supported: Annotated[bool, Field(alias="named")]


class FrameCalibrationSummary(AbstractSummary):
    """All figures of a calibrated base, tool or hand-eye transform.

    Attributes:
        only: what was calibrated.
        parent: model whose arm was used; None for a nominal robot.
        rows: number of rows, including those that were left out.
        coordinates: calibrated coordinates, with standard errors.
        weak_directions: directions that the rows hardly determine, one sentence each.
        noise: noise of each sensor, from the residuals.
        rms_mm: RMS residual of the positions [mm].
        rms_deg: RMS residual of the orientations [deg].
        outliers: rows that were left out because the others contradict them.
        causes: possible causes of the residuals, those supported by the evidence first; unset if not compared.
        warnings: warnings, one sentence each.
    """

    kinds = ("frame_calibration",)

    only: Literal["tool", "base", "hand-eye"]
    parent: ParentFigures | None = None
    rows: int
    coordinates: tuple[CoordinateFigures, ...]
    weak_directions: tuple[str, ...]
    noise: tuple[NoiseFigures, ...]
    rms_mm: float | None = None
    rms_deg: float | None = None
    outliers: tuple[ContradictingRowFigures, ...]
    causes: tuple[CauseFigures, ...] = ()
    warnings: tuple[str, ...]


def coordinate_figures(fit: FrameFit, arm_variance: tuple[float, ...]) -> tuple[CoordinateFigures, ...]:
    """Return the coordinates of a fit.

    Args:
        fit: the fit.
        arm_variance: variance of every coordinate due to the uncertainty of the arm [m² or rad²].
    """
    lost, variances = fit.undetermined_indices, fit.covariance.diagonal()
    figures = []
    for number, (parameter, before, estimate) in enumerate(
        zip(fit.parameters, fit.previous_values, fit.estimates, strict=True)
    ):
        unit, factor = SHOWN_UNITS[parameter.unit]
        known = fit.frame_indices[number] not in lost
        figures.append(
            CoordinateFigures(
                name=parameter.name,
                unit=unit,
                nominal=float(before) * factor,
                estimated=float(estimate) * factor,
                standard_error=math.sqrt(variances[number] + arm_variance[number]) * factor
                if known
                else None,
                standard_error_by_noise=math.sqrt(variances[number]) * factor if known else None,
            )
        )
    return tuple(figures)


def weak_direction_sentences(fit: FrameFit) -> tuple[str, ...]:
    """Return a sentence for every direction that the rows hardly determine."""
    return tuple(
        f"the rows do not determine {one.combination} (in mm and mrad; {_deviation_text(one.sigma)}); it keeps its "
        "previous value; measure other orientations"
        if one.is_held
        else f"the rows determine {one.combination} (in mm and mrad) only to {one.sigma:.2g}"
        for one in fit.weak_directions
    )


def _deviation_text(deviation: float) -> str:
    return "no information" if math.isinf(deviation) else f"standard deviation {deviation:.2g}"


def _cause_figures(cause: Cause) -> CauseFigures:
    return CauseFigures(
        cause=cause.name,
        log_bayes_factor=cause.log_bayes_factor,
        explained_share=cause.explained_share,
        size=size_text(cause),
        is_supported=cause.is_supported,
    )


def _rms(fit: FrameFit, quantity: Literal["m", "rad"]) -> float | None:
    """Return the RMS length of the residuals of all sensors of a quantity [m or rad]; None without such sensors."""
    sensors = [
        one for one in fit.solved.result().noise if one.residual_unit == quantity and one.sensor != "corner"
    ]
    rows = sum(one.values / one.components for one in sensors)
    squares = sum(one.rms**2 * one.values / one.components for one in sensors)
    return math.sqrt(squares / rows) if rows else None


def frame_calibration_summary(
    fit: FrameFit,
    arm_variance: tuple[float, ...],
    causes: tuple[Cause, ...],
    parent: ParentFigures | None,
    warnings: tuple[str, ...],
) -> FrameCalibrationSummary:
    """Collect the figures of a fit.

    Args:
        fit: the fit.
        arm_variance: see `coordinate_figures`.
        causes: possible causes of the residuals.
        parent: model whose arm was used.
        warnings: warnings, one sentence each.
    """
    result = fit.solved.result()
    lengths, angles = _rms(fit, "m"), _rms(fit, "rad")
    summary = FrameCalibrationSummary(
        only=fit.frame_choice,
        rows=fit.rows.rows,
        coordinates=coordinate_figures(fit, arm_variance),
        weak_directions=weak_direction_sentences(fit),
        noise=tuple(
            noise_figures(
                one.sensor,
                one.sigma,
                one.unit,
                value_count=one.values,
                effective_parameters=one.effective_parameters,
            )
            for one in result.noise
        ),
        outliers=contradicting_rows(result, fit.rows, fit.wrong_rows),
        warnings=warnings,
    )
    return summary.with_figures(
        parent=parent,
        causes=tuple(map(_cause_figures, causes)) or None,
        rms_mm=None if lengths is None else lengths * 1e3,
        rms_deg=None if angles is None else math.degrees(angles),
    )
