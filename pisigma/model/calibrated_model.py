"""A calibrated robot: geometry, learned joint corrections and where both hold, and the poses that it predicts."""

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
from pisigma.files.errors import MeasurementError, nearest_choice
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
from pisigma.robot.se3 import invert, transform_from_xyzrpy

if TYPE_CHECKING:
    import pytorch_kinematics

Frames = dict[str, Float64[np.ndarray, " 6"]]
"""Bases per frame or tools per target: x, y, z [m], roll, pitch, yaw [rad]."""
CHUNK = 4_096
"""Poses whose features are in memory at a time: a few hundred columns a joint."""
STEP = 1e-5
"""[rad or m] Of differences: with 100 cycles a turn their error is a millionth of a slope."""


@dataclass(frozen=True)
class Provenance:
    """Where a model comes from.

    Attributes:
        recipe: the recipe's name.
        recipe_sha256: hash of the recipe file.
        data_source: the measured file, or "simulation".
        data_sha256: hash of the training measurements.
        rows: training rows used.
        rows_left_out: training rows left out, with the rule in `rule`.
        rule: why rows were left out.
        seed: of the training.
        versions: of pisigma, torch and python.
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
    def present_versions() -> dict[str, str]:
        """Give the versions of pisigma, torch and python that are running."""
        return {"pisigma": version("pisigma"), "torch": version("torch"), "python": platform.python_version()}


@dataclass(frozen=True, eq=False)
class CalibratedModel:
    """Everything that `pisigma.load` needs.

    Attributes:
        name: of the model.
        kind: how it was made, such as "inverse_calibration".
        robot: its kinematics give the nominal joint values; base and tool as fitted.
        network: joint corrections, or None.
        domain: where the corrections hold, or None.
        branches: branches of the closed-form inverse that the training rows lie on, most frequent first;
            empty where there is no closed form.
        starts: commanded joint values [rad or m] of training rows: on the turns that the network knows, and
            where there is no closed form the starts of the numeric inverse.
        calibrated: the robot with its geometry as identified, base and tool those of `robot`; None where the
            geometry is the nominal one.
        bases: per frame of the measurements ("" where it had no name) x, y, z [m], roll, pitch, yaw [rad] of
            the base in it; the first is that of `robot`. Empty where frames were not told apart.
        tools: the same per target for the tool.
        hybrid: the arm with a joint correction that was fitted through the kinematics, with a geometry of its own
            beside the one of `calibrated`; None where there is none.
        hybrid_bases: the bases that go with the hybrid's geometry, by the names of `bases`.
        hybrid_tools: the same for the tools.
        uncertainty: of predicted positions, or None.
        made_of: joint values and readings of rows that it was made of, by which they are recognised when they come
            again; None where these were not kept. See `pisigma.model.training_rows`.
        conditions: payload [kg] and temperature [deg C] that it was put under, by name; empty for the usual ones of
            the rows. See `pisigma.model.stated_conditions`.
        measured_conditions: the lowest and the highest value of these that it was calibrated at, of stated ones only.
        provenance: recipe, data, versions.
        metrics: figures for the card, by name.
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
    made_of: RowValues | None = None
    conditions: dict[str, float] = field(default_factory=dict)
    measured_conditions: dict[str, tuple[float, float]] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)
    metrics: dict[str, Any] = field(default_factory=dict)

    @property
    def identified(self) -> Robot:
        """The geometry that commanded joint values go through: of the hybrid, as identified, or else nominal."""
        return self.calibrated or self.robot if self.hybrid is None else self.hybrid.robot

    @property
    def drawn(self) -> Robot | None:
        """The robot as drawn, with its own base and tool, where a hybrid calibration knows it."""
        if self.hybrid is not None:
            return self.hybrid.correction.robot
        return None if self.uncertainty is None else self.uncertainty.space.robot

    def correction(
        self, T: Float64[Tensor, "*batch 4 4"], q_nominal: Float64[Tensor, "*batch dof"]
    ) -> Float64[Tensor, "*batch dof"]:
        """Correction [rad or m] that `network` adds to the nominal joint values of poses T; 0 without one."""
        if self.network is None:
            return torch.zeros_like(q_nominal)
        with torch.no_grad():
            result: Tensor = self.network(T, q_nominal)
        return result

    def as_trained(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch dof"]:
        """Joint values [rad or m] turned as those of the training rows, which `network` knows."""
        if not len(self.starts):
            return q
        return nearest_turn(self.robot, q, middle_of_starts(self.starts), within_limits=False)

    def forward(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch 4 4"]:
        """Pose T_base_tool that the robot takes when commanded to q [rad or m], as far as the model knows.

        With an identified geometry it is its forward kinematics, with the joint correction of a hybrid. Else
        it is the pose whose corrected joint values are q, see `nominal_joints`.

        Returns:
            The poses; NaN where the iteration does not settle because the correction is steeper than the
            joints, as it may be far outside the domain, and where a joint value is NaN.
        """
        if self.hybrid is not None:
            return hybrid_poses(self.hybrid, q)
        if self.calibrated is not None:
            return forward_kinematics(self.calibrated, q)
        q_nominal = self.nominal_joints(q)
        settled = torch.isfinite(q_nominal).all(-1, keepdim=True)
        T = forward_kinematics(self.robot, torch.where(settled, q_nominal, q))
        return torch.where(settled[..., None], T, torch.nan)

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """Give the identified geometry as a chain of pytorch-kinematics in float64.

        The joint correction is no part of such a chain: with a hybrid, or a network on nominal joint values, the chain
        is where the tool would be at joint values without it. Without an identified geometry it is the nominal robot
        with base and tool as fitted.
        """
        return (self.calibrated or self.robot).to_pytorch_kinematics()

    def jacobian(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch 6 dof"]:
        """Geometric Jacobian of the arm at commanded joint values q [rad or m], see `joint_jacobian`.

        The slope of the correction, some 1e-3, is left out, and so is a network that corrects nominal joint values.
        """
        if self.hybrid is None:
            return joint_jacobian(self.calibrated or self.robot, q)[1]
        J = hybrid_motion(self.hybrid, q.reshape(-1, q.shape[-1]), exact=False)[1]
        return J.reshape(*q.shape[:-1], 6, q.shape[-1])

    def nominal_joints(self, q: Float64[Tensor, "*batch dof"]) -> Float64[Tensor, "*batch dof"]:
        """Joint values `q_nominal = q - Δ(FK(q_nominal), q_nominal)` [rad or m] that `network` corrects to q.

        Returns:
            NaN where the iteration does not settle; q itself without a network.
        """
        q_nominal, moved = q, torch.zeros_like(q)
        for _ in range(FORWARD_ITERATIONS if self.network is not None else 0):
            following = q - self.correction(forward_kinematics(self.robot, q_nominal), q_nominal)
            moved, q_nominal = (following - q_nominal).abs(), following
            if bool((moved <= FORWARD_TOLERANCE).all()):
                break
        settled = (moved <= FORWARD_ACCEPTED).all(-1, keepdim=True)
        return torch.where(settled, q_nominal, torch.nan)


def poses_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Where a model of any kind says that the targets were, each in the frame of its row.

    NaN where the model predicts nothing; see `CalibratedModel.forward`. Under the conditions (payload, temperature)
    of the rows, where a hybrid knows of them; `CalibratedModel.forward` is under the usual ones.

    Raises:
        MeasurementError: the model does not know a frame or target of the rows.
        PoseError: the joint values do not fit the robot.
    """
    arm = model.hybrid
    if arm is not None:
        model.robot.check_joint_count(measurements.q.shape[-1])
        T = forward_kinematics(arm.robot, corrected_joints(arm, measurements))
        return _seen(T, arm.robot, model.hybrid_bases, model.hybrid_tools, measurements)
    return _seen(model.forward(measurements.q), model.robot, model.bases, model.tools, measurements)


def nominal_poses_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """The same for the model's robot without any correction, its bases and tools as fitted.

    For errors see `poses_of_rows`.
    """
    T = forward_kinematics(model.robot, measurements.q)
    return _seen(T, model.robot, model.bases, model.tools, measurements)


def bases_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "#rows 4 4"]:
    """Where the robot's base stands in the frame of every row; for errors see `poses_of_rows`."""
    bases = _of_rows(model.bases, measurements.frame, "frame", measurements)
    return transform_from_xyzrpy(torch.from_numpy(model.robot.base[None].copy())) if bases is None else bases


def known_names(
    known: Frames, names: tuple[str, ...], what: str, measurements: Measurements
) -> tuple[str, ...]:
    """The frame or target of every row as the model calls it.

    A model that was fitted to rows without names takes rows of any one name, and one that was fitted to a
    single name takes rows without.

    Args:
        known: what the model knows.
        names: of the rows.
        what: "frame" or "target".
        measurements: the rows, for messages.

    Raises:
        MeasurementError: the model does not know a name.
    """
    if not set(known) - {""}:
        if len(set(names)) > 1:
            other = next(row for row, name in enumerate(names) if name != names[0])
            raise MeasurementError(
                f"{measurements.place(other)}: {what} '{names[other]}' stands there, but "
                f"{measurements.place(0)} has '{names[0]}', and the model knows one {what} only; give a file for each."
            )
        return ("",) * len(names)
    if len(known) == 1 and not any(names):
        return tuple(known) * len(names)
    for row, name in enumerate(names):
        if name not in known:
            crossed = (measurements.target if what == "frame" else measurements.frame)[row] in known
            hint = " (of a camera, check --fixed-camera)" if name and crossed else ""
            raise MeasurementError(
                f"{measurements.place(row)}: the model was not fitted to {what} '{name}'{hint}; "
                f"{nearest_choice(name, known)}"
            )
    return names


def _seen(
    T: Float64[Tensor, "rows 4 4"], robot: Robot, bases: Frames, tools: Frames, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"]:
    """Poses T_base_tool as poses of the rows' targets in the rows' frames."""
    before = _of_rows(bases, measurements.frame, "frame", measurements)
    behind = _of_rows(tools, measurements.target, "target", measurements)
    if before is not None:
        T = before @ invert(transform_from_xyzrpy(torch.from_numpy(robot.base.copy()))) @ T
    if behind is not None:
        T = T @ invert(transform_from_xyzrpy(torch.from_numpy(robot.tool.copy()))) @ behind
    return T


def _of_rows(
    known: Frames, names: tuple[str, ...], what: str, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"] | None:
    """The base or tool of every row; None where there is one only, which the robot has already."""
    names = known_names(known, names, what, measurements)
    if len(known) < 2:
        return None
    order = list(known)
    frames = transform_from_xyzrpy(torch.from_numpy(np.stack([known[name] for name in order])))
    return frames[torch.tensor([order.index(name) for name in names], dtype=torch.int64)]


def hybrid_poses(arm: HybridArm, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch 4 4"]:
    """Poses T_base_tool of an arm at commanded joint values [rad or m], of any number of rows.

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    arm.robot.check_joint_count(q.shape[-1])
    flat = q.reshape(-1, q.shape[-1])
    return torch.cat([arm.forward(part) for part in torch.split(flat, CHUNK)]).reshape(*q.shape[:-1], 4, 4)


def corrected_joints(arm: HybridArm, measurements: Measurements) -> Float64[Tensor, "rows dof"]:
    """Joint values of measured rows with the correction of the network in full, `q + Δ(q)` [rad or m]."""
    chunks = JointState.of(measurements).split(CHUNK)
    with torch.no_grad():
        return torch.cat([state.q + arm.correction(state) for state in chunks])


def hybrid_motion(
    arm: HybridArm, q: Float[Tensor, "poses dof"], exact: bool = True
) -> tuple[Float[Tensor, "poses 4 4"], Float[Tensor, "poses 6 dof"]]:
    """Poses and joint Jacobian `J(q + Δ) (1 + dΔ/dq)` of a hybrid arm.

    Args:
        arm: the arm.
        q: commanded joint values [rad or m].
        exact: whether dΔ/dq is computed, which costs some times as much as Δ. Without it Newton steps contract by
            |dΔ/dq|, of the order of 1e-2.
    """
    chunk = CHUNK // (2 * q.shape[1]) if exact else CHUNK
    with torch.no_grad():
        parts = [_motion(arm, part, exact) for part in torch.split(q, chunk)]
    T, J = zip(*parts, strict=True)
    return torch.cat(T), torch.cat(J)


def _motion(arm: HybridArm, q: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
    T, J = joint_jacobian(arm.robot, q + arm.delta(q))
    if exact:
        J = J + J @ _slope(arm, q)
    return T, J


def _slope(arm: HybridArm, q: Float[Tensor, "poses dof"]) -> Float[Tensor, "poses dof dof"]:
    """Derivatives of the corrections by the joint values, by central differences in one call."""
    step = STEP * torch.eye(q.shape[1], dtype=q.dtype, device=q.device)
    above, below = torch.chunk(arm.delta(q[:, None] + torch.cat([step, -step])), 2, 1)
    slope: Tensor = (above - below).mT / (2 * STEP)
    return slope
