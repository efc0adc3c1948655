"""Training pairs of inverse calibration: a measured pose, and the joint difference that explains it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.joint_limits import wrapped_difference
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.singularity import singularity_measure
from pisigma.robot.kinematics.status import Status


@dataclass(frozen=True, eq=False)
class TrainingPairs:
    """Poses with the corrections that a network shall learn.

    Attributes:
        T: measured poses T_base_tool.
        q_nominal: nominal joint values of those poses, on the branch nearest to the commanded ones
            [rad or m].
        target: `Δ = q - q_nominal`, wrapped to (-pi, pi] where a joint turns.
        used: rows that are fit for training.
        singular: rows left out because they are near a singularity.
        unreachable: rows left out because the nominal robot cannot take the measured pose.
        branches: the branches that the used rows lie on, most frequent first; empty without closed-form
            inverse.
    """

    T: Float64[Tensor, "rows 4 4"]
    q_nominal: Float64[Tensor, "rows dof"]
    target: Float64[Tensor, "rows dof"]
    used: Bool[Tensor, " rows"]
    singular: Bool[Tensor, " rows"]
    unreachable: Bool[Tensor, " rows"]
    branches: tuple[str, ...]

    @property
    def left_out(self) -> str:
        """How many rows were left out and why, in words; "" where none was."""
        counts = (
            (self.singular, "near a singularity"),
            (self.unreachable, "not reachable by the nominal robot"),
        )
        return ", ".join(f"{int(mask.sum())} {reason}" for mask, reason in counts if mask.any())


def build_pairs(robot: Robot, measurements: Measurements, singular_below: float | None) -> TrainingPairs:
    """Turn measured poses into pairs: `Δθ = θ_measured - θ_analytic` (Jeong et al. 1998, eq. 5).

    No truth is needed: the commanded joint values q stand for θ_measured, and the nominal inverse
    kinematics of the measured pose gives θ_analytic, on the branch nearest to q.

    Args:
        robot: with the base and tool that the poses are measured by.
        measurements: rows with poses.
        singular_below: rows whose `singularity_measure` is below this are not used; None uses all.

    Raises:
        MeasurementError: no poses were measured.
        IdentificationError: no row is left to train on.
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
            f"{measurements.source}: none of the {len(q)} rows can be used for training; check base, "
            "tool and units, or measure away from singularities."
        )
    branches = () if solver is None else solver.frequent(index[used])
    return TrainingPairs(T, q_nominal, target, used, singular, unreachable, branches)
