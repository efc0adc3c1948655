"""Any number of models on the same measured rows."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.judging.bootstrap import Bootstrap, Statistics
from pisigma.judging.moved_frames import poses_in_fitted_frames
from pisigma.judging.paired_comparison import PairedComparison, paired_comparisons
from pisigma.judging.pose_statistics import ErrorVectors
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import poses_of_rows


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """Errors of measured rows under one model.

    Attributes:
        name: what the model is called.
        vectors: errors of every row; NaN where one of the compared models predicts nothing.
        not_predicted: rows with a measured position for which this model predicts nothing.
        inside: per row, whether it is inside the model's domain; None where the model knows none.
    """

    name: str
    vectors: ErrorVectors
    not_predicted: int
    inside: Bool[Tensor, " rows"] | None


@dataclass(frozen=True, eq=False)
class Compared:
    """One quantity, position or orientation, of all models on the rows that all of them predict.

    Attributes:
        unit: "mm" or "deg", for tables and files.
        errors: lengths or angles [m or rad], one line a model.
        group: number of every row's configuration, from 0.
        bootstrap: draws the configurations.
    """

    unit: str
    errors: Float64[Tensor, "models rows"]
    group: Int64[Tensor, " rows"]
    bootstrap: Bootstrap

    @property
    def configurations(self) -> int:
        """Number of different configurations."""
        return int(self.group.max()) + 1

    @cached_property
    def resampled(self) -> Statistics:
        """Statistics of every resample."""
        return self.bootstrap.statistics(self.errors, self.group)

    def intervals(self) -> dict[str, Float64[Tensor, "models 2"]]:
        """Confidence intervals of mean, RMS and 95 % quantile [m or rad]."""
        return {
            name: self.bootstrap.intervals(values, self.configurations)
            for name, values in self.resampled.items()
        }

    def to_first(self) -> tuple[PairedComparison, ...]:
        """Every model against the first."""
        return paired_comparisons(self.errors, self.group, self.bootstrap, self.resampled)


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Models on the same rows.

    Attributes:
        models: in the order in which they were given.
        position: of the rows with a measured position.
        orientation: of the rows with a measured orientation; None where there is none.
        unmeasured: rows that hold no position.
    """

    models: tuple[ModelErrors, ...]
    position: Compared
    orientation: Compared | None
    unmeasured: int

    @property
    def rows(self) -> int:
        """Rows whose positions are compared."""
        return self.position.errors.shape[1]


def compare_models(
    models: Mapping[str, CalibratedModel],
    measurements: Measurements,
    bootstrap: Bootstrap | None = None,
    fit_frame: bool = False,
) -> ModelComparison:
    """Judge models on measurements; rows for which one of them predicts nothing count for none.

    Args:
        models: by name, one or more.
        measurements: the rows, in the frames that the models were fitted in.
        bootstrap: how confidence intervals are found; `Bootstrap()` where none is given.
        fit_frame: fit the frames anew, for every model; see `poses_in_fitted_frames`.

    Raises:
        MeasurementError: no positions were measured, or in a frame or of a target that a model does not know, or no
            row is predicted by all models.
        PoseError: the joint values do not fit a model's robot.
    """
    bootstrap = bootstrap or Bootstrap()
    predict = poses_in_fitted_frames if fit_frame else poses_of_rows
    found = {
        name: ErrorVectors.between(measurements, predict(model, measurements))
        for name, model in models.items()
    }
    assert measurements.position is not None  # or there were no errors
    measured = torch.isfinite(measurements.position).all(-1)
    predicted = {name: torch.isfinite(errors.position).all(-1) for name, errors in found.items()}
    common = torch.stack(list(predicted.values())).all(0)
    if not common.any():
        raise MeasurementError(
            f"{measurements.source}: there is no row with a measured position that {', '.join(found)} predict; give "
            "rows nearer to what was calibrated with."
        )
    group = groups_to_keep_whole(measurements)
    judged = tuple(
        ModelErrors(
            name,
            found[name].only(common),
            int((measured & ~predicted[name]).sum()),
            inside_domain(model, measurements),
        )
        for name, model in models.items()
    )
    sizes = [errors.vectors.sizes for errors in judged]
    position = _compared("mm", [size.position for size in sizes], group, bootstrap)
    angles = [size.rotation for size in sizes if size.rotation is not None]
    turned = bool(angles) and bool(torch.isfinite(angles[0]).any())
    orientation = _compared("deg", angles, group, bootstrap) if turned else None
    return ModelComparison(judged, position, orientation, int((~measured).sum()))


def inside_domain(model: CalibratedModel, measurements: Measurements) -> Bool[Tensor, " rows"] | None:
    """Whether rows are inside a model's domain: where its correction was learned and is in force in full.

    Returns:
        None where the model knows no domain, as geometric calibrations do not.
    """
    if model.hybrid is not None:
        return model.hybrid.coverage.share(measurements.q) == 1
    if model.network is None or model.domain is None:
        return None
    with torch.no_grad():
        q = model.nominal_joints(measurements.q)
        known = torch.isfinite(q).all(-1)
        at = torch.where(known[:, None], q, 0.0)
        scaled = model.network.scaled_inputs(forward_kinematics(model.robot, at), at)
        return known & model.domain.contains(scaled)


def _compared(
    unit: str, errors: list[Float64[Tensor, " rows"]], group: Int64[Tensor, " rows"], bootstrap: Bootstrap
) -> Compared:
    stacked = torch.stack(errors)
    there = torch.isfinite(stacked).all(0)
    _, number = torch.unique(group[there], return_inverse=True)
    return Compared(unit, stacked[:, there], number, bootstrap)
