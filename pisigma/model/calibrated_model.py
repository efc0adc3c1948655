"""A calibrated robot: geometry, learned joint corrections and where both hold."""

import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.measurement.copies import RowValues
from pisigma.model.domain import Domain
from pisigma.model.hybrid_motion import hybrid_motion, hybrid_poses
from pisigma.model.stored_starts import middle_of_starts
from pisigma.network.correction_network import CorrectionNetwork
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.kinematics.joint_limits import nearest_turn
from pisigma.robot.kinematics.tolerances import FORWARD_ACCEPTED, FORWARD_ITERATIONS, FORWARD_TOLERANCE

if TYPE_CHECKING:
    import pytorch_kinematics


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
