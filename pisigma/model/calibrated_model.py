"""Calibrated robots: geometry, learned joint corrections, their domain, and predicted poses."""

import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.files.errors import MeasurementError, choice_remedy
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.conditions import JointState
from pisigma.measurement.copies import RowValues
from pisigma.measurement.dataset import Measurements
from pisigma.model.domain import Domain
from pisigma.model.stored_starts import middle_of_starts
from pisigma.network.correction_network import CorrectionNetwork
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.kinematics.joint_limits import nearest_turn
from pisigma.robot.kinematics.tolerances import FORWARD_ACCEPTED, FORWARD_ITERATIONS, FORWARD_TOLERANCE
from pisigma.robot.se3 import invert, transform_from_xyz_zyx

if TYPE_CHECKING:
    import pytorch_kinematics

Frames = dict[str, Float64[np.ndarray, " 6"]]
"""Bases per frame or tools per target: x, y, z [m], roll, pitch, yaw [rad]."""
CHUNK = 4_096
"""Number of poses whose features are in memory at a time; each has a few hundred feature columns per joint."""
_DIFFERENCE_STEP = 1e-5
"""Step of central differences [rad or m]; for a correction with 100 cycles per turn, the error is 1e-6 of the slope."""


@dataclass(frozen=True)
class Provenance:
    """Record of the recipe, data and software with which a model was made.

    Attributes:
        recipe: name of the recipe.
        recipe_sha256: SHA-256 of the recipe file.
        data_source: measurement file, or "simulation".
        data_sha256: SHA-256 of the training measurements.
        rows: number of training rows used.
        rows_left_out: number of training rows left out by `rule`.
        rule: rule by which rows were left out.
        seed: random seed of the training.
        versions: versions of pisigma, torch and python.
    """

    recipe: str = ""
    recipe_sha256: str = ""
    data_source: str = ""
    data_sha256: str = ""
    rows: int = 0
    rows_left_out: int = 0
    rule: str = ""
    seed: int = 0
    versions: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def installed_versions() -> dict[str, str]:
        """Return the versions of pisigma, torch and python that are running."""
        return {"pisigma": version("pisigma"), "torch": version("torch"), "python": platform.python_version()}


@dataclass(frozen=True, eq=False)
class CalibratedModel:
    """A calibrated robot with everything that corrected inverse kinematics needs.

    Attributes:
        name: name of the model.
        kind: how the model was made, for example "inverse_calibration".
        robot: robot whose kinematics yield the nominal joint values, with the fitted base and tool.
        network: network that corrects nominal joint values, or None.
        domain: region in which the corrections of `network` are valid, or None.
        branches: branches of the closed-form inverse on which the training rows are, most frequent first; empty if the
            robot has no closed-form inverse.
        starts: commanded joint values [rad or m] of training rows. The network is evaluated at joint values wrapped
            near these values; without a closed form they are the initial values of the numeric inverse.
        calibrated: robot with the identified geometry and the base and tool of `robot`; None if the geometry is
            nominal.
        bases: for every frame of the measurements ("" if it has no name) x, y, z [m], roll, pitch, yaw [rad] of the
            base in this frame; the first is the base of `robot`. Empty if the measurements did not distinguish frames.
        tools: x, y, z [m], roll, pitch, yaw [rad] of the tool, for every target.
        hybrid: arm with a joint correction that was fitted through the kinematics; its geometry differs from that of
            `calibrated`. None without such a correction.
        hybrid_bases: bases that belong to the hybrid's geometry, with the names of `bases`.
        hybrid_tools: tools that belong to the hybrid's geometry, with the names of `tools`.
        uncertainty: uncertainty of predicted positions, or None.
        training_values: joint values and readings of the training rows, by which repeated rows are recognised; None if
            they were not stored. See `pisigma.model.training_rows`.
        conditions: payload [kg] and temperature [deg C] at which the model is evaluated, by name; empty for the mean
            conditions of the calibration rows. See `pisigma.model.stated_conditions`.
        measured_conditions: lowest and highest calibrated value of every condition in `conditions` that was stated.
        condition_correction: joint correction as a function of `conditions`, from which that of `hybrid` was made; None
            without conditions.
        provenance: recipe, data and versions with which the model was made.
        metrics: figures that the card reports, by name.
    """

    name: str
    kind: str
    robot: Robot
    network: CorrectionNetwork | None
    domain: Domain | None
    branches: tuple[str, ...]
    starts: Float64[Tensor, "starts dof"]
    calibrated: Robot | None = None
    bases: dict[str, Float64[np.ndarray, " 6"]] = field(default_factory=dict)
    tools: dict[str, Float64[np.ndarray, " 6"]] = field(default_factory=dict)
    hybrid: HybridArm | None = None
    hybrid_bases: dict[str, Float64[np.ndarray, " 6"]] = field(default_factory=dict)
    hybrid_tools: dict[str, Float64[np.ndarray, " 6"]] = field(default_factory=dict)
    uncertainty: PositionUncertainty | None = None
    training_values: RowValues | None = None
    conditions: dict[str, float] = field(default_factory=dict)
    measured_conditions: dict[str, tuple[float, float]] = field(default_factory=dict)
    condition_correction: JointCorrection | None = None
    provenance: Provenance = field(default_factory=Provenance)
    metrics: dict[str, Any] = field(default_factory=dict)

    @property
    def identified(self) -> Robot:
        """Robot with the best known geometry: that of the hybrid, or else of `calibrated`, or else nominal."""
        return self.calibrated or self.robot if self.hybrid is None else self.hybrid.robot

    @property
    def nominal(self) -> Robot | None:
        """Nominal robot with nominal base and tool; None if the model was not made by a hybrid calibration."""
        if self.hybrid is not None:
            return self.hybrid.correction.robot
        return None if self.uncertainty is None else self.uncertainty.space.robot

    def correction(
        self, T: Float64[Tensor, "*batch 4 4"], q_nominal: Float64[Tensor, "*batch dof"]
    ) -> Float64[Tensor, "*batch dof"]:
        """Compute the correction [rad or m] that `network` adds to nominal joint values of poses T; 0 if it is None."""
        if self.network is None:
            return torch.zeros_like(q_nominal)
        with torch.no_grad():
            result: Tensor = self.network(T, q_nominal)
        return result

    def wrapped_near_training(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch dof"]:
        """Wrap joint values [rad or m] near the values of the training rows, for which `network` was trained."""
        if not len(self.starts):
            return q
        return nearest_turn(self.robot, q, middle_of_starts(self.starts), within_limits=False)

    def forward(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch 4 4"]:
        """Predict the pose T_base_tool that the robot takes when commanded to q [rad or m].

        With an identified geometry, this is the forward kinematics, including the joint correction of a hybrid.
        Otherwise it is the pose whose corrected joint values are q, see `nominal_joints`.

        Returns:
            The poses; NaN where a joint value is NaN, and where the fixed-point iteration does not converge because the
            slope of the correction exceeds 1, which can happen far outside the domain.
        """
        if self.hybrid is not None:
            return hybrid_poses(self.hybrid, q)
        if self.calibrated is not None:
            return forward_kinematics(self.calibrated, q)
        q_nominal = self.nominal_joints(q)
        converged = torch.isfinite(q_nominal).all(-1, keepdim=True)
        T = forward_kinematics(self.robot, torch.where(converged, q_nominal, q))
        return torch.where(converged[..., None], T, torch.nan)

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """Return the identified geometry as a chain of pytorch-kinematics in float64.

        The chain does not include the joint correction of a hybrid or of a network on nominal joint values. Without
        an identified geometry, it represents the nominal robot with the fitted base and tool.
        """
        return (self.calibrated or self.robot).to_pytorch_kinematics()

    def jacobian(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch 6 dof"]:
        """Compute the geometric Jacobian of the arm at commanded joint values q [rad or m], see `joint_jacobian`.

        The slope of the joint correction, about 1e-3, and a network on nominal joint values are neglected.
        """
        if self.hybrid is None:
            return joint_jacobian(self.calibrated or self.robot, q)[1]
        J = hybrid_motion(self.hybrid, q.reshape(-1, q.shape[-1]), exact=False)[1]
        return J.reshape(*q.shape[:-1], 6, q.shape[-1])

    def nominal_joints(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch dof"]:
        """Solve `q_nominal = q - Δ(FK(q_nominal), q_nominal)` [rad or m] by fixed-point iteration.

        Returns:
            Joint values that `network` corrects to q: NaN where the iteration does not converge; q if there is no
            network.
        """
        q_nominal, moved = q, torch.zeros_like(q)
        for _ in range(FORWARD_ITERATIONS if self.network is not None else 0):
            following = q - self.correction(forward_kinematics(self.robot, q_nominal), q_nominal)
            moved, q_nominal = (following - q_nominal).abs(), following
            if bool((moved <= FORWARD_TOLERANCE).all()):
                break
        converged = (moved <= FORWARD_ACCEPTED).all(-1, keepdim=True)
        return torch.where(converged, q_nominal, torch.nan)


def poses_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Predict the pose of every row's target in the frame of the row.

    A hybrid that learned the effect of payload or temperature is evaluated at the conditions of the rows, whereas
    `CalibratedModel.forward` uses the mean conditions of the calibration.

    Returns:
        The poses; NaN where the model has no prediction, see `CalibratedModel.forward`.

    Raises:
        MeasurementError: the model was not calibrated for a frame or target of the rows.
        PoseError: the number of joint values differs from the robot's number of joints.
    """
    arm = model.hybrid
    if arm is not None:
        model.robot.check_joint_count(measurements.q.shape[-1])
        T = forward_kinematics(arm.robot, corrected_joints(arm, measurements))
        return _seen(T, arm.robot, model.hybrid_bases, model.hybrid_tools, measurements)
    return _seen(model.forward(measurements.q), model.robot, model.bases, model.tools, measurements)


def nominal_poses_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Predict the poses of the rows without any correction, with the nominal arm and fitted bases and tools.

    It raises the same errors as `poses_of_rows`.
    """
    T = forward_kinematics(model.robot, measurements.q)
    return _seen(T, model.robot, model.bases, model.tools, measurements)


def geometric_poses(
    model: CalibratedModel, q: Float64[Tensor, "*batch rows dof"], measurements: Measurements
) -> Float64[Tensor, "*batch rows 4 4"]:
    """Predict the poses of rows at other joint values q [rad or m] with the identified geometry alone.

    It raises the same errors as `poses_of_rows`.
    """
    T = forward_kinematics(model.calibrated or model.robot, q)
    return _seen(T, model.robot, model.bases, model.tools, measurements)


def bases_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "#rows 4 4"]:
    """Return the pose of the robot's base in the frame of every row; see `poses_of_rows` for the errors raised."""
    bases = _of_rows(model.bases, measurements.frame, "frame", measurements)
    return transform_from_xyz_zyx(torch.from_numpy(model.robot.base[None].copy())) if bases is None else bases


def model_names_of_rows(
    frames_of_model: Frames, names: tuple[str, ...], name_kind: str, measurements: Measurements
) -> tuple[str, ...]:
    """Return the name that the model uses for the frame or target of every row.

    A model that was fitted to rows without names accepts rows with any single name, and a model that was fitted to a
    single name accepts rows without names.

    Args:
        frames_of_model: frames or targets of the model.
        names: names of the rows' frames or targets.
        name_kind: "frame" or "target".
        measurements: the rows, for messages.

    Raises:
        MeasurementError: the model was not calibrated for one of the names.
    """
    if not set(frames_of_model) - {""}:
        if len(set(names)) > 1:
            other = next(row for row, name in enumerate(names) if name != names[0])
            raise MeasurementError(
                f"{name_kind} '{names[other]}' differs from '{names[0]}' ({measurements.place_of(0)}), but the model "
                f"has only one {name_kind}",
                expected=f"{name_kind} '{names[0]}'",
                value=names[other],
                at=measurements.place_of(other, name_kind),
                remedy=f"give a file for each {name_kind}",
            )
        return ("",) * len(names)
    if len(frames_of_model) == 1 and not any(names):
        return tuple(frames_of_model) * len(names)
    for row, name in enumerate(names):
        if name not in frames_of_model:
            crossed = (measurements.target if name_kind == "frame" else measurements.frame)[
                row
            ] in frames_of_model
            hint = f"check --fixed-camera if '{name}' is a camera; " if name and crossed else ""
            raise MeasurementError(
                f"the model was not calibrated for {name_kind} '{name}'",
                value=name,
                at=measurements.place_of(row, name_kind),
                remedy=f"{hint}{choice_remedy(name, frames_of_model)}",
            )
    return names


def _seen(
    T: Float64[Tensor, "*batch rows 4 4"],
    robot: Robot,
    bases: Frames,
    tools: Frames,
    measurements: Measurements,
) -> Float64[Tensor, "*batch rows 4 4"]:
    """Return poses T_base_tool as poses of the rows' targets in the rows' frames."""
    before = _of_rows(bases, measurements.frame, "frame", measurements)
    behind = _of_rows(tools, measurements.target, "target", measurements)
    if before is not None:
        T = before @ invert(transform_from_xyz_zyx(torch.from_numpy(robot.base.copy()))) @ T
    if behind is not None:
        T = T @ invert(transform_from_xyz_zyx(torch.from_numpy(robot.tool.copy()))) @ behind
    return T


def _of_rows(
    known: Frames, names: tuple[str, ...], name_kind: str, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"] | None:
    """Return the base or tool of every row; None if the model has only one, which the robot already contains."""
    names = model_names_of_rows(known, names, name_kind, measurements)
    if len(known) < 2:
        return None
    order = list(known)
    frames = transform_from_xyz_zyx(torch.from_numpy(np.stack([known[name] for name in order])))
    return frames[torch.tensor([order.index(name) for name in names], dtype=torch.int64)]


def hybrid_poses(arm: HybridArm, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch 4 4"]:
    """Compute poses T_base_tool of an arm at commanded joint values [rad or m], in chunks of bounded memory.

    Raises:
        PoseError: the number of columns of q is not the robot's number of joints.
    """
    arm.robot.check_joint_count(q.shape[-1])
    flat = q.reshape(-1, q.shape[-1])
    return torch.cat([arm.forward(part) for part in torch.split(flat, CHUNK)]).reshape(*q.shape[:-1], 4, 4)


def corrected_joints(arm: HybridArm, measurements: Measurements) -> Float64[Tensor, "rows dof"]:
    """Compute the corrected joint values `q + Δ(q)` [rad or m] of measured rows at their measured conditions."""
    chunks = JointState.from_measurements(measurements).split_rows(CHUNK)
    with torch.no_grad():
        return torch.cat([state.q + arm.correction(state) for state in chunks])


def hybrid_motion(
    arm: HybridArm, q: Float[Tensor, "poses dof"], exact: bool = True
) -> tuple[Float[Tensor, "poses 4 4"], Float[Tensor, "poses 6 dof"]]:
    """Compute poses and joint Jacobian `J(q + Δ) (1 + dΔ/dq)` of a hybrid arm.

    Args:
        arm: arm with its joint correction.
        q: commanded joint values [rad or m].
        exact: whether to include dΔ/dq, which costs several evaluations of Δ. Without it, every Newton step multiplies
            the error by |dΔ/dq|, of the order of 1e-2.
    """
    chunk = CHUNK // (2 * q.shape[1]) if exact else CHUNK
    with torch.no_grad():
        parts = [_motion(arm, part, exact) for part in torch.split(q, chunk)]
    T, J = zip(*parts, strict=True)
    return torch.cat(T), torch.cat(J)


def _motion(arm: HybridArm, q: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
    T, J = joint_jacobian(arm.robot, q + arm.joint_correction(q))
    if exact:
        J = J + J @ _slope(arm, q)
    return T, J


def _slope(arm: HybridArm, q: Float[Tensor, "poses dof"]) -> Float[Tensor, "poses dof dof"]:
    """Compute the derivatives of corrections with respect to joint values, by central differences."""
    step = _DIFFERENCE_STEP * torch.eye(q.shape[1], dtype=q.dtype, device=q.device)
    above, below = torch.chunk(arm.joint_correction(q[:, None] + torch.cat([step, -step])), 2, 1)
    slope: Tensor = (above - below).mT / (2 * _DIFFERENCE_STEP)
    return slope
