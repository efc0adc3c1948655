"""Corrected targets in place of a program's, and way points where a straight move would leave its line."""

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.export.programs.targets import WITH_TARGET
from pisigma.export.rewriting.scan import Edit, Frame, LinearMove, ScannedProgram, Target
from pisigma.inverse.corrected_ik import CorrectedIK
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
        branches: names of those that the targets were corrected on.
    """

    text: str
    statuses: tuple[tuple[int, Status], ...]
    way_points: int
    left: tuple[tuple[int, str], ...]
    largest_shift: float
    branches: tuple[str, ...]

    @property
    def unreached(self) -> tuple[tuple[int, Status], ...]:
        """Line and status of targets that keep their line."""
        return tuple((line, status) for line, status in self.statuses if status not in WITH_TARGET)

    def diff(self, before: str, names: tuple[str, str]) -> str:
        """What has changed, as a unified diff, in which numbers of lines do not count."""
        old, new = (_LINE_NUMBER.sub(":", text).splitlines() for text in (before, self.text))
        lines = difflib.unified_diff(old, new, *names, lineterm="", n=0)
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Commanded:
    """What to command for wanted poses.

    Attributes:
        T: poses of the robot as drawn, in the frame of the wanted ones.
        status: of every pose.
        branches: those that they lie on.
    """

    T: Float64[Tensor, "poses 4 4"]
    status: tuple[Status, ...]
    branches: frozenset[int]

    @property
    def reached(self) -> bool:
        """Whether all poses are."""
        return set(self.status) <= set(WITH_TARGET)


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
        targets, moves = program.targets, [move for move in program.moves if move.start is not None]
        unknown = "where the straight move begins is not stated, so only its end is corrected"
        left = {move.line: unknown for move in program.moves if move.start is None} | dict(program.left)
        paths = [_path(move) for move in moves]
        answers = self.commanded(
            [*targets, *(move.end for move in moves)], [*(target.pose.T[None] for target in targets), *paths]
        )
        edits, count, shift = [], 0, 0.0
        for target, there in zip(targets, answers, strict=False):
            if there.reached:
                edits.append(Edit(target.pose.span, target.pose.write(there.T[0])))
                shift = max(shift, float((there.T[0] - target.pose.T)[:3, 3].norm()))
        for move, there in zip(moves, answers[len(targets) :], strict=True):
            points = self.way_points(there)
            if isinstance(points, str):
                left.setdefault(move.line, points)
            elif points:
                edits += move.way_points(points)
                count += len(points)
        text = program.finish(_edited(program.text, edits))
        statuses = ((target.line, there.status[0]) for target, there in zip(targets, answers, strict=False))
        branches = sorted(
            {index for there in answers[: len(targets)] if there.reached for index in there.branches}
        )
        return CorrectedProgram(
            text,
            tuple(statuses),
            count,
            tuple(sorted(left.items())),
            shift,
            tuple(self.solver.branches[index] for index in branches),
        )

    def commanded(
        self, targets: Sequence[Target], poses: Sequence[Float64[Tensor, "_poses 4 4"]]
    ) -> list[Commanded]:
        """What to command for the wanted poses of each target's tool in its frame."""
        robot, counts = self.solver.model.robot, torch.tensor([len(T) for T in poses])
        base, tool = (
            transform_from_xyzrpy(torch.from_numpy(frame.copy())) for frame in (robot.base, robot.tool)
        )
        before = base @ torch.stack([target.T_root_frame for target in targets])
        after = invert(torch.stack([target.T_flange_tool for target in targets])) @ tool
        before, after = (T.repeat_interleave(counts, 0) for T in (before, after))
        solution = self.solver(before @ torch.cat(list(poses)) @ after, branch=self.branch)
        drawn = forward_kinematics(robot, robot.to_dh(solution.q.detach().to("cpu", torch.float64)))
        parts = (invert(before) @ drawn @ invert(after), solution.status, solution.branch)
        split = (part.split(counts.tolist()) for part in parts)
        return [
            Commanded(T, tuple(Status(value) for value in status.tolist()), frozenset(branch.tolist()))
            for T, status, branch in zip(*split, strict=True)
        ]

    def way_points(self, there: Commanded) -> list[Frame] | str:
        """The way points of a straight move; or why it is not cut."""
        if not there.reached:
            return "the straight move cannot be followed everywhere, so it has no way points"
        if len(there.branches) > 1:
            return "the straight move passes from one branch to another, so it has no way points"
        stride = len(there.T) - 1
        while stride > 1 and _off_chords(there.T, stride) > self.tolerance:
            stride //= 2
        return list(there.T[stride:-1:stride])


def _path(move: LinearMove) -> Float64[Tensor, "points 4 4"]:
    """The straight way that the program means, of the end's tool in the end's frame."""
    start, end = move.start, move.end
    assert start is not None
    T_flange = start.T_root_frame @ start.pose.T @ invert(start.T_flange_tool)
    T_start = invert(end.T_root_frame) @ T_flange @ end.T_flange_tool
    return _between(T_start[None], end.pose.T[None], _steps(T_start, end.pose.T))[0]


def _off_chords(T: Float64[Tensor, "points 4 4"], stride: int) -> float:
    """How far poses are at most off the straight lines between every so many of them [m]."""
    chord = _between(T[:-1:stride], T[stride::stride], stride)[:, :-1].flatten(0, 1)
    turn = rotation_vector(chord[:, :3, :3].mT @ T[:-1, :3, :3]).norm(dim=-1)
    return float(((chord - T[:-1])[:, :3, 3].norm(dim=-1) + LEVER * turn).max())


def _steps(start: Frame, end: Frame) -> int:
    """A power of two: steps that are short enough to see the correction change."""
    length = float((end - start)[:3, 3].norm())
    angle = float(rotation_vector(start[:3, :3].mT @ end[:3, :3]).norm())
    steps = 8
    while steps < MOST_STEPS and steps < max(length / SPACING, angle / STEP_ANGLE):
        steps *= 2
    return steps


def _between(
    start: Float64[Tensor, "ways 4 4"], end: Float64[Tensor, "ways 4 4"], steps: int
) -> Float64[Tensor, "ways points 4 4"]:
    """Poses from ones to others: a straight line, and a turn about one axis."""
    share = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:, None]
    turn = rotation_vector(start[:, :3, :3].mT @ end[:, :3, :3])
    R = start[:, None, :3, :3] @ rotation_from_vector(share * turn[:, None])
    return transform(R, start[:, None, :3, 3] + share * (end - start)[:, None, :3, 3])


def _edited(text: str, edits: Sequence[Edit]) -> str:
    """The text with all edits; those at one place stay in their order."""
    parts, position = [], 0
    for edit in sorted(edits, key=lambda edit: edit.span):
        parts += [text[position : edit.span[0]], edit.text]
        position = edit.span[1]
    return "".join([*parts, text[position:]])
