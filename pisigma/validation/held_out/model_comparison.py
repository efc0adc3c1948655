"""Comparison of models on the same rows: errors, differences of errors, and confidence intervals of both."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.sensors.socket import PairOfSockets
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, errors_in_fitted_frames
from pisigma.validation.held_out.frames.row_errors import has_position, rows_with_only_length
from pisigma.validation.held_out.pose_statistics import axis_statistics, error_statistics
from pisigma.validation.held_out.rank_tests import SignedRank, signed_rank
from pisigma.validation.held_out.trained_calibrations import DistanceErrors, distance_figures
from pisigma.validation.held_out.validation_figures import SocketDistances
from pisigma.validation.resampling import Bootstrap

Interval = tuple[float, float]
"""Lower and upper end of a confidence interval."""
_UNITS = {"position": ("mm", 1e3), "orientation": ("deg", float(np.rad2deg(1.0)))}
"""Unit of every quantity in tables and files, and its factor from SI units."""
STATISTICS = ("mean", "rms", "p95")
"""Statistics with a confidence interval; the maximum has none, because no resample exceeds the measured maximum."""
_QUANTILE = 0.95
"""Quantile of the statistic "p95"."""
_BATCH = 2**16
"""Number of indices that are drawn at a time."""


@dataclass(frozen=True)
class Intervals:
    """Confidence intervals of the statistics in `STATISTICS` for several models [m or rad].

    Attributes:
        value: lower and upper end of each statistic of each model; NaN if there is only one configuration.
        difference: the same for the difference from the first model.
    """

    value: Float64[np.ndarray, "statistics models 2"]
    difference: Float64[np.ndarray, "statistics models 2"]


def confidence_intervals(
    bootstrap: Bootstrap, errors: Float64[np.ndarray, "models rows"], group: Int64[np.ndarray, " rows"]
) -> Intervals:
    """Compute the intervals of all models on the same resamples.

    Args:
        bootstrap: settings of the bootstrap.
        errors: lengths or angles of the errors of the same rows under every model [m or rad], without NaN.
        group: index of every row's group, from 0; every index occurs.
    """
    from scipy import stats

    groups = int(group.max()) + 1
    if groups < 2:
        unknown = np.full((len(STATISTICS), len(errors), 2), np.nan)
        return Intervals(unknown, unknown)

    def of_resamples(sampled: Int64[np.ndarray, "*resamples groups"], axis: int) -> np.ndarray:
        drawn = sampled.reshape(-1, groups) + groups * np.arange(sampled.size // groups)[:, None]
        times = np.bincount(drawn.ravel(), minlength=drawn.size).reshape(sampled.shape)
        values = np.stack([statistics(of_model, times[..., group]) for of_model in errors], 1)
        return np.stack([values, values - values[:, :1]])

    result = stats.bootstrap(
        (np.arange(groups),),
        of_resamples,
        vectorized=True,
        method="percentile",
        n_resamples=bootstrap.resamples,
        confidence_level=bootstrap.confidence,
        batch=max(1, _BATCH // errors.shape[1]),
        rng=np.random.default_rng(bootstrap.seed),
    )
    return Intervals(*np.stack([result.confidence_interval.low, result.confidence_interval.high], -1))


def statistics(
    errors: Float64[np.ndarray, " rows"], multiplicity: Int64[np.ndarray, "*resamples rows"]
) -> Float64[np.ndarray, "statistics *resamples"]:
    """Compute mean, RMS and 95 % quantile of errors with given multiplicities, in the order of `STATISTICS`."""
    order = np.argsort(errors)
    errors, times = errors[order], multiplicity[..., order]
    last = times.cumsum(-1)
    count = last[..., -1]
    place = _QUANTILE * (count - 1)
    lower, upper = (errors[(last <= end[..., None]).sum(-1)] for end in (np.floor(place), np.ceil(place)))
    quantile = lower + (place - np.floor(place)) * (upper - lower)
    return np.stack([times @ errors / count, np.sqrt(times @ errors**2 / count), quantile])


@dataclass(frozen=True)
class Difference:
    """Errors of a model minus those of the first model on the same rows; < 0 if the model is better.

    Attributes:
        statistics: differences by name ("mean", "rms", "p95") [mm or deg].
        intervals: their confidence intervals; None if there is only one configuration.
        test: Wilcoxon's signed-rank test of the mean differences of configurations.
        better_share: share of the configurations in which the model's mean error is smaller [1].
    """

    statistics: Mapping[str, float]
    intervals: Mapping[str, Interval | None]
    test: SignedRank
    better_share: float

    def to_json(self, unit: str) -> dict[str, object]:
        """Return the figures as plain values, with the unit in their names."""
        values: dict[str, object] = {f"{name}_{unit}": value for name, value in self.statistics.items()}
        values |= {f"{name}_{unit}_interval": interval for name, interval in self.intervals.items()}
        return values | {"better_share": self.better_share, "wilcoxon": asdict(self.test)}


@dataclass(frozen=True)
class QuantityErrors:
    """Errors of one quantity under one model, in the unit of tables and files.

    Attributes:
        unit: "mm" for positions, "deg" for orientations.
        statistics: statistics of the sizes of the errors by name ("rms", "mean", "p95", "max").
        intervals: confidence intervals of "mean", "rms" and "p95"; None if there is only one configuration.
        axes: by axis of the frame, "mean" of the signed errors and "rms", "p95", "max" of their sizes; empty if some
            rows have lengths instead of positions.
        inside_statistics: `statistics` of the rows inside the model's domain; empty if there are none or the model has
            no domain.
        outside_statistics: the same for the rows outside it.
        difference: difference from the first model; None for the first model.
    """

    unit: str
    statistics: Mapping[str, float]
    intervals: Mapping[str, Interval | None]
    axes: Mapping[str, Mapping[str, float]]
    inside_statistics: Mapping[str, float]
    outside_statistics: Mapping[str, float]
    difference: Difference | None


@dataclass(frozen=True)
class ModelFigures:
    """All figures of one of the compared models.

    Attributes:
        name: name of the model.
        rows_not_predicted: number of rows with a measured length for which this model has no prediction.
        position: errors of positions, and of the lengths of other sensors in rows without a position.
        orientation: errors of orientations; None if none was measured.
        rows_inside_domain: number of compared rows inside the model's domain; None if it has no domain.
        rows_outside_domain: number of compared rows outside it; None if it has no domain.
    """

    name: str
    rows_not_predicted: int
    position: QuantityErrors
    orientation: QuantityErrors | None
    rows_inside_domain: int | None
    rows_outside_domain: int | None

    @property
    def quantities(self) -> dict[str, QuantityErrors]:
        """Errors of "position" and, if measured, of "orientation"."""
        both = {"position": self.position, "orientation": self.orientation}
        return {name: errors for name, errors in both.items() if errors is not None}

    @property
    def statistics_in_file_units(self) -> dict[str, float]:
        """Statistics of all quantities, such as "rms_mm" and "max_deg"."""
        return _with_units(list(self.quantities.values()), "statistics")

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values; names end with the unit."""
        errors = list(self.quantities.values())
        values: dict[str, object] = {"name": self.name, "rows_not_predicted": self.rows_not_predicted}
        values |= self.statistics_in_file_units
        values["intervals"] = _with_units(errors, "intervals")
        values["axes"] = {
            axis: {f"{name}_{one.unit}": value for one in errors for name, value in one.axes[axis].items()}
            for axis in self.position.axes
        }
        for where, rows in (("inside", self.rows_inside_domain), ("outside", self.rows_outside_domain)):
            if rows is not None:
                values[f"{where}_domain"] = (
                    {"rows": rows, **_with_units(errors, f"{where}_statistics")} if rows else None
                )
        if self.position.difference is not None:
            values["difference_to_first"] = {
                quantity: one.difference.to_json(one.unit)
                for quantity, one in self.quantities.items()
                if one.difference is not None
            }
        return values


@dataclass(frozen=True)
class ModelComparison:
    """Comparison of models on the same rows.

    Attributes:
        models: figures of the models, in the given order.
        rows: number of compared rows.
        rows_without_position: number of rows without a position or another length that can be evaluated.
        configurations: number of different configurations of the compared rows.
        bootstrap: settings of the confidence intervals.
        socket_distance: errors of stated distances between sockets; None if none is stated.
    """

    models: tuple[ModelFigures, ...]
    rows: int
    rows_without_position: int
    configurations: int
    bootstrap: Bootstrap
    socket_distance: SocketDistances | None = None

    def to_json(self) -> dict[str, object]:
        """Return the comparison as plain values."""
        distances = (
            {} if self.socket_distance is None else self.socket_distance.model_dump(exclude_unset=True)
        )
        return {
            "rows_compared": self.rows,
            "rows_without_position": self.rows_without_position,
            "configurations": self.configurations,
            "bootstrap": asdict(self.bootstrap),
            "models": [model.to_json() for model in self.models],
            **({"socket_distance": distances} if distances else {}),
        }


@torch.no_grad()
def compare_models(
    models: Mapping[str, CalibratedModel],
    measurements: Measurements,
    bootstrap: Bootstrap | None = None,
    fitted_kinds: Collection[FrameKind] = (),
    socket_distances: Mapping[PairOfSockets, float] = MappingProxyType({}),
) -> ModelComparison:
    """Compare models on measurements, using only rows that all models predict.

    Args:
        models: one or more models by name.
        measurements: the rows, in the frames in which the models were fitted.
        bootstrap: settings of the confidence intervals; None for `Bootstrap()`.
        fitted_kinds: frames or targets that are fitted to the rows for every model; see `errors_in_fitted_frames`.
        socket_distances: stated distances between sockets of the rows [m].

    Raises:
        MeasurementError: no lengths were measured, a model does not have a frame or target, no row is predicted by all
            models, or a frame or target that is fitted has too few rows.
        PoseError: the joint values do not fit a model's robot.
    """
    bootstrap = bootstrap or Bootstrap()
    vectors = {
        name: errors_in_fitted_frames(model, measurements, fitted_kinds) for name, model in models.items()
    }
    measured, others = has_position(measurements), rows_with_only_length(measurements)
    if not bool((measured | others).any()):
        raise MeasurementError(
            expected="positions, balls in sockets, wires, pairs or touches",
            value=Phrase("none"),
            at=Place(measurements.source),
            remedy="give the columns x_mm, y_mm, z_mm",
        )
    predicted = {name: torch.isfinite(errors.position).all(-1) for name, errors in vectors.items()}
    common = torch.stack(list(predicted.values())).all(0)
    if not common.any():
        raise MeasurementError(
            f"there is no row with a measured length that {', '.join(models)} predict",
            at=Place(measurements.source),
            remedy="give rows nearer to those of the calibration, and two or more of every socket",
        )
    measured = measured | (others & torch.stack(list(predicted.values())).any(0))
    domains = [inside_domain(model, measurements) for model in models.values()]
    group = groups_to_keep_whole(measurements)
    positions = _quantity(
        "position", [errors.position for errors in vectors.values()], common, domains, group, bootstrap
    )
    orientations: Sequence[QuantityErrors | None] = [None] * len(models)
    turns = [errors.rotation for errors in vectors.values() if errors.rotation is not None]
    if turns and bool(torch.isfinite(turns[0][common]).any()):
        orientations = _quantity("orientation", turns, common, domains, group, bootstrap)
    figures = [
        ModelFigures(
            name=name,
            rows_not_predicted=int((measured & ~predicted[name]).sum()),
            position=position,
            orientation=orientation,
            rows_inside_domain=None if inside is None else int((common & inside).sum()),
            rows_outside_domain=None if inside is None else int((common & ~inside).sum()),
        )
        for name, position, orientation, inside in zip(models, positions, orientations, domains, strict=True)
    ]
    if bool((common & others).any()):
        figures = [replace(one, position=replace(one.position, axes={})) for one in figures]
    unmeasured, configurations = int((~measured).sum()), len(set(group[common].tolist()))
    distances = _distances(models, measurements.select(common.nonzero()[:, 0]), socket_distances)
    return ModelComparison(
        tuple(figures), int(common.sum()), unmeasured, configurations, bootstrap, distances
    )


def _distances(
    models: Mapping[str, CalibratedModel], rows: Measurements, stated: Mapping[PairOfSockets, float]
) -> SocketDistances | None:
    """Compute the figures of stated distances between sockets at the mean predicted positions of their balls."""
    poses = {name: poses_of_rows(model, rows) for name, model in models.items() if stated}
    return distance_figures([DistanceErrors.from_poses(poses, stated, rows)])


def inside_domain(model: CalibratedModel, measurements: Measurements) -> Bool[Tensor, " rows"] | None:
    """Return the mask of rows inside a model's domain, in which its correction was learned.

    Returns:
        The mask; None if the model has no domain, as for geometric calibrations.
    """
    if model.hybrid is not None:
        return model.hybrid.coverage.contains(measurements.q)
    if model.network is None or model.domain is None:
        return None
    with torch.no_grad():
        q = model.nominal_joints(measurements.q)
        finite = torch.isfinite(q).all(-1)
        at = torch.where(finite[:, None], q, 0.0)
        scaled = model.network.scaled_inputs(forward_kinematics(model.robot, at), at)
        return finite & model.domain.contains(scaled)


def _quantity(
    quantity: str,
    vectors: Sequence[Float64[Tensor, "rows 3"]],
    common: Bool[Tensor, " rows"],
    domains: Sequence[Bool[Tensor, " rows"] | None],
    group: Int64[Tensor, " rows"],
    bootstrap: Bootstrap,
) -> list[QuantityErrors]:
    """Compute the figures of a quantity for all models, on the common rows that have it under all models."""
    unit, factor = _UNITS[quantity]
    stacked = torch.stack(list(vectors)) * factor
    there = common & torch.isfinite(stacked).all(-1).all(0)
    sizes = stacked.norm(dim=-1)[:, there].numpy()
    index = torch.unique(group[there], return_inverse=True)[1].numpy()
    intervals = confidence_intervals(bootstrap, sizes, index)
    differences = _differences(sizes, index, intervals)
    figures = []
    for number, (errors, inside) in enumerate(zip(stacked[:, there], domains, strict=True)):
        within = None if inside is None else inside[there]
        figures.append(
            QuantityErrors(
                unit=unit,
                statistics=error_statistics(errors.norm(dim=-1)),
                intervals=_by_name(intervals.value[:, number]),
                axes={axis: axis_statistics(along) for axis, along in zip("xyz", errors.T, strict=True)},
                inside_statistics=_some(errors, within),
                outside_statistics=_some(errors, None if within is None else ~within),
                difference=differences[number] if number else None,
            )
        )
    return figures


def _differences(
    sizes: Float64[np.ndarray, "models rows"], group: Int64[np.ndarray, " rows"], intervals: Intervals
) -> list[Difference]:
    """Compare every model with the first one, including itself."""
    values = np.stack([statistics(of_model, np.ones_like(group)) for of_model in sizes], 1)
    means = np.stack([np.bincount(group, row) for row in sizes]) / np.bincount(group)
    return [
        Difference(
            statistics=dict(zip(STATISTICS, (values[:, model] - values[:, 0]).tolist(), strict=True)),
            intervals=_by_name(intervals.difference[:, model]),
            test=signed_rank(mean - means[0]),
            better_share=float((mean < means[0]).mean()),
        )
        for model, mean in enumerate(means)
    ]


def _by_name(ends: Float64[np.ndarray, "statistics 2"]) -> dict[str, Interval | None]:
    pairs = [None if np.isnan(low) else (float(low), float(high)) for low, high in ends]
    return dict(zip(STATISTICS, pairs, strict=True))


def _some(errors: Float64[Tensor, "rows 3"], rows: Bool[Tensor, " rows"] | None) -> dict[str, float]:
    """Compute the statistics of some rows; empty if there are none."""
    return {} if rows is None or not bool(rows.any()) else error_statistics(errors[rows].norm(dim=-1))


def _with_units(errors: Sequence[QuantityErrors], name: str) -> dict[str, Any]:
    return {f"{key}_{one.unit}": value for one in errors for key, value in getattr(one, name).items()}
