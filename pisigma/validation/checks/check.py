"""Interface of the checks of calibrations and of rows, and their inputs: a calibration, or rows with predictions."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Final, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses
from pisigma.robot.robot_class import RobotClass
from pisigma.validation.held_out.calibration_validation import CalibrationValidation, pose_errors_of
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fit_frames, with_known_names
from pisigma.validation.held_out.trained_calibrations import Result, geometric_result
from pisigma.validation.held_out.validation_figures import ValidationFigures
from pisigma.validation.setup_faults.setup_fault import SetupFault
from pisigma.validation.setup_faults.setup_faults import find_setup_faults, without_unknown_orientation


@dataclass(frozen=True, eq=False)
class CheckedCalibration:
    """Input of the checks of a calibration: the calibration, its rows and further results.

    Attributes:
        calibrator: the calibrator of the geometric calibration, with which checks also fit other robots to the same
            rows.
        rows: the rows of the calibration, as read; `rows.place(row)` names file and line.
        results: results by name, all fitted to these rows: "nominal" (the nominal arm with base and tool fitted, all
            rows with full weight), "geometric", and "hybrid" if one was requested.
        validation: errors of held-out rows; None if no rows were held out.
    """

    calibrator: GeometricCalibrator
    rows: Measurements
    results: Mapping[str, Result]
    validation: CalibrationValidation | None = None

    @property
    def robot(self) -> Robot:
        """The nominal robot."""
        return self.calibrator.robot

    @property
    def robot_class(self) -> RobotClass:
        """The stated class of the robot, or else its manufacturer's class."""
        return self.calibrator.class_of_robot

    @property
    def nominal(self) -> CalibrationResult:
        """The nominal arm with base and tool fitted."""
        return geometric_result(self.results["nominal"])

    @property
    def geometric(self) -> CalibrationResult:
        """The geometric calibration, on which a hybrid is based."""
        return geometric_result(self.results["geometric"])

    @property
    def hybrid(self) -> HybridResult | None:
        """The hybrid calibration; None if only a geometric calibration was requested."""
        result = self.results.get("hybrid")
        return result if isinstance(result, HybridResult) else None

    @cached_property
    def errors(self) -> Mapping[str, Mapping[str, Float64[Tensor, "rows components"]]]:
        """Errors (measured minus predicted) by result and sensor [m or rad].

        They are in the order of `rows`, with NaN in rows without a value of the sensor.
        """
        return MappingProxyType({name: result.errors_of(self.rows) for name, result in self.results.items()})

    @property
    def final_errors(self) -> Mapping[str, Float64[Tensor, "rows components"]]:
        """Errors [m or rad], by sensor, of the last result, which is the calibration that is kept."""
        return list(self.errors.values())[-1]

    @cached_property
    def figures(self) -> ValidationFigures | None:
        """Error figures of the rows of the calibration by result; None if no length was measured."""
        errors = {name: pose_errors_of(result, self.rows) for name, result in self.results.items()}
        if not any(bool(torch.isfinite(one.position).any()) for one in errors.values()):
            return None
        return ValidationFigures(rows=self.rows.rows, **{name: one.figures for name, one in errors.items()})


Move = Literal["frame", "tool", "joint_zero"]
"""What may have moved since a model was made; see the kinds of `Cause`."""
MOVES: Final[frozenset[Move]] = frozenset({"frame", "tool", "joint_zero"})
LARGE_SHARE = 2e-3
"""Size of errors, as a share of the reach, above which their cause is a mistake or a motion, not wear."""
_STEP = 1e-6
"""Step of finite differences with respect to joint values [rad or m]."""
FITTED_PARAMETERS = 9
"""Number of parameters of a base and of the position of a tool."""
MIN_POSITION_ROWS = 5
"""Smallest number of rows with positions that a check requires."""


@dataclass(frozen=True, eq=False)
class RowsUnderModel:
    """Rows with positions, and the predictions of a model for them.

    Attributes:
        model: the model.
        rows: the rows.
        fitted_kinds: frames and tools that are known to have moved and are therefore fitted to the rows.
        allowed_moves: what else may have moved without this being a fault, such as "joint_zero".
        nominal: the nominal robot with base and tool fitted; used only to report its errors after a correction.
    """

    model: CalibratedModel
    rows: Measurements
    fitted_kinds: tuple[FrameKind, ...]
    allowed_moves: frozenset[Move]
    nominal: CalibratedModel | None = None

    @staticmethod
    def from_rows(
        model: CalibratedModel,
        rows: Measurements,
        fitted_kinds: Collection[FrameKind],
        allowed_moves: Collection[Move],
        nominal: CalibratedModel | None = None,
    ) -> "RowsUnderModel | None":
        """Return the rows with a measured and a predicted position; None if there are too few.

        Frames and targets that the model does not have are fitted.
        """
        if rows.position is None:
            return None
        kinds = kinds_to_fit(model, rows, fitted_kinds)
        some = without_unknown_orientation(model, rows)
        T = poses_of_rows(model, with_known_names(model, some, kinds))
        there = torch.isfinite(rows.position).all(-1) & torch.isfinite(T).flatten(1).all(-1)
        if int(there.sum()) < MIN_POSITION_ROWS:
            return None
        some = replace(some.select(there), pair=None, distance=None)
        return RowsUnderModel(model, some, kinds, frozenset(allowed_moves), nominal)

    @cached_property
    def renamed_rows(self) -> Measurements:
        """The rows, with the names of fitted frames and targets replaced by names of the model."""
        return with_known_names(self.model, self.rows, self.fitted_kinds)

    @cached_property
    def poses_before_fit(self) -> Float64[Tensor, "rows 4 4"]:
        """Predicted poses before anything is fitted."""
        return poses_of_rows(self.model, self.renamed_rows)

    def poses_with_moved_zeros(
        self, zero_shifts: Float64[Tensor, " dof"] | None = None
    ) -> tuple[Float64[Tensor, "rows 4 4"], Float64[Tensor, "dof rows 4 4"]]:
        """Return poses predicted with moved joint zeros [rad or m], and their derivatives from finite differences."""
        rows = self.renamed_rows
        by = _STEP * torch.cat([torch.zeros(1, rows.dof), torch.eye(rows.dof)]).double()
        q = rows.q + (by if zero_shifts is None else zero_shifts + by)[:, None]
        moved = Measurements(q.flatten(0, 1), frame=rows.frame * len(q), target=rows.target * len(q))
        T = poses_of_rows(self.model, moved).reshape(*q.shape[:2], 4, 4)
        return T[0], (T[1:] - T[0]) / _STEP

    @cached_property
    def predicted(self) -> Float64[Tensor, "rows 4 4"]:
        """Predicted poses, with fitted frames and tools."""
        return (
            fit_frames(self.poses_before_fit, self.measured, self.rows, self.fitted_kinds)[0]
            if self.fitted_kinds
            else self.poses_before_fit
        )

    @cached_property
    def measured(self) -> MeasuredPoses:
        """The measured poses."""
        return MeasuredPoses.from_tensors(
            self.rows.position, self.rows.rotation, LEVER_SHARE * self.model.robot.reach
        )

    @cached_property
    def errors(self) -> Float64[Tensor, " rows"]:
        """Lengths of the position errors [m]."""
        return self.error_lengths(self.predicted)

    def error_lengths(self, T: Float64[Tensor, "*batch rows 4 4"]) -> Float64[Tensor, "*batch rows"]:
        """Compute the lengths of the position errors of predicted poses [m]."""
        result: Tensor = (self.measured.position - T[..., :3, 3]).norm(dim=-1)
        return result

    @cached_property
    def predicted_sigma(self) -> Float64[Tensor, " rows"]:
        """Predicted standard deviation of every row's error [m], including noise; NaN if the model has none."""
        deviation = sigma_of_rows(self.model, self.renamed_rows).square().sum(-1)
        known = self.model.uncertainty
        noise = torch.as_tensor(math.nan if known is None else _position_noise(known.noise))
        if known is not None and self.rows.sigma_position is not None:
            factor = known.noise.value.get("position", 1.0) if known.noise.is_factor("position") else 1.0
            noise = torch.where(self.rows.sigma_position.isnan(), noise, factor * self.rows.sigma_position)
        result: Tensor = (deviation + 3 * noise.square()).sqrt()
        return result

    @cached_property
    def has_large_errors(self) -> bool:
        """Whether the errors of positions and orientations are too large for wear."""
        error = float(self.measured.squared_errors(self.predicted).mean().sqrt())
        return error > LARGE_SHARE * self.model.robot.reach

    @cached_property
    def setup_faults(self) -> tuple[SetupFault, ...]:
        """Setup faults of any size that explain the errors of all rows."""
        return find_setup_faults(self.model, self.nominal, self.rows, self.fitted_kinds)

    @cached_property
    def moved_frames(self) -> tuple[SetupFault, ...]:
        """Motions of frames and tools of any size that explain the errors."""
        return find_setup_faults(self.model, self.nominal, self.rows, self.fitted_kinds, frames_only=True)

    def is_allowed_motion(self, fault: SetupFault) -> bool:
        """Return whether a fault is an allowed motion: of frames, tools, or the zero of a single joint."""
        return self.allowed_moves.issuperset(fault.kinds) and len(set(fault.joints)) <= 1


Check = Callable[[CheckedCalibration], Iterator[Diagnostic]]
"""Check of a calibration for one kind of fault.

It yields nothing if it finds no fault, and raises `IdentificationError` if the rows cannot belong to this robot."""
RowCheck = Callable[[RowsUnderModel], Iterator[Diagnostic]]
"""Check of rows for one kind of fault, using the predictions of a model."""


def kinds_to_fit(
    model: CalibratedModel, rows: Measurements, fitted_kinds: Collection[FrameKind]
) -> tuple[FrameKind, ...]:
    """Return what is fitted, including frames or tools if the rows have some that the model lacks."""
    new: tuple[FrameKind, ...] = (
        *(("base",) if _unknown(rows.frame, model.bases) else ()),
        *(("tool",) if _unknown(rows.target, model.tools) else ()),
    )
    return tuple(dict.fromkeys((*fitted_kinds, *new)))


def _unknown(names: tuple[str, ...], known: Collection[str]) -> bool:
    """Return whether a frame or target is unknown to a model; see `pisigma.model.calibrated_model.known_names`."""
    if not set(known) - {""}:
        return len(set(names)) > 1
    return not set(names) <= set(known) and not (len(known) == 1 and not any(names))


def _position_noise(noise: CalibrationNoise) -> float:
    """Return the noise of a coordinate [m]; 0 if the calibration had no positions, NaN if it is unknown."""
    return noise.standard_deviation("position") if "position" in noise.value else 0.0
