"""Training pairs of an inverse calibration: measured poses, and the joint corrections that explain them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.jacobian import singularity_measure
from pisigma.robot.kinematics.joint_limits import wrapped_difference
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status


@dataclass(frozen=True, eq=False)
class TrainingPairs:
    """Poses with the joint corrections that a network must learn.

    Attributes:
        T: measured poses T_base_tool.
        q_nominal: nominal joint values of these poses on the branch nearest to the commanded values [rad or m].
        target: `Δ = q - q_nominal`, wrapped to (-pi, pi] for revolute joints.
        used_rows: mask of the rows that are used for training.
        singular: mask of the rows that are left out because they are near a singularity.
        unreachable: mask of the rows that are left out because the nominal robot cannot reach the measured pose.
        branches: names of the branches of the used rows, most frequent first; empty without a closed-form inverse.
    """

    T: Float64[Tensor, "rows 4 4"]
    q_nominal: Float64[Tensor, "rows dof"]
    target: Float64[Tensor, "rows dof"]
    used_rows: Bool[Tensor, " rows"]
    singular: Bool[Tensor, " rows"]
    unreachable: Bool[Tensor, " rows"]
    branches: tuple[str, ...]

    @property
    def left_out(self) -> str:
        """Text with the numbers of rows that were left out, and the reasons; "" if no row was left out."""
        counts = (
            (self.singular, "near a singularity"),
            (self.unreachable, "not reachable by the nominal robot"),
        )
        return ", ".join(f"{int(mask.sum())} {reason}" for mask, reason in counts if mask.any())


def build_pairs(robot: Robot, measurements: Measurements, singular_below: float | None) -> TrainingPairs:
    """Convert measured poses to training pairs: `Δθ = θ_measured - θ_analytic` (Jeong et al. 1998, eq. 5).

    The true joint values are not needed: θ_measured are the commanded joint values q, and θ_analytic is the nominal
    inverse kinematics of the measured pose on the branch nearest to q.

    Args:
        robot: robot with the base and tool of the measured poses.
        measurements: rows with poses.
        singular_below: `singularity_measure` below which a row is not used; None to use all rows.

    Raises:
        MeasurementError: no poses were measured.
        IdentificationError: no row can be used for training.
    """
    T, q = measurements.T, measurements.q
    solver = closed_form_solver(robot)
    if solver is None:
        solution = solve_numeric(robot, T, q)
        q_nominal, index = solution.q, torch.zeros(len(q), dtype=torch.int64)
        unreachable = solution.status == Status.NOT_CONVERGED
    else:
        q_nominal, index = solver.nearest(T, q)
        unreachable = ~torch.isfinite(q_nominal).all(-1)
    target = wrapped_difference(robot, q, q_nominal)
    target = torch.where(unreachable[:, None], 0.0, target)
    q_nominal = torch.where(unreachable[:, None], q, q - target)
    singular = torch.zeros_like(unreachable)
    if singular_below is not None:
        singular = (singularity_measure(robot, q_nominal) < singular_below) & ~unreachable
    used = ~singular & ~unreachable
    if not used.any():
        raise IdentificationError(
            f"none of the {len(q)} rows can be used for training",
            value=len(q),
            at=Place(measurements.source),
            remedy="check base, tool and units, or measure away from singularities",
        )
    branches = () if solver is None else solver.most_frequent_branches(index[used])
    return TrainingPairs(T, q_nominal, target, used, singular, unreachable, branches)
