"""Model of a robot or model whose base, tool or both were calibrated with the arm held fixed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.arm_uncertainty import ArmUncertainty, indices_by_key
from pisigma.calibration.frames.frame_fit import FrameChoice, FrameFit, fit_frames
from pisigma.calibration.frames.misfit_causes import misfit_causes
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.alternatives import Cause
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import (
    CalibratedModel,
    Frames,
    Provenance,
    corrected_joints,
    model_names_of_rows,
)
from pisigma.model.frame_choice import check_frames_can_change
from pisigma.model.geometric_model import branches_of, model_of_calibration
from pisigma.model.training_rows import stored_training_rows
from pisigma.robot.description import Robot
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform

_KIND = "frame_calibration"


@dataclass(frozen=True, eq=False)
class FittedFrames:
    """Frames that were fitted with the arm of a robot or model held fixed.

    Attributes:
        fit: the fit.
        model: model with the fitted frames.
        arm_covariance_root: root of the covariance of the fitted coordinates due to the uncertainty of the arm [m
            and rad], in the directions of the root of the model whose arm was used.
        causes: possible causes of the residuals of a hand-eye calibration; see `misfit_causes`.
    """

    fit: FrameFit
    model: CalibratedModel
    arm_covariance_root: Float64[Tensor, "frames directions"]
    causes: tuple[Cause, ...]

    @property
    def variance_due_to_arm(self) -> tuple[float, ...]:
        """Variance of every fitted coordinate due to the uncertainty of the arm [m² or rad²]."""
        return tuple(self.arm_covariance_root.square().sum(1).tolist())


def frames_of_robot(robot: Robot, rows: Measurements, frame_choice: FrameChoice) -> FittedFrames:
    """Fit frames with the arm of a nominal robot; for the errors see `fit_frames`."""
    fit = fit_frames(robot, rows, frame_choice)
    model = model_of_calibration(robot.name, robot, fit.solved.result(), rows)
    return FittedFrames(fit, replace(model, kind=_KIND), _exact_arm(fit), misfit_causes(fit))


def frames_of_model(model: CalibratedModel, rows: Measurements, frame_choice: FrameChoice) -> FittedFrames:
    """Fit frames with the arm of a model, including its joint correction.

    The model gets the fitted bases of the frames of the rows, or the fitted tools of their targets, instead of its own;
    everything else is kept. Its uncertainty includes that of the fitted frames, which depend on the arm's errors.

    Args:
        model: model with identified or nominal geometry.
        rows: rows; the names of frames or targets that are not fitted are those of the model.
        frame_choice: what to fit.

    Raises:
        ModelError: a network corrects the nominal joint values of the model's poses, which depend on base and tool.
        MeasurementError: the model lacks a frame or target of the rows that is not fitted.
        IdentificationError: see `fit_frames`.
        PoseError: the joint values do not fit the robot.
    """
    check_frames_can_change(model)
    arm = model.hybrid
    bases, tools = (model.bases, model.tools) if arm is None else (model.hybrid_bases, model.hybrid_tools)
    if frame_choice == "tool":
        rows = replace(rows, frame=model_names_of_rows(bases, rows.frame, "frame", rows))
    if frame_choice == "base":
        rows = replace(rows, target=model_names_of_rows(tools, rows.target, "target", rows))
    moved = rows if arm is None else replace(rows, q=corrected_joints(arm, rows))
    fit = fit_frames(model.identified, moved, frame_choice, bases, tools)
    known = None if model.uncertainty is None else ArmUncertainty(model.uncertainty, rows)
    arm_root = _exact_arm(fit) if known is None else _arm_root(known, fit)
    uncertainty = None if known is None else _uncertainty(known, fit, arm_root)
    return FittedFrames(
        fit,
        replace(_with_frames(model, fit, rows), uncertainty=uncertainty),
        arm_root,
        misfit_causes(fit, known),
    )


def _exact_arm(fit: FrameFit) -> Float64[Tensor, "frames directions"]:
    """Return the root of `_arm_root` for an arm without a stated uncertainty."""
    return torch.zeros(len(fit.frame_indices), 0, dtype=torch.float64)


def _arm_root(known: ArmUncertainty, fit: FrameFit) -> Float64[Tensor, "frames directions"]:
    """Return a root of the covariance of the fitted coordinates due to everything that was not fitted.

    An error δ of the arm changes the predicted values by `X_arm δ`, and least squares moves the fitted directions by
    `-(X^T X)^-1 X^T X_arm δ`.
    """
    problem = fit.solved.problem
    spread = known.value_covariance_root(fit.solved, fit.used_rows, problem.active.tolist())
    change = fit.solved.geometry.coordinate_jacobian[fit.frame_indices][:, problem.active]
    root: Tensor = -change @ fit.fitted_directions @ torch.linalg.pinv(fit.values.X) @ spread
    return root


def _with_frames(model: CalibratedModel, fit: FrameFit, rows: Measurements) -> CalibratedModel:
    """Replace the frames of a model."""
    solved, arm = fit.solved.geometry, model.hybrid
    fitted: dict[str, dict[str, np.ndarray]] = {}
    if fit.frame_choice != "tool":
        fitted["bases"] = dict(solved.bases)
    if fit.frame_choice != "base":
        fitted["tools"] = dict(solved.tools)
    own, of_hybrid = fitted, dict[str, Any]()
    if arm is not None:
        assert model.calibrated is not None
        own = {
            kind: _moved_along(kind, model.calibrated, arm.robot, frames) for kind, frames in fitted.items()
        }
        of_hybrid = {f"hybrid_{kind}": frames for kind, frames in fitted.items()}
        of_hybrid["hybrid"] = replace(arm, robot=_with_first(arm.robot, fitted))
    robot = _with_first(model.robot, own)
    frames: dict[str, Any] = {**own, **of_hybrid}
    return replace(
        model,
        kind=_KIND,
        robot=robot,
        branches=branches_of(robot, model.starts),
        calibrated=model.calibrated and _with_first(model.calibrated, own),
        training_values=stored_training_rows(model.robot, rows, model.training_values),
        provenance=Provenance(
            data_source=rows.file_names,
            data_sha256=rows.content_hash(),
            rows=len(fit.used_rows),
            rows_left_out=len(fit.wrong_rows) + len(rows.left_out),
            versions=Provenance.installed_versions(),
        ),
        **frames,
    )


def _with_first(robot: Robot, frames: Mapping[str, Frames]) -> Robot:
    """Return a robot with the first base and tool."""
    base, tool = (
        next(iter(frames[kind].values()), None) if kind in frames else None for kind in ("bases", "tools")
    )
    return robot.with_geometry(base=base, tool=tool)


def _moved_along(kind: str, geometric: Robot, before: Robot, after: Frames) -> dict[str, np.ndarray]:
    """Move the frames of a model's geometric part in the same way as the hybrid's frames."""
    T, was = (
        transform_from_xyz_zyx(torch.tensor(one.base if kind == "bases" else one.tool))
        for one in (geometric, before)
    )
    now = {name: transform_from_xyz_zyx(torch.tensor(frame)) for name, frame in after.items()}
    moved = {
        name: one @ invert(was) @ T if kind == "bases" else T @ invert(was) @ one for name, one in now.items()
    }
    return {name: xyz_zyx_from_transform(one).numpy() for name, one in moved.items()}


def _uncertainty(
    model: ArmUncertainty, fit: FrameFit, arm_root: Float64[Tensor, "frames directions"]
) -> PositionUncertainty:
    """Return the uncertainty of a model with fitted frames; points of sensors in a fitted base are dropped."""
    known, solved = model.uncertainty, fit.solved.geometry
    old, fits_base, fits_tool = known.space, fit.frame_choice != "tool", fit.frame_choice != "base"
    bases = solved.bases if fits_base else known.geometry.bases
    tools = solved.tools if fits_tool else known.geometry.tools
    unknowns = {} if fits_base else known.geometry.unknowns
    space = ParameterSpace(old.robot, tuple(bases), tuple(tools), () if fits_base else old.unknowns)
    arm = _with_first(known.geometry.robot, {"bases": bases, "tools": tools})
    own = torch.cat([arm_root, fit.solved.covariance_root[fit.frame_indices]], 1)
    weights, directions = known.dense_root[len(old.parameters) :], known.dense_root.shape[1]
    root = torch.zeros(len(space.parameters) + len(weights), own.shape[1], dtype=torch.float64)
    positions = indices_by_key(space.parameters)
    for key, number in indices_by_key(old.parameters).items():
        if key in positions:
            root[positions[key], :directions] = known.dense_root[number]
    fitted = indices_by_key(fit.parameters)
    for key, number in fitted.items():
        root[positions[key]] = own[number]
    root[len(space.parameters) :, :directions] = weights
    geometry = IdentifiedGeometry(arm, bases, tools, unknowns)
    uncertainty = replace(known, space=space, geometry=geometry, covariance_root=CovarianceRoot(root))
    return uncertainty.with_rounded_root(model.rows)
