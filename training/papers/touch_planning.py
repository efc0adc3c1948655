"""Planning of touches that minimise the predicted position error over the workspace."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import USUAL_ANGLE, USUAL_LENGTH, ParameterSpace, Prior
from pisigma.files.errors import IdentificationError
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.simulation.touch_candidates import TouchCandidates

VAGUE = 300.0
"""Standard deviation of unknowns without prior, in mm and mrad: large enough to have no effect."""
LEAST_GAIN = 1e-4
"""Minimum relative gain of an exchange; the search ends below it."""
DROPPED = 0.02
"""Share of the measurements that is dropped per step as long as there are too many."""
MOST_EXCHANGES = 500
"""Maximum number of exchanges."""


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """Information of measurements about the parameters, and effect of the parameters on the tool over the workspace.

    Parameters are in millimetres and milliradians, so that rows, weight and precision are of similar size.

    Attributes:
        rows: Derivative of every candidate's measured value, divided by its standard deviation.
        weight: Mean over the workspace of J^T J, with J the derivative of the tool's position in the robot's frame
            [mm].
        precision: Prior precision, 1 / variance, of every parameter.
    """

    rows: Float64[Tensor, "candidates parameters"]
    weight: Float64[Tensor, "parameters parameters"]
    precision: Float64[Tensor, " parameters"]

    def covariance(self, chosen: Int64[Tensor, " chosen"]) -> Float64[Tensor, "parameters parameters"]:
        """Return the covariance of the parameters after these measurements: `(P + Σ a aᵀ)⁻¹`."""
        rows = self.rows[chosen]
        return torch.cholesky_inverse(torch.linalg.cholesky(torch.diag(self.precision) + rows.mT @ rows))

    def criterion(self, chosen: Int64[Tensor, " chosen"]) -> float:
        """Return the mean over the workspace of the predicted squared position error, `tr(C W)` [mm²]."""
        return float((self.covariance(chosen) * self.weight).sum())

    def predicted_error(self, chosen: Int64[Tensor, " chosen"]) -> float:
        """Return the predicted RMS position error over the workspace after these measurements [m]."""
        return math.sqrt(self.criterion(chosen)) / 1e3


@dataclass(frozen=True, eq=False)
class MeasurementPlan:
    """The chosen measurements.

    Attributes:
        chosen: Indices of the chosen candidates, ascending.
        predicted_error: Predicted RMS position error over the workspace after the chosen measurements [m].
        path: Predicted RMS position error after dropping, and after every exchange [m].
    """

    chosen: Int64[Tensor, " chosen"]
    predicted_error: float
    path: tuple[float, ...]


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

    The row of a touch is `e_axis · R_jig_base · ∂p/∂x` (Lim et al., eqs 35 to 37), followed by the derivative with
    respect to the base of its placement (eq. 34).

    Args:
        robot: The nominal robot.
        candidates: Candidate touches.
        Ts_jig_base: Assumed placements of the jigs [m], in the order of `candidates.placements`.
        workspace: Joint values [rad or m] where the robot should be accurate.
        free: Names of the arm's parameters that the calibration will estimate, such as "theta_2".
        prior: Standard deviations of their errors; None: no prior.
        sigma: Standard deviation of a touched coordinate [m].

    Raises:
        IdentificationError: A name is not a parameter of the arm, or the workspace is empty.
        PoseError: The joint values of the workspace do not fit the robot.
    """
    if not len(workspace):
        raise IdentificationError(
            expected="joint values over the workspace", value="none", option="workspace"
        )
    space = ParameterSpace(robot)
    arm = [space.index(name) for name in free]
    if wrong := [name for name, index in zip(free, arm, strict=True) if index >= space.arm_parameter_count]:
        raise IdentificationError(
            f"'{wrong[0]}' is not a parameter of the arm; the tool's position and every base are always planned for",
            option="free",
            value=wrong[0],
            remedy="omit it",
        )
    tool = space.arm_parameter_count + 6
    columns = [*arm, tool, tool + 1, tool + 2]
    usual = torch.from_numpy(space.usual_errors)[columns]
    free_of_base = robot.with_geometry(base=np.zeros(6))
    rows = _rows_of_touches(free_of_base, candidates, Ts_jig_base, columns, usual)
    size = rows.shape[1]
    _, J = identification_jacobian(free_of_base, workspace)
    J = J[:, :3, columns] * usual * 1e3
    weight = torch.zeros(size, size, dtype=torch.float64)
    weight[: len(columns), : len(columns)] = torch.einsum("nip,niq->pq", J, J) / len(workspace)
    known = torch.from_numpy(space.precision(prior))[columns] * usual**2
    precision = torch.full((size,), VAGUE**-2, dtype=torch.float64)
    precision[: len(columns)] = torch.where(known > 0, known, VAGUE**-2)
    return PlanningProblem(rows / sigma, weight, precision)


def _rows_of_touches(
    robot: Robot,
    candidates: TouchCandidates,
    Ts_jig_base: Float64[Tensor, "placements 4 4"],
    columns: list[int],
    usual: Float64[Tensor, " columns"],
) -> Float64[Tensor, "candidates parameters"]:
    """Return derivatives of touches by arm and tool, then by the base of each placement, in units of typical errors.

    Args:
        robot: Robot with its base at the origin.
        candidates: Candidate touches.
        Ts_jig_base: Assumed placements of the jigs [m].
        columns: Columns of the identification Jacobian, of arm and tool.
        usual: Typical errors of their parameters [m or rad].
    """
    usual_base = torch.tensor([USUAL_LENGTH] * 3 + [USUAL_ANGLE] * 3, dtype=torch.float64)
    rows = torch.zeros(candidates.count, len(columns) + 6 * len(Ts_jig_base), dtype=torch.float64)
    for number, T_jig_base in enumerate(Ts_jig_base):
        chosen = (candidates.placement == number).nonzero()[:, 0]
        T, J = identification_jacobian(robot, candidates.q[chosen])
        along = T_jig_base[candidates.axis[chosen], :3]
        start = len(columns) + 6 * number
        rows[chosen, : len(columns)] = torch.einsum("ni,nip->np", along, J[:, :3, columns]) * usual
        # Derivatives by a small translation and rotation in the frame of the base: they span the same space as x, y, z,
        # roll, pitch and yaw, so the predicted error is the same.
        base_jacobian = torch.cat([along, torch.linalg.cross(T[:, :3, 3], along)], -1)
        rows[chosen, start : start + 6] = base_jacobian * usual_base
    return rows


def plan_measurements(problem: PlanningProblem, count: int) -> MeasurementPlan:
    """Choose measurements that lower the predicted error over the workspace.

    The criterion is `tr(C W)`, the mean variance of the tool's position over the workspace (V- or
    I-optimality), which predicts the error of the robot; a condition number does not. Starting with all
    candidates, those whose loss is smallest are dropped, and then measurements are exchanged, each time the pair with
    the largest gain. The changes for all candidates and all pairs are computed together by rank-one updates of the
    covariance (Sherman and Morrison 1950). No candidate is chosen twice, and the same problem results in the same plan.

    Source: exchange of Fedorov 1972, "Theory of Optimal Experiments", section 3.3; dropping of
    Mitchell 1974, "An algorithm for the construction of D-optimal experimental designs" (DETMAX). For robots Borm
    and Menq 1991 and Daney, Papegay and Madeline 2005 choose poses, by observability instead.

    Args:
        problem: Planning problem of the candidates.
        count: Number of measurements to choose.

    Raises:
        IdentificationError: There are fewer candidates.
    """
    total = len(problem.rows)
    if not 1 <= count <= total:
        raise IdentificationError(
            expected=f"1 to {total} measurements, the number of candidates",
            value=count,
            option="count",
            remedy="choose fewer or draw more candidates",
        )
    chosen = _thinned(problem, count)
    best = problem.criterion(chosen)
    path = [best]
    for _ in range(MOST_EXCHANGES if count < total else 0):
        gain, out, into = _best_exchange(problem, chosen)
        if gain < LEAST_GAIN * best:
            break
        trial = chosen.clone()
        trial[out] = into
        value = problem.criterion(trial)
        if value >= best:
            break
        chosen, best = trial, value
        path.append(best)
    lengths = tuple(math.sqrt(value) / 1e3 for value in path)
    return MeasurementPlan(chosen.sort().values, lengths[-1], lengths)


def _thinned(problem: PlanningProblem, count: int) -> Int64[Tensor, " chosen"]:
    """Start with all candidates and repeatedly drop some percent of them, those with the smallest loss.

    Starting without measurements would never leave the first frame, as the first measurements in another frame only
    determine its base. Without the row a the covariance becomes `C + C a aᵀ C / (1 - aᵀ C a)`, so the criterion rises
    by `aᵀ C W C a / (1 - aᵀ C a)`.
    """
    chosen = torch.arange(len(problem.rows))
    while (surplus := len(chosen) - count) > 0:
        A, C = problem.rows[chosen], problem.covariance(chosen)
        AC = A @ C
        loss = ((AC @ problem.weight) * AC).sum(-1) / (1 - (AC * A).sum(-1)).clamp(min=1e-12)
        dropped = max(1, min(surplus, round(DROPPED * len(chosen))))
        chosen = chosen[loss.argsort(stable=True)[dropped:].sort().values]
    return chosen


def _best_exchange(problem: PlanningProblem, chosen: Int64[Tensor, " chosen"]) -> tuple[float, int, int]:
    """Return the best exchange: its gain [mm²], the position in `chosen`, and the candidate to put there.

    Adding j and then dropping i are two rank-one updates. With `d_ij = a_iᵀ C a_j` and `e_ij = a_iᵀ C W C
    a_j`, and d', e' those of i after j was added, the criterion falls by
    `e_jj / (1 + d_jj) - e'_ii / (1 - d'_ii)`.
    """
    A, C = problem.rows, problem.covariance(chosen)
    AC = A @ C
    ACW = AC @ problem.weight
    d_j, e_j = (AC * A).sum(-1), (ACW * AC).sum(-1)
    d_i, e_i = d_j[chosen, None], e_j[chosen, None]
    d = AC[chosen] @ A.mT
    e = ACW[chosen] @ AC.mT
    share = d / (1 + d_j)
    after = e_i - 2 * share * e + share * share * e_j
    left = (1 - d_i + share * d).clamp(min=1e-12)
    gain = e_j / (1 + d_j) - after / left
    gain[:, chosen] = -torch.inf
    best = int(gain.argmax())
    out, into = divmod(best, gain.shape[1])
    return float(gain[out, into]), out, into
