"""Fit of base and tool of a robot with a fixed arm."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import base_and_tool_starts
from pisigma.calibration.geometric.initial_guess.base_and_tool_problem import (
    BaseToolProblem,
    BaseToolState,
    build_base_and_tool_problem,
)
from pisigma.calibration.geometric.problem.least_squares import Solution, levenberg_marquardt
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rpy_from_rotation

GUESS_STEPS = 2
"""Steps that refine a closed-form guess with large residuals."""
CLEAR_FIT = 5e-3
"""RMS residual as a share of the reach below which a result is accepted without trying other starts."""


@dataclass(frozen=True, eq=False)
class BaseToolFit:
    """Base and tool that fit the measurements best, with a fixed arm.

    Attributes:
        robot: the robot with base and tool set; with several targets the tool of the first.
        tools: tool of every target: x, y, z [m], roll, pitch, yaw [rad].
        problem: the least-squares problem.
        solution: its solution.
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
            f"{self.solution.status.value}; the data determine only {rank} of the {free} unknowns of base and tool, "
            "the others keep their start values (poses with more different wrist orientations would determine them)"
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
    rotations were measured; else the position of every target, with the orientation of the tool fixed. The weights are
    1 / sigma if the measurements state it; otherwise the inverse of the scatter of positions and of rotations.

    Args:
        robot: the robot; its base and tool are not used as a guess, they only set what the data do not determine.
        measurements: rows with `position`, and `rotation` if measured, all in one frame.
        free_base: whether to fit the base; else that of the robot is used.
        free_tool: whether to fit the tool; else that of the robot is used.
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
    if _rms_position(problem, state) >= CLEAR_FIT * robot.reach:
        state = _solved(robot, problem, GUESS_STEPS).linearisation.point
    return _base_and_tools(robot, problem, state)


def _base_and_tools(
    robot: Robot, problem: BaseToolProblem, state: BaseToolState
) -> tuple[Float64[np.ndarray, " 6"], dict[str, Float64[np.ndarray, " 6"]]]:
    """Return the base and every target's tool; the tool keeps its orientation if no rotation was measured."""
    rpy_base, rpy_tool = rpy_from_rotation(torch.stack([state.R_base, state.R_tool])).cpu().numpy()
    if not problem.has_rotations:
        rpy_tool = robot.tool[3:]
    tools = {
        name: np.concatenate([point.cpu().numpy(), rpy_tool])
        for name, point in zip(problem.targets, state.points, strict=True)
    }
    return np.concatenate([state.p_base.cpu().numpy(), rpy_base]), tools


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
    """Compute the size of the residuals of a solution [m], and say whether those of positions are small.

    Angles are converted to lengths at the reach of the arm. The cost cannot be compared, because every search divides
    it by its own noise.
    """
    shift = _rms_position(problem, solution.linearisation.point)
    turn = (
        robot.reach * _rms_rotation(problem, solution.linearisation.point) if problem.has_rotations else 0.0
    )
    return math.hypot(shift, turn), shift < CLEAR_FIT * robot.reach


def _rms_position(problem: BaseToolProblem, state: BaseToolState) -> float:
    return float(problem.position_residual(state).square().sum(-1).mean().sqrt())


def _rms_rotation(problem: BaseToolProblem, state: BaseToolState) -> float:
    turn = problem.rotation_residual(state)[problem.rotated]
    return float(turn.square().sum(-1).mean().sqrt())
