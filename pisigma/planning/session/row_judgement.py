"""Check rows by predicting every row from all others, again whenever rows arrive."""

import contextlib
import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.sufficiency import floating_bases
from pisigma.calibration.geometric.problem.parameters import USUAL_LENGTH
from pisigma.calibration.geometric.problem.prior_scales import PriorGroup
from pisigma.calibration.geometric.problem.setup import (
    CalibrationSetup,
    IdentifiedGeometry,
    identified_geometry,
)
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.gravity import USUAL, to_first_row_frame
from pisigma.calibration.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.estimation.dual_regression import DETERMINED, without_nuisance
from pisigma.files.errors import IdentificationError
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import CornerSensor, with_fixed_intrinsics
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import RobotClass
from pisigma.robot.se3 import (
    invert,
    rotation_from_zyx,
    transform_from_xyz_zyx,
    xyz_zyx_from_transform,
    zyx_from_rotation,
)

FALSE_ALARMS = 1e-3
"""Expected share of correct rows that are called wrong."""
FEW_ROWS = 12
"""Number of rows up to which all rows are checked again with every new row, and every row is tried as the wrong one."""
_CONTRADICTORY_FACTOR = 2.0
"""Factor on the errors of the robot's class above which few rows contradict each other."""
_MIN_MISFIT_GAIN = 8.0
"""Decrease of the misfit above which an older row is called wrong instead of a newer one."""
_REPEATABILITY = {"m": 8e-5, "rad": 1e-4}
"""Repeatability of robots of any class [m, rad], which adds to the noise of the sensor."""
_USUAL_NOISE = {"m": 5e-5, "rad": 2e-4}
"""Noise of a sensor whose noise is not stated [m, rad]."""
_CLASS_VALUES = 20
"""Weight of the robot's class in the estimate of the size of its errors, as a number of measured values."""
LINEARISATIONS = 2
"""Number of linearisations of base and tool."""


@dataclass(frozen=True, eq=False)
class LeaveOneOutErrors:
    """Errors of rows that are each predicted from the others.

    Attributes:
        p_value: probability that a correct row has an error at least as improbable; NaN for rows that cannot be
            checked.
        length_error: size of the error of the measured length [m]; NaN for rows that cannot be checked.
        angle_error: size of the error of the measured orientation [rad]; NaN for rows that cannot be checked.
        position_error: measured minus predicted position in the frame of the row [m]; NaN for rows that cannot be
            checked.
        error_scale: ratio of this robot's errors to the errors of its class, at least 1.
    """

    p_value: Float64[Tensor, " rows"]
    length_error: Float64[Tensor, " rows"]
    angle_error: Float64[Tensor, " rows"]
    position_error: Float64[Tensor, "rows 3"]
    error_scale: float


@dataclass(frozen=True, eq=False)
class RowModel:
    """Linear model of rows, with the prior of the robot's class on geometry, gravity and a Fourier series per joint.

    With the columns X of the unknowns that have a prior S, and the columns G of base, tool and sensors, which have no
    prior, the covariance of the values is `V = X S X^T + noise²`, and `P = V^-1 - V^-1 G (G^T V^-1 G)^-1 G^T V^-1`. If
    row i is left out, its error is `P_ii^-1 (P r)_i` with covariance `P_ii^-1` (Rasmussen and Williams 2006,
    sections 2.7 and 5.4.2), and its contribution to `r^T P r` is chi-square distributed.

    Attributes:
        setup: rows, and initial guesses of base and tool.
        design: the unknowns.
        values: values of each sensor, linearised at `point`.
        weight_columns: columns of the weights of gravity and series, linearised nearby.
        point: all parameters.
        sigma: standard deviation of every value [m or rad].
        kept: rows to which base and tool are fitted, and from which others are predicted.
    """

    setup: CalibrationSetup
    design: Design
    values: tuple[SensorValues, ...]
    weight_columns: Float64[Tensor, "values weights"]
    point: Float64[Tensor, " parameters"]
    sigma: Float64[Tensor, " values"]
    kept: Bool[Tensor, " rows"]

    @staticmethod
    def from_rows(
        robot: Robot,
        rows: Measurements,
        sigma: float | None,
        kept: Bool[Tensor, " rows"],
        model_with_setup: "RowModel | None" = None,
        kept_model: "RowModel | None" = None,
    ) -> "RowModel":
        """Return the model linearised at the base and tool that fit the kept rows.

        Args:
            robot: nominal robot.
            rows: all rows.
            sigma: standard deviation of measured lengths if the rows state none [m]; None for `_USUAL_NOISE`.
            kept: rows to which base and tool are fitted.
            model_with_setup: a model of the same rows, whose setup is used again; None to make one.
            kept_model: the model of the kept rows alone; None to make it.

        Raises:
            IdentificationError: there are too few rows for base and tool.
            PoseError: the joint values do not fit the robot.
        """
        setup, design = (
            _problem(robot, rows)
            if model_with_setup is None
            else (model_with_setup.setup, model_with_setup.design)
        )
        point, rounds = setup.start, LINEARISATIONS
        if not bool(kept.all()):
            kept_model = kept_model or RowModel.from_rows(robot, rows.select(kept), sigma, kept[kept])
            point, rounds = _start_at(setup, kept_model.geometry), 1
        values = sensor_values(setup.problem, point)
        columns = torch.cat([design.columns(one, slice(None)).flatten(0, 1) for one in values])
        weights = columns[:, design.active_count :]
        model = RowModel(setup, design, values, weights, point, _noise(setup, values, sigma), kept)
        for _ in range(rounds):
            point = setup.start.clone()
            point[setup.problem.active] += model._solution()[: design.active_count]
            model = replace(model, values=sensor_values(setup.problem, point), point=point)
        return model

    @property
    def geometry(self) -> IdentifiedGeometry:
        """Robot with base, tool and sensor unknowns at the linearisation point."""
        return identified_geometry(self.setup, self.point)

    @cached_property
    def misfit(self) -> float:
        """Misfit `r^T P r` of the kept rows."""
        kept = self.kept[self._row].nonzero()[:, 0]
        return float(self._residual[kept] @ self._projection(kept)[0] @ self._residual[kept])

    def leave_one_out(self) -> LeaveOneOutErrors:
        """Predict every kept row from the other kept rows, and all other rows from the kept rows.

        A robot may have larger errors than its class. The scale is therefore estimated from the kept rows, and squared
        errors are compared with Fisher's F distribution.
        """
        from scipy.special import fdtrc  # imported here, because scipy.stats takes a second to import

        rows = len(self.kept)
        square, count = torch.zeros(2, rows, dtype=torch.float64)
        errors = torch.full_like(self._residual, math.nan)
        kept = self.kept[self._row].nonzero()[:, 0]
        P, _, determined = self._projection(kept)
        self._leave_one_out(self.kept.nonzero()[:, 0], kept, P, square, count, errors)
        # The row itself must not affect the scale with which it is compared.
        left = _CLASS_VALUES + len(kept) - determined - torch.where(self.kept, count, 0.0)
        misfit = self.misfit
        # The scale is at least 1, that of the class, because rows that happen to agree must not make the limits
        # stricter.
        whole = ((_CLASS_VALUES + misfit - torch.where(self.kept, square, 0.0)) / left).clamp(min=1.0)
        # For rows that are not used, the scale is at least that of the leave-one-out errors of the kept rows.
        each = float((_CLASS_VALUES + square.sum()) / (_CLASS_VALUES + count.sum()))
        scale = torch.where(self.kept, whole, whole.clamp(min=each))
        for row in (~self.kept).nonzero()[:, 0]:
            chosen = torch.cat([kept, (self._row == row).nonzero()[:, 0]])
            self._leave_one_out(row[None], chosen, self._projection(chosen)[0], square, count, errors)
        ratio = torch.where(count > 0, square / count, torch.nan) / scale
        chance = torch.from_numpy(fdtrc(count.numpy(), left.numpy(), ratio.numpy()))
        total = max(1.0, (_CLASS_VALUES + misfit) / (_CLASS_VALUES + len(kept) - determined))
        return LeaveOneOutErrors(chance, *self._sizes(errors), total**0.5)

    def _leave_one_out(
        self, rows: Tensor, values: Tensor, P: Tensor, square: Tensor, count: Tensor, errors: Tensor
    ) -> None:
        """Fill in squares, degrees of freedom and errors of rows, each left out of some values with projection P."""
        pull = P @ self._residual[values]
        for row in rows.tolist():
            chosen = (self._row[values] == row).nonzero()[:, 0]
            sigma = self.sigma[values[chosen]]  # this makes lengths and angles comparable
            # P_ii is singular in directions that only this row determines; these cannot be judged.
            strength, axes = torch.linalg.eigh(P[chosen][:, chosen] * sigma * sigma[:, None])
            certain = strength > DETERMINED
            along = axes.t() @ (sigma * pull[chosen])
            square[row], count[row] = (along.square() / strength)[certain].sum(), certain.sum()
            if bool(certain.all()):
                errors[values[chosen]] = sigma * (axes @ (along / strength))

    def _sizes(self, errors: Float64[Tensor, " values"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return sizes of errors of lengths and orientations, and errors of positions along the axes of the frame."""
        rows = len(self.setup.measurements.q)
        length, angle = torch.full((2, rows), torch.nan, dtype=torch.float64)
        position = torch.full((rows, 3), torch.nan, dtype=torch.float64)
        start = 0
        for sensor, one in zip(self.setup.problem.sensors, self.values, strict=True):
            block = errors[start : start + one.residual.numel()].view_as(one.residual)
            start += block.numel()
            (angle if sensor.unit == "rad" else length)[one.row] = block.norm(dim=1)
            if isinstance(sensor, CornerSensor):
                # Residuals of corners are multiplied by weights, which is undone to get lengths and angles.
                block = torch.linalg.solve(sensor.weight.permute(2, 0, 1)[one.row], block[..., None])[..., 0]
                length[one.row], angle[one.row] = block[:, :3].norm(dim=1), block[:, 3:].norm(dim=1)
            if sensor.name in ("position", "corner"):
                frames = self.setup.reference_frames.bases[self.setup.problem.frame[one.row], :3, :3]
                position[one.row] = (frames @ block[:, :3, None])[..., 0]
        return length, angle, position

    def _solution(self) -> Float64[Tensor, " unknowns"]:
        """Return the mean of the unknowns given the kept rows; parameters are relative to the start."""
        return self._projection(self.kept[self._row].nonzero()[:, 0])[1]

    def _projection(self, kept: Int64[Tensor, " chosen"]) -> tuple[Tensor, Tensor, int]:
        """Return P for the kept values, the mean of the unknowns, and the number of determined unknowns of G."""
        X, r, free = self._columns[kept], self._residual[kept], self._size.isinf()
        Z, G = X[:, ~free] * self._size[~free], X[:, free]
        V = Z @ Z.t()
        V.diagonal().add_(self.sigma[kept].square())
        P, solution, determined = without_nuisance(V, G)
        x = torch.zeros_like(self._size)
        x[free], x[~free] = solution @ r, self._size[~free] * (Z.t() @ (P @ r))
        return P, x, determined

    @cached_property
    def _columns(self) -> Float64[Tensor, "values unknowns"]:
        return torch.cat(
            [torch.cat([one.geometry_derivatives.flatten(0, 1) for one in self.values]), self.weight_columns],
            1,
        )

    @cached_property
    def _row(self) -> Int64[Tensor, " values"]:
        """Row of every value."""
        return torch.cat([one.row.repeat_interleave(one.components) for one in self.values])

    @cached_property
    def _residual(self) -> Float64[Tensor, " values"]:
        """Measured minus predicted values at the start parameters, from the linearisation."""
        moved = (self.point - self.setup.start)[self.setup.problem.active]
        return torch.cat([(one.residual + one.geometry_derivatives @ moved).flatten() for one in self.values])

    @cached_property
    def _size(self) -> Float64[Tensor, " unknowns"]:
        """Prior standard deviation of the unknowns; infinite if there is no prior."""
        of_class = RobotClass.from_robot(self.setup.problem.space.robot)
        prior = self.design.prior(
            [of_class.prior_sizes.size_of(group) / USUAL_LENGTH for group in PriorGroup]
        )
        sizes = torch.cat(
            [
                prior.group_scales[: prior.geometric_class_count],
                prior.group_scales.new_tensor([of_class.gravity_sigma, *of_class.series_sigmas]),
            ]
        )
        return replace(prior, group_scales=sizes).precision.rsqrt()


def _problem(robot: Robot, rows: Measurements) -> tuple[CalibrationSetup, Design]:
    """Return the setup with initial guesses of base and tool, and the unknowns."""
    calibrator = GeometricCalibrator(robot)
    setup = calibrator.build(with_fixed_intrinsics(rows, _REPEATABILITY["m"], _REPEATABILITY["rad"]))
    floating = set(floating_bases(setup))
    chosen = [index for index in calibrator.candidates(setup.problem.space) if index not in floating]
    active = [*setup.free_unknowns, *chosen]
    setup = replace(setup, problem=setup.problem.with_active(active))
    gravity = GravityTorques(robot, to_first_row_frame(robot, USUAL))
    return setup, Design(
        setup.problem, (gravity, FourierSeries(robot, RobotClass.from_robot(robot).harmonics))
    )


def _start_at(setup: CalibrationSetup, geometry: IdentifiedGeometry) -> Float64[Tensor, " parameters"]:
    """Return the start parameters with the bases and tools of another fit, where it has them."""
    bases, tools = (block.clone() for block in setup.problem.space.split(setup.start)[1:])
    for number, frame in enumerate(setup.problem.space.frames):
        if frame in geometry.bases:
            T = transform_from_xyz_zyx(torch.from_numpy(geometry.bases[frame]))
            bases[number] = xyz_zyx_from_transform(invert(setup.reference_frames.bases[number]) @ T)
    for number, target in enumerate(setup.problem.space.targets):
        if target in geometry.tools:
            tool = torch.from_numpy(geometry.tools[target])
            R = rotation_from_zyx(tool[3:]) @ setup.reference_frames.tools[number].mT
            tools[number] = torch.cat([tool[:3], zyx_from_rotation(R)])
    point = setup.start.clone()
    for name, block in (("base", bases), ("tool", tools)):
        stretch = setup.problem.space.indices_of(name)
        point[stretch.start : stretch.stop] = block.flatten()
    return point


def _noise(
    setup: CalibrationSetup, values: tuple[SensorValues, ...], sigma: float | None
) -> Float64[Tensor, " values"]:
    """Return the standard deviation of every value, including the repeatability of the robot."""
    blocks = []
    for sensor, one in zip(setup.problem.sensors, values, strict=True):
        usual = _USUAL_NOISE[sensor.unit] if sigma is None or sensor.unit == "rad" else sigma
        noise = 1 / one.weight_root if one.has_stated_noise else torch.full_like(one.weight_root, usual)
        noise = (noise.square() + _REPEATABILITY[sensor.unit] ** 2).sqrt()
        if isinstance(sensor, CornerSensor):  # the weights of corners include the repeatability
            noise = torch.as_tensor(setup.measurements.readings[NOISE_COLUMN])[one.row]
        blocks.append(noise.repeat_interleave(one.components))
    return torch.cat(blocks)


@dataclass(frozen=True, eq=False)
class RowJudgement:
    """Result of checking rows against each other.

    Attributes:
        used_rows: mask of the rows that the others do not contradict.
        model: model of the used rows; None if there are too few to fit base and tool.
        errors: errors of all rows under this model; None if there is no model.
    """

    used_rows: Bool[Tensor, " rows"]
    model: RowModel | None = None
    errors: LeaveOneOutErrors | None = None


def judge_rows(
    robot: Robot, rows: Measurements, sigma: float | None, trusted: Bool[Tensor, " rows"]
) -> RowJudgement:
    """Check new rows against the rows accepted so far, and accepted rows against each other.

    Args:
        robot: nominal robot.
        rows: all rows, the last ones new.
        sigma: see `RowModel.from_rows`.
        trusted: rows accepted so far; if there are `FEW_ROWS` or fewer, none is trusted.
    """
    few = rows.rows <= FEW_ROWS
    counts = torch.ones_like(trusted) if few else trusted.clone()
    try:
        model = RowModel.from_rows(robot, rows, sigma, counts)
        errors = model.leave_one_out()
        while (wrong := _contradicted(robot, rows, sigma, model, errors, few)) is not None:
            model, errors = wrong
        right = ~(errors.p_value < FALSE_ALARMS) & ~model.kept
        if bool(right.any()):
            model = RowModel.from_rows(robot, rows, sigma, model.kept | right, model)
            again = model.leave_one_out()
            errors = replace(again, p_value=errors.p_value)
        return RowJudgement(model.kept, model, errors)
    except IdentificationError:  # too few rows for base and tool
        return RowJudgement(torch.ones_like(trusted))


def _contradicted(
    robot: Robot,
    rows: Measurements,
    sigma: float | None,
    model: RowModel,
    errors: LeaveOneOutErrors,
    few: bool,
) -> tuple[RowModel, LeaveOneOutErrors] | None:
    """Return the result without the row that the other rows contradict; None if there is no such row.

    A wrong row among few moves base and tool so far that it can only be found by leaving out every row once.
    """
    counts = model.kept
    chance = torch.where(counts, errors.p_value, torch.nan)
    suspects = [int(chance.nan_to_num(nan=1.0).argmin())] if bool((chance < FALSE_ALARMS).any()) else []
    if few and (suspects or errors.error_scale > _CONTRADICTORY_FACTOR):
        suspects = counts.nonzero()[:, 0].tolist()
    fits: dict[int, RowModel] = {}
    for row in suspects if len(suspects) > 1 else ():
        others = counts.clone()
        others[row] = False
        with contextlib.suppress(IdentificationError):
            every = torch.ones(int(others.sum()), dtype=torch.bool)
            fits[row] = RowModel.from_rows(robot, rows.select(others), sigma, every)
    misfits = {row: fit.misfit for row, fit in fits.items()}
    least = min(misfits.values(), default=0.0)
    likely = [row for row in suspects if misfits.get(row, math.inf) <= least + _MIN_MISFIT_GAIN] or suspects
    for row in likely[-1:]:
        others = counts.clone()
        others[row] = False
        model = RowModel.from_rows(robot, rows, sigma, others, model, fits.get(row))
        errors = model.leave_one_out()
        if float(errors.p_value[row]) < FALSE_ALARMS:
            return model, errors
    return None
