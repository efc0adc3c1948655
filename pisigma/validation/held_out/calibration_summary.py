"""Figures of a calibration as one typed value.

Cards, terminal tables, report pages and JSON are made from it, and a model folder stores it as metrics. Figures
are in millimetres and degrees. Figures that do not exist are unset and omitted from JSON; figures without a finite
value are None.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field, JsonValue

from pisigma.calibration.geometric.identifiability.observability import Observability
from pisigma.calibration.geometric.outliers import Outlier
from pisigma.calibration.hybrid.result import HybridResult, LearnedPart
from pisigma.files.yaml_file import Section, StoredFigures
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.summary import AbstractSummary
from pisigma.validation.held_out.trained_calibrations import Result, geometric_result
from pisigma.validation.held_out.validation_figures import LearningPoint, ValidationFigures


class NoiseFigures(StoredFigures):
    """Noise of one kind of sensor, estimated from the residuals.

    Attributes:
        sensor: kind of sensor, such as "position".
        value_count: number of measured values.
        effective_parameters: effective number of parameters estimated from them.
        sigma_mm: standard deviation of one value [mm].
        sigma_deg: standard deviation of one angle [deg].
        factor_on_stated_sigma: factor on the standard deviations that the rows state.
    """

    sensor: str
    value_count: Annotated[int | None, Field(alias="values")] = None
    effective_parameters: Annotated[float | None, Field(alias="used_by_parameters")] = None
    sigma_mm: float | None = None
    sigma_deg: float | None = None
    factor_on_stated_sigma: float | None = None


class ParameterFigures(StoredFigures):
    """One row of the parameter table; see `pisigma.calibration.geometric.result.ParameterEstimate`.

    Attributes:
        name: name of the parameter, such as "theta_1".
        unit: unit of the four figures: "mm", "deg", "px" or "1".
        nominal: nominal value.
        estimated: estimated value.
        change: estimated minus nominal value.
        standard_error: standard error of the estimate, see `HybridResult.parameters`; None if it was not estimated.
        remark: remark on the estimate as a sentence.
        short_remark: the same in a few words.
    """

    name: str
    unit: str
    nominal: float | None
    estimated: float | None
    change: float | None
    standard_error: float | None
    remark: str
    short_remark: Annotated[str, Field(alias="label")]


class RedundancyFigures(Section):
    """Identifiability: which parameters the data determine; see `pisigma.calibration.geometric.identifiability`.

    Attributes:
        kept: an identifiable set of parameters.
        removed: parameters whose effect is a linear combination of the effects of kept parameters.
        no_effect: parameters that change no measured value.
        dependencies: combinations that are identifiable although the individual parameters are not, one sentence each.
        pairwise_sets: sets of parameters that are redundant by the Pearson correlation of pairs.
        pairwise_kept: parameters that remain by this criterion.
    """

    kept: tuple[str, ...]
    removed: tuple[str, ...]
    no_effect: tuple[str, ...]
    dependencies: tuple[str, ...]
    pairwise_sets: tuple[tuple[str, ...], ...]
    pairwise_kept: tuple[str, ...]


class OutlierFigures(StoredFigures):
    """A row with less than half of the full weight.

    Attributes:
        row: index in the measurements, from 0.
        place: file and line.
        sensor: kind of sensor of the value.
        residual_in_sigmas: length of the residual, in standard deviations of one value.
        residual_mm: length of the residual [mm].
        residual_deg: angle of the residual, for an orientation [deg].
    """

    row: int
    place: str
    sensor: str
    residual_in_sigmas: Annotated[float, Field(alias="deviations")]
    residual_mm: float | None = None
    residual_deg: float | None = None


class TrialFigures(StoredFigures):
    """A joint correction that was tried; see `pisigma.calibration.hybrid.search.Trial`.

    Attributes:
        name: name of the trial, such as "gravity + series 56 + products (2, 2)".
        unknowns: number of parameters and weights.
        log_evidence: log evidence up to a constant of the data; None if it was not computed.
        held_out_ratio: ratio of the held-out RMS error of training rows to that of the geometric calibration [1].
        seconds: duration [s].
        is_improvement: whether it was better than all previous trials.
    """

    name: str
    unknowns: int
    log_evidence: float | None
    held_out_ratio: Annotated[float, Field(alias="left_out")]
    seconds: float
    is_improvement: Annotated[bool, Field(alias="kept")]


class LearnedFigures(StoredFigures):
    """The joint correction that was kept.

    Attributes:
        features: name and settings of every feature.
        orders: number of factors of every product unit.
        unknowns: number of parameters and weights.
        effective_parameters: effective number of parameters; the others are determined by the prior.
        linearisations: iterations of the fit.
        noise: noise per sensor.
        variance_factor: factor on predicted variances that fits the held-out errors.
    """

    features: tuple[dict[str, JsonValue], ...]
    orders: tuple[int, ...]
    unknowns: int
    effective_parameters: float
    linearisations: int
    noise: tuple[NoiseFigures, ...]
    variance_factor: Annotated[float, Field(alias="prior_scale")]


class JointCorrectionFigures(Section):
    """Joint correction of a hybrid calibration.

    Attributes:
        verdict: sentence that states what was kept and why.
        learned: the correction; None if none was kept.
        trials: the trials, in order.
    """

    verdict: str
    learned: LearnedFigures | None
    trials: tuple[TrialFigures, ...]


class ScaleFigures(StoredFigures):
    """Common factor on all measured lengths.

    Attributes:
        factor: ratio of estimated to nominal lengths of the arm [1].
        sigma: its standard deviation [1].
        odds: odds of a common factor against independent errors of the links, at most 1e6.
        rms_mm_if_sensor_error: RMS error of true positions about their mean if the factor is an error of the
            sensor [mm].
    """

    factor: float
    sigma: float
    odds: float
    rms_mm_if_sensor_error: Annotated[float, Field(alias="rms_mm")]


class HeldOutFile(Section):
    """SHA-256 of the file of held-out rows in the model folder, and of its measurements."""

    sha256: str
    data_sha256: str


class CalibrationSummary(AbstractSummary):
    """All figures of a calibration.

    Attributes:
        rows: number of rows of the calibration.
        fit_seconds: duration of the calibration without its validation [s].
        status: reason why the search ended.
        iterations: number of steps tried.
        rank: rank of the Jacobian: number of identifiable combinations of parameters.
        condition_number: condition number of the Jacobian of the free parameters.
        observability: observability indices O1 to O5.
        noise: noise per sensor.
        parameters: the parameter table.
        redundancy: which parameters are identifiable.
        weak_directions: weakly identifiable directions, one sentence each.
        scale: common factor of the lengths, if positions were measured.
        outliers: rows with less than half of the full weight, worst first.
        warnings: what to check or to measure next, one sentence each.
        rmse_mm: RMS residual of the first sensor at every iteration, starting with the initial guess.
        hybrid: joint correction of a hybrid calibration.
        cross_validation: errors of held-out rows of the cross-validation.
        training_errors: errors of the rows of the calibration.
        test: errors of the rows that the file marks as test.
        held_out: errors of other simulated rows.
        predicted_rms_mm: predicted RMS error at other poses if no row was held out [mm]; see
            `predicted_rms_at_other_poses`.
        held_out_rows: hashes of the file of held-out rows.
        learning_curve: errors of held-out rows by the number of training rows.
        redundant_sets: for recipes, sets of parameters that are redundant in pairs.
        no_effect: for recipes, parameters without effect, found with `redundant_sets`.
        pairwise_parameters: for recipes, number of parameters that remain after removing those redundant in pairs.
        paper: for recipes, published figures by name.
    """

    kinds = ("geometric_calibration", "hybrid_calibration")

    rows: int | None = None
    fit_seconds: float | None = None
    status: str
    iterations: int
    rank: int
    condition_number: float | None
    observability: Observability
    noise: tuple[NoiseFigures, ...]
    parameters: tuple[ParameterFigures, ...]
    redundancy: RedundancyFigures
    weak_directions: tuple[str, ...]
    scale: ScaleFigures | None = None
    outliers: tuple[OutlierFigures, ...]
    warnings: tuple[str, ...]
    rmse_mm: tuple[float, ...]
    hybrid: JointCorrectionFigures | None = None
    training_errors: Annotated[ValidationFigures | None, Field(alias="calibrated")] = None
    cross_validation: ValidationFigures | None = None
    test: ValidationFigures | None = None
    held_out: ValidationFigures | None = None
    predicted_rms_mm: float | None = None
    held_out_rows: HeldOutFile | None = None
    learning_curve: tuple[LearningPoint, ...] | None = None
    redundant_sets: tuple[tuple[str, ...], ...] | None = None
    no_effect: tuple[str, ...] | None = None
    pairwise_parameters: int | None = None
    paper: dict[str, JsonValue] | None = None

    @property
    def validation_errors(self) -> ValidationFigures | None:
        """Errors of held-out rows: of the cross-validation, or else of simulated rows, or else of the test set."""
        return self.cross_validation or self.held_out or self.test


def summarise(result: Result) -> CalibrationSummary:
    """Collect the figures of a calibration, without those of its validation.

    Args:
        result: geometric or hybrid calibration.
    """
    geometric = geometric_result(result)
    exact, pairwise = geometric.redundancy, geometric.pairwise_redundancy
    summary = CalibrationSummary(
        status=geometric.status.value,
        iterations=geometric.iterations,
        rank=geometric.rank,
        condition_number=_or_none(geometric.condition_number),
        observability=geometric.observability,
        noise=tuple(
            noise_figures(
                one.sensor,
                one.sigma,
                one.unit,
                value_count=one.values,
                effective_parameters=one.effective_parameters,
            )
            for one in geometric.noise
        ),
        parameters=_parameters(result),
        redundancy=RedundancyFigures(
            kept=exact.kept,
            removed=exact.removed,
            no_effect=exact.no_effect,
            dependencies=tuple(dependency.sentence for dependency in exact.dependencies),
            pairwise_sets=tuple(tuple(members) for members in pairwise.sets),
            pairwise_kept=tuple(pairwise.kept),
        ),
        weak_directions=geometric.weak_directions,
        outliers=_outliers(result.outliers),
        warnings=geometric.warnings,
        rmse_mm=tuple(value * 1e3 for value in geometric.rms_path),
    )
    return summary.with_figures(hybrid=_hybrid(result)) if isinstance(result, HybridResult) else summary


def _parameters(result: Result) -> tuple[ParameterFigures, ...]:
    rows = []
    for parameter in result.parameters:
        unit, factor = SHOWN_UNITS[parameter.unit]
        names = ("nominal", "estimated", "change", "standard_error")
        figures = {name: _or_none(getattr(parameter, name) * factor) for name in names}
        texts = {"name": parameter.name, "remark": parameter.remark, "short_remark": parameter.short_remark}
        rows.append(ParameterFigures(unit=unit, **texts, **figures))
    return tuple(rows)


def _outliers(outliers: Sequence[Outlier]) -> tuple[OutlierFigures, ...]:
    rows = []
    for outlier in outliers:
        unit, factor = SHOWN_UNITS[outlier.unit]
        figures = {
            "residual_in_sigmas": outlier.residual_in_sigmas,
            f"residual_{unit}": outlier.residual * factor,
        }
        rows.append(OutlierFigures(row=outlier.row, place=outlier.place, sensor=outlier.sensor, **figures))
    return tuple(rows)


def noise_figures(sensor: str, sigma: float, unit: str, **counts: Any) -> NoiseFigures:
    """Return the noise of a sensor; `unit` is "m", "rad", or "stated" for a factor on stated standard deviations."""
    if unit not in SHOWN_UNITS:
        return NoiseFigures(sensor=sensor, factor_on_stated_sigma=sigma, **counts)
    name, factor = SHOWN_UNITS[unit]
    return NoiseFigures(sensor=sensor, **{f"sigma_{name}": sigma * factor}, **counts)


def _hybrid(result: HybridResult) -> JointCorrectionFigures:
    trials = tuple(
        TrialFigures(
            name=trial.name,
            unknowns=trial.unknowns,
            log_evidence=_or_none(trial.log_evidence),
            held_out_ratio=trial.held_out_ratio,
            seconds=round(trial.seconds, 3),
            is_improvement=trial.is_best_so_far,
        )
        for trial in result.trials
    )
    learned = None if result.learned is None else _learned(result, result.learned)
    return JointCorrectionFigures(verdict=result.verdict, learned=learned, trials=trials)


def _learned(result: HybridResult, learned: LearnedPart) -> LearnedFigures:
    units = {noise.sensor: noise.unit for noise in result.geometric.noise}
    return LearnedFigures(
        features=tuple(
            features.describe().model_dump(mode="json") for features in learned.correction.features
        ),
        orders=tuple(learned.correction.orders),
        unknowns=learned.unknowns,
        effective_parameters=learned.effective_unknowns,
        linearisations=learned.rounds,
        noise=tuple(
            noise_figures(sensor, sigma, units[sensor])
            for sensor, sigma in learned.noise.items()
            if sensor in units
        ),
        variance_factor=result.uncertainty.variance_factor,
    )


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def has_orientation(model: CalibratedModel) -> bool:
    """Return whether a model knows the orientation of its tools; without measured orientations, it does not."""
    summary = CalibrationSummary.read(model)
    return summary is None or any(noise.sensor in ("rotation", "corner") for noise in summary.noise)
