"""Where the measuring frame and the measured point are: base and tool of a robot taken as it is."""

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
"""Steps by which a guess in closed form is polished where it is not clear."""
CLEAR_FIT = 5e-3
"""A start that ends with an RMS below this share of the reach is taken without trying others."""


@dataclass(frozen=True, eq=False)
class BaseToolFit:
    """Base and tool that fit the measurements best, the arm itself being taken as it is.

    Attributes:
        robot: the robot with base and tool set; with several targets the tool of the first.
        tools: for every target x, y, z [m], roll, pitch, yaw [rad] of its tool.
        problem: what was solved.
        solution: of it.
    """

    robot: Robot
    tools: dict[str, Float64[np.ndarray, " 6"]]
    problem: BaseToolProblem
    solution: Solution[BaseToolState]

    @property
    def rms_position(self) -> float:
        """Root mean square of the position errors' lengths [m]."""
        return _rms_position(self.problem, self.solution.linearisation.point)

    @property
    def rms_rotation(self) -> float:
        """Root mean square of the rotation errors' angles [rad]; NaN where none was measured."""
        state = self.solution.linearisation.point
        return _rms_rotation(self.problem, state) if self.problem.turned else float("nan")

    @property
    def status(self) -> str:
        """How the least squares ended, and how many unknowns the data leave open."""
        normal = self.solution.linearisation.normal
        if len(normal) == 0:
            return "nothing was free"
        scale = normal.diagonal().clamp(min=1e-300).rsqrt()
        values = torch.linalg.eigvalsh(normal * scale * scale[:, None])
        rank, free = int((values > 1e-10 * values[-1]).sum()), len(values)
        if rank == free:
            return self.solution.status.value
        return (
            f"{self.solution.status.value}; the data see only {rank} of the {free} unknowns of base and tool, "
            "the others stay where they started (poses with more different wrist orientations would determine them)"
        )


def fit_base_and_tool(
    robot: Robot,
    measurements: Measurements,
    free_base: bool = True,
    free_tool: bool = True,
    maximum_iterations: int = 50,
) -> BaseToolFit:
    """Fit base and tool of a robot to measured poses or positions; no initial guess is needed.

    The start is closed form (see `base_and_tool_starts`), then least squares on base (6) and tool: 6 where
    rotations were measured; else the position of every target, and the tool's orientation stays as it is. The
    weights are 1 / sigma where the measurements give it; else positions and rotations are weighted by 1 /
    their own scatter.

    Args:
        robot: the robot; its base and tool are no guess, they only decide what the data leave open.
        measurements: rows with `position`, and `rotation` where measured; all in one frame.
        free_base: whether to fit the base; else the robot's is taken as it is.
        free_tool: whether to fit the tool; else the robot's is taken as it is.
        maximum_iterations: steps of the least squares.

    Raises:
        IdentificationError: no positions, several frames, or too few rows for what has to be fitted.
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
    """Guess base and tools in closed form, polished where that does not meet the positions clearly.

    Args:
        robot: see `fit_base_and_tool`, as for the others.
        measurements: see there.
        free_base: see there.
        free_tool: see there.

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
    """The base and every target's tool; where no rotation was measured the tool stays turned as it is."""
    rpy_base, rpy_tool = rpy_from_rotation(torch.stack([state.R_base, state.R_tool])).cpu().numpy()
    if not problem.turned:
        rpy_tool = robot.tool[3:]
    tools = {
        name: np.concatenate([point.cpu().numpy(), rpy_tool])
        for name, point in zip(problem.targets, state.points, strict=True)
    }
    return np.concatenate([state.p_base.cpu().numpy(), rpy_base]), tools


def _solved(robot: Robot, problem: BaseToolProblem, maximum_iterations: int) -> Solution[BaseToolState]:
    """The best end of a search from any start."""
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
    """How far off the end of a search is [m], and whether its positions are clearly met.

    An angle counts as what it moves at the end of the arm. It is not the cost, which every search divides by its own
    noise.
    """
    shift = _rms_position(problem, solution.linearisation.point)
    turn = robot.reach * _rms_rotation(problem, solution.linearisation.point) if problem.turned else 0.0
    return math.hypot(shift, turn), shift < CLEAR_FIT * robot.reach


def _rms_position(problem: BaseToolProblem, state: BaseToolState) -> float:
    return float(problem.position_residual(state).square().sum(-1).mean().sqrt())


def _rms_rotation(problem: BaseToolProblem, state: BaseToolState) -> float:
    turn = problem.rotation_residual(state)[problem.rotated]
    return float(turn.square().sum(-1).mean().sqrt())
