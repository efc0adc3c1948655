"""The figures of a calibration as one typed value.

Cards, tables on the screen, report pages and JSON render it, and a model folder keeps it as the metrics of its model.
Figures are in millimetres and degrees. What does not exist is not set and stands in no JSON; what was wanted but has no
finite value is None.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from pydantic import JsonValue

from pisigma.calibration.geometric.outliers import Outlier
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.result import HybridResult, LearnedPart
from pisigma.files.yaml_file import Section
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.summary import AbstractSummary
from pisigma.validation.held_out.trained_calibrations import Result, geometric_result
from pisigma.validation.held_out.validation_figures import LearningPoint, ValidationFigures


class NoiseFigures(Section):
    """Noise of one kind of sensor, as the residuals show it.

    Attributes:
        sensor: such as "position".
        values: number of measured values.
        used_by_parameters: how many of them the parameters use up.
        sigma_mm: standard deviation of one value [mm].
        sigma_deg: the same of an angle [deg].
        factor_on_stated_sigma: the same as a factor, where the rows state their standard deviations.
    """

    sensor: str
    values: int | None = None
    used_by_parameters: float | None = None
    sigma_mm: float | None = None
    sigma_deg: float | None = None
    factor_on_stated_sigma: float | None = None


class ParameterFigures(Section):
    """One row of the parameter table; see `pisigma.calibration.geometric.result.ParameterEstimate`.

    Attributes:
        name: such as "theta_1".
        unit: "mm", "deg", "px" or "1"; the unit of the four figures.
        nominal: as drawn.
        estimated: as identified.
        change: estimated minus nominal.
        standard_error: of the estimate; None where it was not estimated.
        remark: what is to be said of it, in full.
        label: the same in a few words.
    """

    name: str
    unit: str
    nominal: float | None
    estimated: float | None
    change: float | None
    standard_error: float | None
    remark: str
    label: str


class RedundancyFigures(Section):
    """Which parameters the data determine; see `pisigma.calibration.geometric.identifiability`.

    Attributes:
        kept: parameters of an identifiable choice.
        removed: parameters that act like combinations of these.
        no_effect: parameters that change no measured value.
        dependencies: the combinations that are identified where single values are not, a sentence each.
        pairwise_sets: sets of parameters that are redundant by Pearson correlation of pairs.
        pairwise_kept: parameters that are left by pairs.
    """

    kept: tuple[str, ...]
    removed: tuple[str, ...]
    no_effect: tuple[str, ...]
    dependencies: tuple[str, ...]
    pairwise_sets: tuple[tuple[str, ...], ...]
    pairwise_kept: tuple[str, ...]


class ObservabilityFigures(Section):
    """Observability indices of the parameters; see `pisigma.calibration.geometric.identifiability.observability`."""

    O1: float
    O2: float
    O3: float
    O4: float
    O5: float


class OutlierFigures(Section):
    """A row that counted for less than half.

    Attributes:
        row: number in the measurements, from 0.
        place: file and line.
        sensor: which value of the row.
        deviations: length of the residual, in standard deviations of one value.
        residual_mm: length of the residual [mm].
        residual_deg: the same of an orientation [deg].
    """

    row: int
    place: str
    sensor: str
    deviations: float
    residual_mm: float | None = None
    residual_deg: float | None = None


class TrialFigures(Section):
    """A joint correction that was tried; see `pisigma.calibration.hybrid.search.Trial`.

    Attributes:
        name: such as "gravity + series 56 + products (2, 2)".
        unknowns: number of parameters and weights.
        log_evidence: up to a constant of the data; None where it was not worked out.
        left_out: RMS of training rows that were left out of the fit, in units of the geometric calibration's.
        seconds: time it took [s].
        kept: whether it was better than what was kept before it.
    """

    name: str
    unknowns: int
    log_evidence: float | None
    left_out: float
    seconds: float
    kept: bool


class LearnedFigures(Section):
    """A joint correction that was kept.

    Attributes:
        features: name and settings of every feature.
        orders: number of factors of every product unit.
        unknowns: number of parameters and weights.
        effective_parameters: how many of them the data determine; the prior holds the others.
        linearisations: iterations of the fit.
        noise: per sensor.
        prior_scale: factor on predicted variances, by which left-out rows were met.
    """

    features: tuple[dict[str, JsonValue], ...]
    orders: tuple[int, ...]
    unknowns: int
    effective_parameters: float
    linearisations: int
    noise: tuple[NoiseFigures, ...]
    prior_scale: float


class HybridFigures(Section):
    """What a hybrid calibration found beyond the geometry.

    Attributes:
        verdict: what was kept and why, in a sentence.
        learned: the correction; None where none was kept.
        trials: what was tried, in order.
    """

    verdict: str
    learned: LearnedFigures | None
    trials: tuple[TrialFigures, ...]


class ScaleFigures(Section):
    """How far one factor on all measured lengths explains what a calibration found.

    Attributes:
        factor: lengths of the arm over drawn ones.
        sigma: its standard deviation.
        odds: of such a factor against links that err each by itself, at most 1e6.
        rms_mm: error of true positions, about their mean, where the factor is that of the sensor [mm].
    """

    factor: float
    sigma: float
    odds: float
    rms_mm: float


class HeldOutFile(Section):
    """SHA-256 of the file of held-out rows in the model folder, and of the measurements that it is of."""

    sha256: str
    data_sha256: str


class CalibrationSummary(AbstractSummary):
    """All figures of a calibration.

    Attributes:
        rows: number of rows that were calibrated with.
        fit_seconds: time that the calibration took without its validation [s].
        status: why the search ended.
        iterations: steps tried.
        rank: number of independent combinations of parameters that the data determine.
        condition_number: of the Jacobian of the free parameters.
        observability: indices O1 to O5.
        noise: per sensor.
        parameters: the parameter table.
        redundancy: which parameters the data determine.
        weak_directions: directions that the data hardly determine, a sentence each.
        scale: of the lengths, where positions were measured.
        outliers: rows that counted for less than half, the worst first.
        warnings: what to check or to measure next, a sentence each.
        rmse_mm: RMS of the first sensor's residuals at every iteration, the initial guess first.
        hybrid: what a hybrid calibration found beyond the geometry.
        cross_validation: errors of rows that were held out in turn.
        calibrated: errors of the rows that were calibrated with.
        test: errors of the rows that the file marks as test.
        held_out: errors of other simulated rows.
        predicted_rms_mm: errors that the calibration predicts at other poses, see `predicted_at_other_poses`, where no
            row was held out [mm].
        held_out_rows: hashes of the file with every held-out row.
        learning_curve: errors of held-out rows by the number of training rows.
        redundant_sets: of a recipe: sets of parameters that are redundant by pairs.
        no_effect: of a recipe: parameters without effect, by pairs.
        pairwise_parameters: of a recipe: number of parameters that are left by pairs.
        paper: of a recipe: published figures, by name.
    """

    kinds = ("geometric_calibration", "hybrid_calibration")

    rows: int | None = None
    fit_seconds: float | None = None
    status: str
    iterations: int
    rank: int
    condition_number: float | None
    observability: ObservabilityFigures
    noise: tuple[NoiseFigures, ...]
    parameters: tuple[ParameterFigures, ...]
    redundancy: RedundancyFigures
    weak_directions: tuple[str, ...]
    scale: ScaleFigures | None = None
    outliers: tuple[OutlierFigures, ...]
    warnings: tuple[str, ...]
    rmse_mm: tuple[float, ...]
    hybrid: HybridFigures | None = None
    calibrated: ValidationFigures | None = None
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
    def judged(self) -> ValidationFigures | None:
        """Held-out errors: of the cross-validation, else of simulated rows, else of the test set."""
        return self.cross_validation or self.held_out or self.test


def summarise(result: Result) -> CalibrationSummary:
    """Gather the figures of a calibration, without those of its validation.

    Args:
        result: geometric or hybrid.
    """
    geometric = geometric_result(result)
    exact, pairwise = geometric.redundancy, geometric.pairwise
    summary = CalibrationSummary(
        status=geometric.status.value,
        iterations=geometric.iterations,
        rank=geometric.rank,
        condition_number=_or_none(geometric.condition_number),
        observability=ObservabilityFigures(**asdict(geometric.observability)),
        noise=tuple(
            _noise(one.sensor, one.sigma, one.unit, values=one.values, used_by_parameters=one.used)
            for one in geometric.noise
        ),
        parameters=_parameters(geometric),
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
    return summary.having(hybrid=_hybrid(result)) if isinstance(result, HybridResult) else summary


def _parameters(result: CalibrationResult) -> tuple[ParameterFigures, ...]:
    rows = []
    for parameter in result.parameters:
        unit, factor = SHOWN_UNITS[parameter.unit]
        names = ("nominal", "estimated", "change", "standard_error")
        figures = {name: _or_none(getattr(parameter, name) * factor) for name in names}
        texts = {"name": parameter.name, "remark": parameter.remark, "label": parameter.label}
        rows.append(ParameterFigures(unit=unit, **texts, **figures))
    return tuple(rows)


def _outliers(outliers: Sequence[Outlier]) -> tuple[OutlierFigures, ...]:
    rows = []
    for outlier in outliers:
        unit, factor = SHOWN_UNITS[outlier.unit]
        figures = {"deviations": outlier.deviations, f"residual_{unit}": outlier.residual * factor}
        rows.append(OutlierFigures(row=outlier.row, place=outlier.place, sensor=outlier.sensor, **figures))
    return tuple(rows)


def _noise(sensor: str, sigma: float, unit: str, **counts: Any) -> NoiseFigures:
    if unit not in SHOWN_UNITS:
        return NoiseFigures(sensor=sensor, factor_on_stated_sigma=sigma, **counts)
    name, factor = SHOWN_UNITS[unit]
    return NoiseFigures(sensor=sensor, **{f"sigma_{name}": sigma * factor}, **counts)


def _hybrid(result: HybridResult) -> HybridFigures:
    trials = tuple(
        TrialFigures.model_validate(
            asdict(trial) | {"log_evidence": _or_none(trial.log_evidence), "seconds": round(trial.seconds, 3)}
        )
        for trial in result.trials
    )
    learned = None if result.learned is None else _learned(result, result.learned)
    return HybridFigures(verdict=result.verdict, learned=learned, trials=trials)


def _learned(result: HybridResult, learned: LearnedPart) -> LearnedFigures:
    units = {noise.sensor: noise.unit for noise in result.geometric.noise}
    return LearnedFigures(
        features=tuple(
            features.describe().model_dump(mode="json") for features in learned.correction.features
        ),
        orders=tuple(learned.correction.orders),
        unknowns=learned.unknowns,
        effective_parameters=learned.effective,
        linearisations=learned.rounds,
        noise=tuple(
            _noise(sensor, sigma, units[sensor]) for sensor, sigma in learned.noise.items() if sensor in units
        ),
        prior_scale=result.uncertainty.prior_scale,
    )


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def has_orientation(model: CalibratedModel) -> bool:
    """Say whether a model knows how its tools are turned; one that was calibrated without orientations does not."""
    summary = CalibrationSummary.read(model)
    return summary is None or any(noise.sensor in ("rotation", "corner") for noise in summary.noise)
