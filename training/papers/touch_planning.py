"""Which touches to make: the planning problem of touches on jigs, linearised at the nominal robot."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.identification.problem.parameters import USUAL_ANGLE, USUAL_LENGTH, ParameterSpace, Prior
from pisigma.kinematics.parameter_jacobian import identification_jacobian
from pisigma.planning.exchange import PlanningProblem
from pisigma.robot.description import Robot
from touch_candidates import TouchCandidates

VAGUE = 300.0
"""Standard deviation of what nothing is known about, in mm and mrad: so wide that it does not matter."""


def build_planning_problem(
    robot: Robot,
    candidates: TouchCandidates,
    Ts_jig_base: Float64[Tensor, "placements 4 4"],
    workspace: Float64[Tensor, "poses dof"],
    free: Sequence[str],
    prior: Prior | None = None,
    sigma: float = 2e-4,
) -> PlanningProblem:
    """Linearise touches and workspace at the nominal robot.

    The row of a touch is `e_axis · R_jig_base · ∂p/∂x` (Lim et al., eqs 35 to 37), next to the derivative by
    the base of its own placement (eq. 34).

    Args:
        robot: the nominal robot.
        candidates: what could be touched.
        Ts_jig_base: where the jigs are believed to stand [m], in the order of `candidates.placements`.
        workspace: joint values [rad or m] where the robot shall be accurate.
        free: names of the arm's parameters that the calibration will estimate, such as "theta_2".
        prior: standard deviations of their errors; None for none.
        sigma: standard deviation of a touch [m].

    Raises:
        IdentificationError: a name is no parameter of the arm, or there is no workspace.
        PoseError: the workspace's joint values do not fit the robot.
    """
    if not len(workspace):
        raise IdentificationError("joint values over the workspace were wanted, got none; state some poses.")
    space = ParameterSpace(robot)
    arm = [space.index(name) for name in free]
    if wrong := [name for name, index in zip(free, arm, strict=True) if index >= space.arm_size]:
        raise IdentificationError(
            f"'{wrong[0]}' is no parameter of the arm; the tool's position and every base are planned for anyway, "
            "so leave it out."
        )
    tool = space.arm_size + 6
    columns = [*arm, tool, tool + 1, tool + 2]
    usual = torch.from_numpy(space.usual_errors)[columns]
    own = torch.tensor([USUAL_LENGTH] * 3 + [USUAL_ANGLE] * 3, dtype=torch.float64)
    size = len(columns) + 6 * len(Ts_jig_base)
    rows = torch.zeros(candidates.count, size, dtype=torch.float64)
    free_of_base = robot.with_geometry(base=np.zeros(6))
    for number, T_jig_base in enumerate(Ts_jig_base):
        chosen = (candidates.placement == number).nonzero()[:, 0]
        T, J = identification_jacobian(free_of_base, candidates.q[chosen])
        along = T_jig_base[candidates.axis[chosen], :3]
        start = len(columns) + 6 * number
        rows[chosen, : len(columns)] = torch.einsum("ni,nip->np", along, J[:, :3, columns]) * usual
        rows[chosen, start : start + 6] = _base_rows(along, T[:, :3, 3]) * own
    _, J = identification_jacobian(free_of_base, workspace)
    J = J[:, :3, columns] * usual * 1e3
    weight = torch.zeros(size, size, dtype=torch.float64)
    weight[: len(columns), : len(columns)] = torch.einsum("nip,niq->pq", J, J) / len(workspace)
    known = torch.from_numpy(space.precision(prior))[columns] * usual**2
    precision = torch.full((size,), VAGUE**-2, dtype=torch.float64)
    precision[: len(columns)] = torch.where(known > 0, known, VAGUE**-2)
    return PlanningProblem(rows / sigma, weight, precision)


def _base_rows(
    along: Float64[Tensor, "touches 3"], position: Float64[Tensor, "touches 3"]
) -> Float64[Tensor, "touches 6"]:
    """Derivative of the coordinates by a small shift and turn of the robot's base, both in the robot's frame.

    They span what x, y, z, roll, pitch and yaw span, so the predicted error is the same.
    """
    return torch.cat([along, torch.linalg.cross(position, along)], -1)
