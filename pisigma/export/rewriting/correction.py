"""Corrected targets in place of a program's, and way points where a straight move would leave its line."""

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.export.programs.targets import WITH_TARGET
from pisigma.export.rewriting.scan import Edit, Frame, LinearMove, ScannedProgram, Target
from pisigma.inverse.corrected_ik import CorrectedIK
from pisigma.inverse.solution import Solution
from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.status import Status
from pisigma.se3 import invert, rotation_from_vector, rotation_vector, transform, transform_from_xyzrpy

SPACING = 0.01
"""[m] The way is looked at in steps of at most this length, or of two degrees."""
STEP_ANGLE = 0.035
MOST_STEPS = 512
LEVER = 0.1
"""[m] An angle off the straight way counts as the distance that it makes at this distance from the tool."""


_LINE_NUMBER = re.compile(r"(?m)^ *\d+:")


@dataclass(frozen=True, eq=False)
class CorrectedProgram:
    """A program with corrected targets.

    Attributes:
        text: of the program.
        statuses: of every target: its line, and whether it is reached.
        way_points: how many were put in.
        left: line and reason of whatever was left alone.
        largest_shift: of a target [m].
    """

    text: str
    statuses: tuple[tuple[int, Status], ...]
    way_points: int
    left: tuple[tuple[int, str], ...]
    largest_shift: float

    @property
    def unreached(self) -> tuple[tuple[int, Status], ...]:
        """Line and status of targets that keep their line."""
        return tuple((line, status) for line, status in self.statuses if status not in WITH_TARGET)

    def diff(self, before: str, names: tuple[str, str]) -> str:
        """What has changed, as a unified diff, in which numbers of lines do not count."""
        old, new = (_LINE_NUMBER.sub(":", text).splitlines() for text in (before, self.text))
        lines = difflib.unified_diff(old, new, *names, lineterm="", n=0)
        return "\n".join(lines)


@dataclass(frozen=True)
class ProgramCorrection:
    """Corrects programs for a controller that computes with the robot as drawn.

    Attributes:
        solver: the model.
        branch: to take instead of the trained one.
        tolerance: how far the tool may leave a straight line between way points [m].
    """

    solver: CorrectedIK
    branch: str | None
    tolerance: float

    def correct(self, program: ScannedProgram) -> CorrectedProgram:
        """Rewrite what is understood and can be reached; the rest keeps its text.

        A target is the pose that the real tool shall take. Its place takes the pose at which the robot as drawn stands
        at the corrected joint values. A straight move is cut where the line between two of these leaves the corrected
        line by more than the tolerance.
        """
        edits, statuses, shift = [], [], 0.0
        for target in program.targets:
            (T,), solution = self.commanded(target, target.pose.T[None])
            status = Status(int(solution.status[0]))
            statuses.append((target.line, status))
            if status in WITH_TARGET:
                edits.append(Edit(target.pose.span, target.pose.write(T)))
                shift = max(shift, float((T - target.pose.T)[:3, 3].norm()))
        count, left = 0, dict(program.left)
        for move in program.moves:
            points = self.way_points(move)
            if isinstance(points, str):
                left.setdefault(move.line, points)
            elif points:
                edits += move.way_points(points)
                count += len(points)
        text = program.finish(_edited(program.text, edits))
        return CorrectedProgram(text, tuple(statuses), count, tuple(sorted(left.items())), shift)

    def commanded(
        self, target: Target, T: Float64[Tensor, "poses 4 4"]
    ) -> tuple[Float64[Tensor, "poses 4 4"], Solution]:
        """Poses to command for wanted ones, both of a target's tool in its frame, and how they are reached."""
        robot = self.solver.model.robot
        base, tool = (
            transform_from_xyzrpy(torch.from_numpy(frame.copy())) for frame in (robot.base, robot.tool)
        )
        before, after = base @ target.T_root_frame, invert(target.T_flange_tool) @ tool
        solution = self.solver(before @ T @ after, branch=self.branch)
        drawn = forward_kinematics(robot, robot.to_dh(solution.q.detach().to("cpu", torch.float64)))
        return invert(before) @ drawn @ invert(after), solution

    def way_points(self, move: LinearMove) -> list[Frame] | str:
        """The way points of a straight move; or why it is not cut."""
        if move.start is None:
            return "where the straight move begins is not stated, so only its end is corrected"
        start, end = move.start, move.end
        T_start = (
            invert(end.T_root_frame)
            @ start.T_root_frame
            @ start.pose.T
            @ invert(start.T_flange_tool)
            @ end.T_flange_tool
        )
        wanted = _between(T_start, end.pose.T, _steps(T_start, end.pose.T))
        T, solution = self.commanded(end, wanted)
        if not bool(_reached(solution).all()):
            return "the straight move cannot be followed everywhere, so it has no way points"
        if len(set(solution.branch.tolist())) > 1:
            return "the straight move passes from one branch to another, so it has no way points"
        stride = len(T) - 1
        while stride > 1 and self._off_chords(T, stride) > self.tolerance:
            stride //= 2
        return list(T[stride:-1:stride])

    def _off_chords(self, T: Float64[Tensor, "points 4 4"], stride: int) -> float:
        """How far poses are at most off the straight lines between every so many of them [m]."""
        chords = [_between(T[i], T[i + stride], stride)[:-1] for i in range(0, len(T) - 1, stride)]
        chord = torch.cat(chords)
        turn = rotation_vector(chord[:, :3, :3].mT @ T[:-1, :3, :3]).norm(dim=-1)
        return float(((chord - T[:-1])[:, :3, 3].norm(dim=-1) + LEVER * turn).max())


def _reached(solution: Solution) -> Bool[Tensor, " poses"]:
    return torch.isin(solution.status.cpu(), torch.tensor([int(status) for status in WITH_TARGET]))


def _steps(start: Frame, end: Frame) -> int:
    """A power of two: steps that are short enough to see the correction change."""
    length = float((end - start)[:3, 3].norm())
    angle = float(rotation_vector(start[:3, :3].mT @ end[:3, :3]).norm())
    steps = 8
    while steps < MOST_STEPS and steps < max(length / SPACING, angle / STEP_ANGLE):
        steps *= 2
    return steps


def _between(start: Frame, end: Frame, steps: int) -> Float64[Tensor, "points 4 4"]:
    """Poses from one to another: a straight line, and a turn about one axis."""
    share = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:, None]
    turn = rotation_vector(start[:3, :3].mT @ end[:3, :3])
    R = start[:3, :3] @ rotation_from_vector(share * turn)
    return transform(R, start[:3, 3] + share * (end - start)[:3, 3])


def _edited(text: str, edits: Sequence[Edit]) -> str:
    """The text with all edits; those at one place stay in their order."""
    parts, position = [], 0
    for edit in sorted(edits, key=lambda edit: edit.span):
        parts += [text[position : edit.span[0]], edit.text]
        position = edit.span[1]
    return "".join([*parts, text[position:]])
