"""Fit of base and tool of a robot with a fixed arm, and of the base in a frame whose axes were touched."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import base_and_tool_starts
from pisigma.calibration.geometric.initial_guess.base_and_tool_problem import (
    BaseToolProblem,
    BaseToolState,
    build_base_and_tool_problem,
)
from pisigma.calibration.geometric.problem.least_squares import Solution, levenberg_marquardt
from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.se3 import (
    nearest_rotation,
    rotation_from_vector,
    rotation_from_zyx,
    skew,
    zyx_from_rotation,
)

_GUESS_STEPS = 2
"""Number of steps that refine a closed-form guess with large residuals."""
_CLEAR_FIT = 5e-3
"""RMS residual, as a share of the reach, below which a result is accepted without trying other starts."""


@dataclass(frozen=True, eq=False)
class BaseToolFit:
    """Base and tool that fit the measurements best with a fixed arm.

    Attributes:
        robot: the robot with the fitted base and tool; with several targets, the tool of the first target.
        tools: tool of every target: x, y, z [m], roll, pitch, yaw [rad].
        problem: the least-squares problem.
        solution: solution of the least-squares problem.
    """

    robot: Robot
    tools: dict[str, Float64[np.ndarray, " 6"]]
    problem: BaseToolProblem
    solution: Solution[BaseToolState]

    @property
    def rms_position(self) -> float:
        """Root mean square length of the position errors [m]."""
        return _rms_position(self.problem, self.solution.linearisation.point)

    @property
    def rms_rotation(self) -> float:
        """Root mean square angle of the rotation errors [rad]; NaN if none was measured."""
        state = self.solution.linearisation.point
        return _rms_rotation(self.problem, state) if self.problem.has_rotations else float("nan")

    @property
    def status(self) -> str:
        """Reason for which the least squares ended, and number of unknowns that the data do not determine."""
        normal = self.solution.linearisation.normal
        if len(normal) == 0:
            return "nothing was free"
        scale = normal.diagonal().clamp(min=1e-300).rsqrt()
        values = torch.linalg.eigvalsh(normal * scale * scale[:, None])
        rank, free = int((values > 1e-10 * values[-1]).sum()), len(values)
        if rank == free:
            return self.solution.status.value
        return (
            f"{self.solution.status.value}; the data determine only {rank} of the {free} unknowns of base and "
            "tool; the others keep their initial values (poses with a wider variety of wrist orientations would "
            "determine them)"
        )


def fit_base_and_tool(
    robot: Robot,
    measurements: Measurements,
    free_base: bool = True,
    free_tool: bool = True,
    maximum_iterations: int = 50,
) -> BaseToolFit:
    """Fit base and tool of a robot to measured poses or positions; no initial guess is needed.

    A closed-form start (see `base_and_tool_starts`) is refined by least squares on base (6) and tool: 6 parameters if
    rotations were measured; otherwise the position of every target, with the orientation of the tool fixed. The weights
    are 1 / sigma if the measurements state sigma, otherwise the inverse of the scatter of positions and of rotations.

    Args:
        robot: the robot; its base and tool are used only for what the data do not determine, not as a guess.
        measurements: rows with `position`, and `rotation` if measured, all in one frame.
        free_base: whether to fit the base; otherwise the base of the robot is used.
        free_tool: whether to fit the tool; otherwise the tool of the robot is used.
        maximum_iterations: maximum number of steps.

    Raises:
        IdentificationError: there are no positions, several frames, or too few rows.
        PoseError: the joint values do not fit the robot.
    """
    problem = build_base_and_tool_problem(robot, measurements, free_base, free_tool)
    solution = _solved(robot, problem, maximum_iterations)
    base, tools = _base_and_tools(robot, problem, solution.linearisation.point)
    return BaseToolFit(
        robot=robot.with_geometry(
            base=base if free_base else None, tool=tools[problem.targets[0]] if free_tool else None
        ),
        tools=tools,
        problem=problem,
        solution=solution,
    )


def guess_base_and_tool(
    robot: Robot, measurements: Measurements, free_base: bool, free_tool: bool
) -> tuple[Float64[np.ndarray, " 6"], dict[str, Float64[np.ndarray, " 6"]]]:
    """Guess base and tools in closed form, with a refinement if the residuals are large.

    Args:
        robot: see `fit_base_and_tool`.
        measurements: see `fit_base_and_tool`.
        free_base: see `fit_base_and_tool`.
        free_tool: see `fit_base_and_tool`.

    Returns:
        The base, and the tool of every target: x, y, z [m], roll, pitch, yaw [rad].

    Raises:
        IdentificationError: see `fit_base_and_tool`.
        PoseError: the joint values do not fit the robot.
    """
    problem = build_base_and_tool_problem(robot, measurements, free_base, free_tool)
    state = next(base_and_tool_starts(robot, problem))
    if _rms_position(problem, state) >= _CLEAR_FIT * robot.reach:
        state = _solved(robot, problem, _GUESS_STEPS).linearisation.point
    return _base_and_tools(robot, problem, state)


def _base_and_tools(
    robot: Robot, problem: BaseToolProblem, state: BaseToolState
) -> tuple[Float64[np.ndarray, " 6"], dict[str, Float64[np.ndarray, " 6"]]]:
    """Return the base and every target's tool; the tool keeps its orientation if no rotation was measured."""
    zyx_base, zyx_tool = zyx_from_rotation(torch.stack([state.R_base, state.R_tool])).cpu().numpy()
    if not problem.has_rotations:
        zyx_tool = robot.tool[3:]
    tools = {
        name: np.concatenate([point.cpu().numpy(), zyx_tool])
        for name, point in zip(problem.targets, state.points, strict=True)
    }
    return np.concatenate([state.p_base.cpu().numpy(), zyx_base]), tools


def _solved(robot: Robot, problem: BaseToolProblem, maximum_iterations: int) -> Solution[BaseToolState]:
    """Return the best solution of all starts."""
    best: tuple[float, Solution[BaseToolState], bool] | None = None
    for start in base_and_tool_starts(robot, problem):
        solution = levenberg_marquardt(problem, start, maximum_iterations)
        off, clear = _off(robot, problem, solution)
        if best is None or off < best[0] * (1 - 1e-6):
            best = off, solution, clear
        if best[2]:
            break
    assert best is not None
    return best[1]


def _off(robot: Robot, problem: BaseToolProblem, solution: Solution[BaseToolState]) -> tuple[float, bool]:
    """Return the size of the residuals of a solution [m], and whether the residuals of positions are small.

    Angles are converted to lengths at the reach of the arm. Costs cannot be compared, because every search divides by
    its own estimate of the noise.
    """
    shift = _rms_position(problem, solution.linearisation.point)
    turn = (
        robot.reach * _rms_rotation(problem, solution.linearisation.point) if problem.has_rotations else 0.0
    )
    return math.hypot(shift, turn), shift < _CLEAR_FIT * robot.reach


def _rms_position(problem: BaseToolProblem, state: BaseToolState) -> float:
    return float(problem.position_residual(state).square().sum(-1).mean().sqrt())


def _rms_rotation(problem: BaseToolProblem, state: BaseToolState) -> float:
    turn = problem.rotation_residual(state)[problem.has_rotation]
    return float(turn.square().sum(-1).mean().sqrt())


_MIN_TOUCHES = 4
"""Smallest number of touches along an axis that determine its direction."""
_MIN_SPREAD_RATIO = 0.03
"""Ratio of the smallest to the largest spread of the tips that is needed to determine a direction."""
_REFINEMENTS = 10
"""Number of Gauss-Newton steps after the linear solution of a touched frame."""
_MAX_RMS_SHARE = 0.05
"""Largest RMS residual of the touches for an accepted guess, as a share of the reach."""
_BASE_UNKNOWNS = 6


def fit_base_to_touches(
    tip: Float64[Tensor, "touches 3"],
    axis: Int64[Tensor, " touches"],
    touch: Float64[Tensor, " touches"],
    guess: Float64[Tensor, " 6"],
) -> tuple[Float64[Tensor, " 6"], float]:
    """Compute T_frame_robot from touches, with the tips in the robot's frame.

    `touch = R[axis] · tip + p[axis]` is linear in R and p for every axis separately; the third axis follows from two.
    Then all six unknowns are refined together. The refinement also starts at the guess, and the better result is used.

    Args:
        tip: nominal positions of the tip [m].
        axis: axis of the frame along which each touch was measured.
        touch: measured coordinates [m].
        guess: the robot's base, x, y, z [m], roll, pitch, yaw [rad].

    Returns:
        The base, and the RMS residual of the touches [m].
    """
    starts = [(rotation_from_zyx(guess[3:]), guess[:3])]
    linear = _linear_rotation(tip, axis, touch)
    if linear is not None:
        starts.insert(0, (linear, torch.zeros(3).to(tip)))
    best, miss = guess, float("inf")
    for R, p in starts:
        R, p, rms = _refined(tip, axis, touch, R, p)
        if rms < miss:
            best, miss = torch.cat([p, zyx_from_rotation(R)]), rms
    return best, miss


def _linear_rotation(tip: Tensor, axis: Tensor, touch: Tensor) -> Tensor | None:
    rows: list[Tensor | None] = []
    for k in range(3):
        points, values = tip[axis == k], touch[axis == k]
        rows.append(None)
        if len(points) < _MIN_TOUCHES:
            continue
        centred = points - points.mean(0)
        singular = torch.linalg.svdvals(centred)
        if float(singular[-1]) > _MIN_SPREAD_RATIO * float(singular[0]):
            row = torch.linalg.lstsq(centred, (values - values.mean())[:, None]).solution[:, 0]
            rows[k] = row / row.norm().clamp(min=1e-12)
    for k in range(3):
        following, last = rows[(k + 1) % 3], rows[(k + 2) % 3]
        if rows[k] is None and following is not None and last is not None:
            rows[k] = torch.linalg.cross(following, last)
    directions = [row for row in rows if row is not None]
    return nearest_rotation(torch.stack(directions)) if len(directions) == 3 else None


def _refined(tip: Tensor, axis: Tensor, touch: Tensor, R: Tensor, p: Tensor) -> tuple[Tensor, Tensor, float]:
    rows = torch.arange(len(tip))
    eye = torch.eye(3).to(tip)[axis]
    residual = touch - (tip @ R.mT + p)[rows, axis]
    for _ in range(_REFINEMENTS):
        turned = tip @ R.mT
        J = torch.cat([eye, (-skew(turned))[rows, axis]], -1)
        step = torch.linalg.pinv(J, rtol=1e-6) @ residual
        R, p = rotation_from_vector(step[3:]) @ R, p + step[:3]
        residual = touch - (tip @ R.mT + p)[rows, axis]
    return R, p, float(residual.square().mean().sqrt())


def check_touched_base(measurements: Measurements, name: str, rms: float, reach: float) -> None:
    """Refuse a guess of a touched frame with large residuals.

    Raises:
        IdentificationError: the RMS residual of the touches is too large.
    """
    if rms <= _MAX_RMS_SHARE * reach:
        return
    counts = ", ".join(f"{(measurements.touch_axis or ()).count(axis)} along {axis}" for axis in "xyz")
    raise IdentificationError(
        f"the touches of frame '{name}' ({counts}) do not determine its pose: the best fit has an RMS error of "
        f"{rms * 1e3:.3g} mm",
        value=name,
        at=Place(measurements.source),
        remedy="check that all touches belong to this frame, or give the approximate base of the robot in it, "
        f"base_guesses={{'{name}': (x, y, z, roll, pitch, yaw)}}",
    )


def check_touched_frames(measurements: Measurements, names: tuple[str, ...]) -> None:
    """Refuse frames with no more touches than the six unknowns of the frame.

    Raises:
        IdentificationError: a frame has six touches or fewer.
    """
    if measurements.touch is None:
        return
    touch = measurements.is_measured("touch").tolist()
    other = (measurements.is_measured("position") | measurements.is_measured("pose")).tolist()
    for name in names:
        rows = [row for row, frame in enumerate(measurements.frame) if frame == name]
        touches = sum(touch[row] for row in rows)
        if not touches or any(other[row] for row in rows) or touches > _BASE_UNKNOWNS:
            continue
        raise IdentificationError(
            f"expected more than {_BASE_UNKNOWNS} touches of frame '{name}', which has {_BASE_UNKNOWNS} unknowns, got "
            f"{touches}",
            expected=f"more than {_BASE_UNKNOWNS} touches of frame '{name}'",
            value=touches,
            at=Place(measurements.source),
            remedy=f"touch it about {3 * _BASE_UNKNOWNS} times along x, y and z, or omit its rows",
        )
