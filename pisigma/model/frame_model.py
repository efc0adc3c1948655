"""Model of a robot or model whose base, tool or both were calibrated with its arm as given."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.frame_fit import FrameChoice, FrameFit, fit_frames
from pisigma.calibration.frames.misfit_causes import misfit_causes
from pisigma.calibration.frames.whitened_values import WhitenedValues
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.alternatives import Cause
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import IdentificationError, ModelError
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Frames, Provenance, corrected_joints, known_names
from pisigma.model.geometric_model import branches_of, model_of_calibration
from pisigma.model.training_rows import stored_training_rows
from pisigma.robot.description import Robot
from pisigma.robot.se3 import invert, transform_from_xyzrpy, xyzrpy_from_transform

KIND = "frame_calibration"


@dataclass(frozen=True, eq=False)
class FittedFrames:
    """Frames that were fitted with the arm of a robot or model.

    Attributes:
        fit: the fit.
        rows: the rows with the names of the model, as commanded.
        model: model with the fitted frames.
        arm_root: root of the covariance of the fitted coordinates by the uncertainty of the arm [m and rad].
        causes: possible causes of the residuals of a hand-eye calibration; see `misfit_causes`.
    """

    fit: FrameFit
    rows: Measurements
    model: CalibratedModel
    arm_root: Float64[Tensor, "frames directions"]
    causes: tuple[Cause, ...]

    @property
    def arm_variance(self) -> tuple[float, ...]:
        """Variance of every fitted coordinate by the uncertainty of the arm [m² or rad²]."""
        return tuple(self.arm_root.square().sum(1).tolist())


def frames_of_robot(robot: Robot, rows: Measurements, only: FrameChoice) -> FittedFrames:
    """Fit frames with the arm of a robot as drawn; for the errors see `fit_frames`."""
    fit = fit_frames(robot, rows, only, {})
    model = model_of_calibration(robot.name, robot, fit.solved.result(), rows)
    return FittedFrames(
        fit, rows, replace(model, kind=KIND), torch.zeros(len(fit.frames), 0), misfit_causes(fit)
    )


def frames_of_model(model: CalibratedModel, rows: Measurements, only: FrameChoice) -> FittedFrames:
    """Fit frames with the arm of a model, including its joint correction.

    The model gets the fitted bases of the frames of the rows, or the fitted tools of their targets, instead of its own;
    everything else is kept. Its uncertainty includes that of the fitted frames, which depend on the arm's errors.

    Args:
        model: model with an identified or the nominal geometry.
        rows: rows; the names of frames or targets that are not fitted are those of the model.
        only: what to fit.

    Raises:
        ModelError: a network corrects the nominal joint values of the model's poses, which depend on base and tool.
        MeasurementError: the model does not have a frame or target of the rows that is not fitted.
        IdentificationError: there are too few rows, or several targets whose tools are not fitted.
        PoseError: the joint values do not fit the robot.
    """
    if model.network is not None:
        raise ModelError(
            f"the network of model '{model.name}' was trained for its base and tool",
            value=model.kind,
            remedy="use a geometric or hybrid calibration",
        )
    arm = model.hybrid
    bases, tools = (model.bases, model.tools) if arm is None else (model.hybrid_bases, model.hybrid_tools)
    if only == "tool":
        rows = replace(rows, frame=known_names(bases, rows.frame, "frame", rows))
    if only == "base":
        rows = replace(rows, target=known_names(tools, rows.target, "target", rows))
        if len(set(rows.target)) > 1:
            raise IdentificationError(
                expected="rows of one target",
                value=sorted(set(rows.target)),
                option="only",
                remedy="give a file for each target",
            )
    robot = model.identified if only != "base" else _with_tool(model.identified, tools, rows.target[0])
    moved = rows if arm is None else replace(rows, q=corrected_joints(arm, rows))
    fit = fit_frames(robot, moved, only, {name: bases[name] for name in set(rows.frame) & set(bases)})
    arm_root = _arm_root(model, fit, rows)
    known = model.uncertainty
    causes = misfit_causes(fit, None if known is None else known.root[: known.space.arm_size])
    return FittedFrames(fit, rows, _with_frames(model, fit, rows, arm_root), arm_root, causes)


def _with_tool(robot: Robot, tools: Frames, target: str) -> Robot:
    return robot.with_geometry(tool=tools[target]) if target in tools else robot


def _arm_root(
    model: CalibratedModel, fit: FrameFit, rows: Measurements
) -> Float64[Tensor, "frames directions"]:
    """Return a root of the covariance of the fitted coordinates by everything that was not fitted.

    An error δ of the arm changes the predicted values by `X_arm δ`, and least squares moves the frames by
    `-(X^T X)^-1 X^T X_arm δ`.
    """
    known = model.uncertainty
    if known is None:
        return torch.zeros(len(fit.frames), 0)
    space = fit.solved.problem.space
    place = {(one.group, one.owner, one.name[-5:]): k for k, one in enumerate(known.space.parameters)}
    pairs = [
        (k, place[key])
        for k, one in enumerate(space.parameters)
        if k not in set(fit.candidates) and (key := (one.group, one.owner, one.name[-5:])) in place
    ]
    X_arm = WhitenedValues.at_solution(fit.solved, [k for k, _ in pairs])
    used = rows.select(torch.tensor(fit.used)).select(fit.solved.setup.rows)
    columns = torch.cat(
        [X_arm.X, X_arm.weight_columns(known.features, JointState.from_measurements(used))], 1
    )
    weights = range(len(known.space.parameters), len(known.root))
    spread = columns @ known.root[[*(k for _, k in pairs), *weights]]
    root: Tensor = -torch.linalg.pinv(fit.values.X)[: len(fit.frames)] @ spread
    return root


def _with_frames(
    model: CalibratedModel, fit: FrameFit, rows: Measurements, arm_root: Float64[Tensor, "frames directions"]
) -> CalibratedModel:
    """Replace the frames of a model."""
    solved, arm = fit.solved.geometry, model.hybrid
    replaced = {
        "bases": solved.bases if fit.only != "tool" else None,
        "tools": solved.tools if fit.only != "base" else None,
    }
    own = {"bases": dict(model.bases), "tools": dict(model.tools)}
    of_hybrid = {"bases": dict(model.hybrid_bases), "tools": dict(model.hybrid_tools)}
    for kind, frames in replaced.items():
        if frames is None:
            continue
        if arm is None:
            own[kind] = dict(frames)
            continue
        assert model.calibrated is not None
        before = arm.robot.base if kind == "bases" else arm.robot.tool
        beside = model.calibrated.base if kind == "bases" else model.calibrated.tool
        own[kind] = {name: _moved_along(kind, beside, before, frame) for name, frame in frames.items()}
        of_hybrid[kind] = dict(frames)
    base, tool = (next(iter(own[kind].values()), None) for kind in ("bases", "tools"))
    robot = model.robot.with_geometry(base=base, tool=tool)
    made = replace(
        model,
        kind=KIND,
        robot=robot,
        branches=branches_of(robot, model.starts),
        calibrated=model.calibrated and model.calibrated.with_geometry(base=base, tool=tool),
        bases=own["bases"],
        tools=own["tools"],
        made_of=stored_training_rows(model.robot, rows, model.made_of),
        provenance=Provenance(
            data_source=rows.file_names,
            data_sha256=rows.content_hash(),
            rows=len(fit.used),
            rows_left_out=len(fit.wrong) + len(rows.left_out),
            versions=Provenance.installed_versions(),
        ),
        uncertainty=_uncertainty(model, fit, arm_root),
    )
    if arm is None:
        return made
    there = (next(iter(of_hybrid[kind].values()), None) for kind in ("bases", "tools"))
    moved = arm.robot.with_geometry(base=next(there), tool=next(there))
    return replace(
        made,
        hybrid=replace(arm, robot=moved),
        hybrid_bases=of_hybrid["bases"],
        hybrid_tools=of_hybrid["tools"],
    )


def _moved_along(kind: str, frame: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Move the frame of a model's geometric part as the hybrid's frame moved."""
    T, was, now = (transform_from_xyzrpy(torch.from_numpy(np.asarray(one))) for one in (frame, before, after))
    moved: np.ndarray = xyzrpy_from_transform(
        now @ invert(was) @ T if kind == "bases" else T @ invert(was) @ now
    ).numpy()
    return moved


def _uncertainty(
    model: CalibratedModel, fit: FrameFit, arm_root: Float64[Tensor, "frames directions"]
) -> PositionUncertainty | None:
    """Return the uncertainty of a model with fitted frames; points of sensors in a fitted base are dropped."""
    known = model.uncertainty
    if known is None:
        return None
    old, solved = known.space, fit.solved.geometry
    fits_base, fits_tool = fit.only != "tool", fit.only != "base"
    space = ParameterSpace(
        old.robot,
        tuple(solved.bases) if fits_base else old.frames,
        tuple(solved.tools) if fits_tool else old.targets,
        () if fits_base else old.unknowns,
    )
    bases = solved.bases if fits_base else known.geometry.bases
    tools = solved.tools if fits_tool else known.geometry.tools
    arm = known.geometry.robot.with_geometry(base=next(iter(bases.values())), tool=next(iter(tools.values())))
    geometry = IdentifiedGeometry(arm, bases, tools, {} if fits_base else known.geometry.unknowns)
    noise = np.linalg.cholesky(fit.covariance + 1e-30 * np.eye(len(fit.frames)))
    own = torch.cat([arm_root, torch.from_numpy(noise)], 1)
    weights = known.root[len(old.parameters) :]
    blocks = {"base": old.indices_of("base"), "tool": old.indices_of("tool")}
    kept = {name: known.root[list(index)] for name, index in blocks.items()}
    later = known.root[blocks["tool"].stop : len(old.parameters)] if not fits_base else known.root[:0]
    root = torch.zeros(len(space.parameters) + len(weights), known.root.shape[1] + len(fit.frames)).double()
    directions = known.root.shape[1]
    root[: space.arm_size, :directions] = known.root[: space.arm_size]
    for name, fitted in (("base", fits_base), ("tool", fits_tool)):
        index = space.indices_of(name)
        if not fitted:
            root[index.start : index.stop, :directions] = kept[name]
    of_fit = fit.solved.problem.space
    for number, fitted_parameter in enumerate(fit.frames):
        root[space.index(of_fit.names[fitted_parameter])] = own[number]
    first = space.indices_of("tool").stop
    root[first : first + len(later), :directions] = later
    root[len(space.parameters) :, :directions] = weights
    return replace(known, space=space, geometry=geometry, covariance_root=CovarianceRoot(root))
