"""Closed-form start values for base and tool, which require no guess."""

import itertools
from collections.abc import Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.base_and_tool_problem import BaseToolProblem, BaseToolState
from pisigma.robot.description import Robot
from pisigma.robot.se3 import nearest_rotation, rotation_from_zyx

MAX_ITERATIONS = 60
_LINEAR_ROWS = 13
"""Smallest number of rows that determine base and tool by a linear system."""
_DEPENDENT = 1e-9
"""Ratio of a singular value of the linear system to the largest one below which it is treated as zero."""
_UNDETERMINED = 1e-9
"""Relative weight of the given rotation, which determines what the points leave undetermined."""
_SINGLE = 0.9
"""Ratio of the second to the first singular value above which the rotations may not be unique."""


def base_and_tool_starts(robot: Robot, problem: BaseToolProblem) -> Iterator[BaseToolState]:
    """Yield starts to refine and compare; one is sufficient unless positions were measured in few or special poses.

    Args:
        robot: the robot, whose base and tool are used if they are not free or not determined.
        problem: flange poses and measurements.
    """
    like = problem.position
    R_tool, R_base = (rotation_from_zyx(like.new_tensor(frame[3:])) for frame in (robot.tool, robot.base))
    point, p_base = like.new_tensor(robot.tool[:3]), like.new_tensor(robot.base[:3])
    # Rows with a rotation determine both frames; positions of several targets share only a base, so one target is used.
    rows = problem.has_rotation if problem.has_rotations else problem.target == problem.target.mode().values
    R_flange, p_flange = problem.R_flange[rows], problem.p_flange[rows]
    position, rotation = problem.position[rows], problem.rotation[rows]
    candidates: Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]
    if not problem.free_base and not problem.free_tool:
        candidates = iter([(R_base, p_base, R_tool, point)])
    elif not problem.free_base:
        candidates = iter(
            [
                _tool_start(
                    R_base, p_base, R_flange, p_flange, position, rotation, problem.has_rotations, R_tool
                )
            ]
        )
    elif not problem.free_tool:
        # With a known tool, the base is a rigid transform between two sets of points (Procrustes).
        arm = p_flange + R_flange @ point
        R_fitted = _procrustes(arm, position)
        if problem.has_rotations:
            R_fitted = nearest_rotation((rotation @ R_tool.mT @ R_flange.mT).sum(0))
        candidates = iter([(R_fitted, (position - arm @ R_fitted.mT).mean(0), R_tool, point)])
    else:
        starts = starts_from_positions(R_flange, p_flange, position, point, robot.reach)
        if problem.has_rotations:
            first = start_from_poses(R_flange, p_flange, position, rotation, R_tool, point)
            rest = ((R, p, _mean_turn(R, R_flange, rotation), place) for R, p, place in starts)
            candidates = itertools.chain([first], rest)
        else:
            candidates = ((R, p, R_tool, place) for R, p, place in starts)
    for R_start, p_start, R_tool_start, place in candidates:
        yield BaseToolState(R_start, p_start, R_tool_start, place.expand(len(problem.targets), 3))


def start_from_poses(
    R_flange: Float64[Tensor, "rows 3 3"],
    p_flange: Float64[Tensor, "rows 3"],
    position: Float64[Tensor, "rows 3"],
    rotation: Float64[Tensor, "rows 3 3"],
    R_tool_nominal: Float64[Tensor, "3 3"],
    nominal_point: Float64[Tensor, " 3"],
) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, " 3"], Float64[Tensor, "3 3"], Float64[Tensor, " 3"]]:
    """Solve measured = base · flange · tool for base and tool (robot-world and hand-eye calibration).

    With the inverse Z of the tool's rotation, `R_measured · Z · R_flange^T = R_base`, so
    `K vec(Z) = rows · vec(R_base)` with `K = Σ R_measured ⊗ R_flange` (Shah 2013, J. Mechanisms Robotics 5(3), in
    row-major order). If the leading singular value of K is not single (all axes parallel, as in a SCARA), its vectors
    are not rotations. Therefore the pair that maximises `vec(R_base)^T K vec(Z)` is found by alternating projections
    onto the rotations, starting at the singular vector and, if this is not unique, also at the nominal tool, which
    is preferred among equally good pairs, and the 24 rotations of a cube. The translations are then linear.

    Returns:
        R_base, p_base [m], R_tool, p_tool [m].
    """
    rows = R_flange.shape[0]
    # K maps the flattened inverse rotation of the tool to the flattened rotation of the base.
    K = torch.einsum("nab,ncd->acbd", rotation, R_flange).reshape(9, 9) / rows
    _, singular, Vh = torch.linalg.svd(K)
    leading = Vh[0].reshape(3, 3)
    starts = torch.stack([leading, -leading])
    if float(singular[1]) > _SINGLE * float(singular[0]):
        starts = torch.cat([R_tool_nominal.mT[None], starts, _cube_rotations(K)])
    Z = nearest_rotation(starts)
    agreement = torch.zeros(len(Z)).to(K)
    for _ in range(MAX_ITERATIONS):
        R_base = nearest_rotation((Z.reshape(-1, 9) @ K.mT).reshape(-1, 3, 3))
        Z = nearest_rotation((R_base.reshape(-1, 9) @ K).reshape(-1, 3, 3))
        before = agreement
        agreement = ((R_base.reshape(-1, 9) @ K) * Z.reshape(-1, 9)).sum(-1)
        if (agreement - before).abs().max() < 1e-12:
            break
    # Take the first of equally good pairs: the nominal tool comes first, then the singular vectors.
    best = int((agreement > agreement.max() - 1e-9).nonzero()[0, 0])
    p_base, p_tool = _translations(R_base[best], R_flange, p_flange, position, nominal_point)
    return R_base[best], p_base, Z[best].mT, p_tool


def starts_from_positions(
    R_flange: Float64[Tensor, "rows 3 3"],
    p_flange: Float64[Tensor, "rows 3"],
    position: Float64[Tensor, "rows 3"],
    nominal_point: Float64[Tensor, " 3"],
    reach: float,
) -> Iterator[tuple[Float64[Tensor, "3 3"], Float64[Tensor, " 3"], Float64[Tensor, " 3"]]]:
    """Yield starts for `position = R_base (R_flange · point + p_flange) + p_base`, to refine and compare.

    The first start is from `start_from_linear_equations`, if there are enough rows. The others assume a point (the
    nominal point, zero, a tenth of the reach along each axis) and fit the base by Procrustes analysis, for singular
    linear systems, for example of parallel axes or few rows.

    Yields:
        R_base, p_base [m], point [m].
    """
    if position.shape[0] >= _LINEAR_ROWS:
        yield start_from_linear_equations(R_flange, p_flange, position, nominal_point)
    along = 0.1 * reach * torch.eye(3).to(position)
    assumed = torch.cat([nominal_point[None], torch.zeros_like(nominal_point)[None], along, -along])
    for point in assumed.unbind():
        arm = p_flange + R_flange @ point
        yield *fit_base_to_points(arm, position), point


def start_from_linear_equations(
    R_flange: Float64[Tensor, "rows 3 3"],
    p_flange: Float64[Tensor, "rows 3"],
    position: Float64[Tensor, "rows 3"],
    nominal_point: Float64[Tensor, " 3"],
) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, " 3"], Float64[Tensor, " 3"]]:
    """Solve `position = R_base (R_flange · point + p_flange) + p_base` for base and point.

    Every coordinate is linear in 13 unknowns: the products of a row of `R_base` with the point (9), the row itself (3)
    and the shift (1).

    Returns:
        R_base, p_base [m], point [m].
    """
    regressor = torch.cat([R_flange.flatten(1), p_flange, torch.ones_like(p_flange[:, :1])], 1)
    solution = _least_squares(regressor, position)
    R_base = nearest_rotation(solution[9:12].mT)
    return R_base, *_translations(R_base, R_flange, p_flange, position, nominal_point)


def fit_base_to_points(
    points: Float64[Tensor, "rows 3"],
    position: Float64[Tensor, "rows 3"],
    previous_rotation: Float64[Tensor, "3 3"] | None = None,
) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, " 3"]]:
    """Fit rotation and position [m] of the base to points in the base and their measured positions.

    If the points are on one line, or there are fewer than three, `previous_rotation` determines the rest of the
    rotation.
    """
    R_base = _procrustes(points, position, previous_rotation)
    return R_base, (position - points @ R_base.mT).mean(0)


def _tool_start(
    R_base: Tensor,
    p_base: Tensor,
    R_flange: Tensor,
    p_flange: Tensor,
    position: Tensor,
    rotation: Tensor,
    turned: bool,
    R_tool: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the tool for a fixed base, as the mean over the rows."""
    in_base = (position - p_base) @ R_base
    point = (R_flange.mT @ (in_base - p_flange)[..., None])[..., 0].mean(0)
    if turned:
        R_tool = _mean_turn(R_base, R_flange, rotation)
    return R_base, p_base, R_tool, point


def _mean_turn(R_base: Tensor, R_flange: Tensor, rotation: Tensor) -> Tensor:
    """Return the rotation of the tool for a fixed rotation of the base."""
    return nearest_rotation((R_flange.mT @ R_base.mT @ rotation).sum(0))


def _procrustes(points: Tensor, position: Tensor, like: Tensor | None = None) -> Tensor:
    """Fit the rotation of the points to the positions, both relative to their means; see `fit_base_to_points`."""
    M = (position - position.mean(0)).mT @ (points - points.mean(0))
    return nearest_rotation(M if like is None else M + like * (_UNDETERMINED * M.norm()).clamp(min=1e-12))


def _least_squares(
    A: Float64[Tensor, "rows columns"], b: Float64[Tensor, "rows values"]
) -> Float64[Tensor, "columns values"]:
    """Solve `A x = b` in least squares; the minimum-norm solution if columns are dependent.

    Singular values are computed only if the inverse of the triangle does not show that none of them is negligible.
    """
    Q, R = torch.linalg.qr(A)
    inverse = torch.linalg.solve_triangular(R, torch.eye(R.shape[-1]).to(R), upper=True)
    if not bool(inverse.norm() * R.norm() < 1 / _DEPENDENT):
        inverse = torch.linalg.pinv(R, rtol=_DEPENDENT)
    solution: Tensor = inverse @ (Q.mT @ b)
    return solution


def _translations(
    R_base: Float64[Tensor, "3 3"],
    R_flange: Float64[Tensor, "rows 3 3"],
    p_flange: Float64[Tensor, "rows 3"],
    position: Float64[Tensor, "rows 3"],
    nominal_point: Float64[Tensor, " 3"],
) -> tuple[Float64[Tensor, " 3"], Float64[Tensor, " 3"]]:
    """Return the positions of base and tool for a fixed rotation of the base, which is a linear problem.

    In the axes of the base, the regressor of a row is `[1 R_flange]`. As rotations are orthogonal, the normal matrix
    depends only on the mean of R_flange; with the base eliminated, it is that of the tool. Directions of the tool that
    the rows do not determine, such as along parallel axes, keep their nominal values.
    """
    b = position @ R_base - p_flange - R_flange @ nominal_point
    turns = R_flange.mean(0)
    normal = torch.eye(3).to(position) - turns.mT @ turns
    seen = torch.einsum("nij,ni->j", R_flange, b) / len(b) - turns.mT @ b.mean(0)
    off = torch.linalg.pinv(normal, atol=1e-10, rtol=0.0, hermitian=True) @ seen
    return R_base @ (b.mean(0) - turns @ off), nominal_point + off


def _cube_rotations(like: Tensor) -> Tensor:
    """Return the 24 rotations that map a cube onto itself."""
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            M = torch.zeros(3, 3).to(like)
            for row, (column, sign) in enumerate(zip(order, signs, strict=True)):
                M[row, column] = sign
            if torch.linalg.det(M) > 0:
                rotations.append(M)
    return torch.stack(rotations)
