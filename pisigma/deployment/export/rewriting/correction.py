"""Correction of the targets of a program, adding waypoints to moves that would leave their line or arc."""

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.deployment.export.programs.targets import WITH_TARGET
from pisigma.deployment.export.rewriting.scan import Edit, Frame, PathMove, Pose, ScannedProgram, Target
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, rotation_from_vector, rotation_vector, transform, transform_from_xyz_zyx

_SPACING = 0.01
"""Largest distance between points at which a path is evaluated [m]."""
_STEP_ANGLE = 0.035
"""Largest rotation between points at which a path is evaluated [rad], two degrees."""
MAX_STEPS = 512
_LEVER = 0.1
"""Distance from the tool [m] at which a rotational deviation from the path is converted to a length."""


_LINE_NUMBER = re.compile(r"(?m)^ *\d+:")
_STRAIGHT = 1e-4
"""Sine of the angle between the chords to the second and the third point below which they define no arc."""

COLLINEAR = "the points of the arc are collinear or coincide, so it has no waypoints"
OTHER_ORIENTATION = (
    "the orientation at the via point of the arc is not between start and end, so it has no waypoints"
)

Points = Float64[Tensor, "arcs 3"]


@dataclass(frozen=True, eq=False)
class CorrectedProgram:
    """A program with corrected targets.

    Attributes:
        text: text of the program.
        statuses: line and status of every target.
        waypoint_count: number of inserted waypoints.
        unchanged_lines: line of every target that was not changed, and the reason.
        largest_shift: largest shift of a target [m].
        branches: names of the branches of the corrected targets.
    """

    text: str
    statuses: tuple[tuple[int, Status], ...]
    waypoint_count: int
    unchanged_lines: tuple[tuple[int, str], ...]
    largest_shift: float
    branches: tuple[str, ...]

    @property
    def unreached_lines(self) -> tuple[tuple[int, Status], ...]:
        """Line and status of targets that were not changed."""
        return tuple((line, status) for line, status in self.statuses if status not in WITH_TARGET)

    def diff(self, before: str, names: tuple[str, str]) -> str:
        """Return the changes as a unified diff that ignores the line numbers of the language."""
        old, new = (_LINE_NUMBER.sub(":", text).splitlines() for text in (before, self.text))
        lines = difflib.unified_diff(old, new, *names, lineterm="", n=0)
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class CommandedPoses:
    """Poses to command for target poses.

    Attributes:
        T: poses of the nominal robot, in the frame of the target poses.
        status: status of every pose.
        branches: indices of the branches of the poses.
    """

    T: Float64[Tensor, "poses 4 4"]
    status: tuple[Status, ...]
    branches: frozenset[int]

    @property
    def all_reached(self) -> bool:
        """Whether all poses are reached."""
        return set(self.status) <= set(WITH_TARGET)


@dataclass(frozen=True)
class ProgramCorrection:
    """Correction of programs for a controller that computes with the nominal robot.

    Attributes:
        solver: corrected inverse kinematics of the model.
        branch: branch to use instead of the trained branch.
        tolerance: largest deviation of the tool from a straight line or an arc between waypoints [m].
    """

    solver: CorrectedIK
    branch: str | None
    tolerance: float

    def correct_program(self, program: ScannedProgram) -> CorrectedProgram:
        """Rewrite all targets that are understood and reached, and leave other text unchanged.

        A target is the intended pose of the real tool. It is replaced by the nominal robot's pose at the corrected
        joint values. A straight move is split where the line between two of these poses deviates from the corrected
        line by more than the tolerance; an arc is split into arcs in the same way.
        """
        targets, ways = program.targets, {move: self.path_points(move) for move in program.moves}
        paths = {move: way for move, way in ways.items() if isinstance(way, Tensor)}
        answers = self.commanded_poses(
            [*targets, *(move.end for move in paths)],
            [*(target.pose.T[None] for target in targets), *paths.values()],
        )
        points = {
            move: self.waypoints(move, there)
            for move, there in zip(paths, answers[len(targets) :], strict=True)
        }
        reasons = {move.line: why for move, why in (ways | points).items() if isinstance(why, str)}
        cuts = [(move, way) for move, way in points.items() if way and not isinstance(way, str)]
        answered = list(zip(targets, answers, strict=False))
        reached = [(target.pose, there) for target, there in answered if there.all_reached]
        text = program.finish(_edited(program.text, _edits(reached, cuts)))
        branches = sorted({index for _, there in reached for index in there.branches})
        return CorrectedProgram(
            text,
            tuple((target.line, there.status[0]) for target, there in answered),
            sum(len(way) for _, way in cuts),
            tuple(sorted((reasons | dict(program.unchanged_lines)).items())),
            max((float((there.T[0] - pose.T)[:3, 3].norm()) for pose, there in reached), default=0.0),
            tuple(self.solver.branches[index] for index in branches),
        )

    def commanded_poses(
        self, targets: Sequence[Target], poses: Sequence[Float64[Tensor, "_poses 4 4"]]
    ) -> list[CommandedPoses]:
        """Compute the poses to command for poses of each target's tool in the target's frame."""
        robot, counts = self.solver.model.robot, torch.tensor([len(T) for T in poses])
        base, tool = (
            transform_from_xyz_zyx(torch.from_numpy(frame.copy())) for frame in (robot.base, robot.tool)
        )
        before = base @ torch.stack([target.T_root_frame for target in targets])
        after = invert(torch.stack([target.T_flange_tool for target in targets])) @ tool
        before, after = (T.repeat_interleave(counts, 0) for T in (before, after))
        solution = self.solver(before @ torch.cat(list(poses)) @ after, branch=self.branch)
        nominal_tool = forward_kinematics(robot, robot.to_dh(solution.q.detach().to("cpu", torch.float64)))
        parts = (invert(before) @ nominal_tool @ invert(after), solution.status, solution.branch)
        split = (part.split(counts.tolist()) for part in parts)
        return [
            CommandedPoses(T, tuple(Status(value) for value in status.tolist()), frozenset(branch.tolist()))
            for T, status, branch in zip(*split, strict=True)
        ]

    def path_points(self, move: PathMove) -> Float64[Tensor, "points 4 4"] | str:
        """Return the path of the end's tool in the end's frame, or the reason why it is unknown."""
        if move.start is None or (move.circular and move.via is None):
            what = "start or via point" if move.circular else "start"
            return f"the {what} of the {_kind(move)} is not stated, so only its end is corrected"
        start, end = _seen_from(move.end, move.start), move.end.pose.T[None]
        if move.via is None:
            return _between(start, end, _steps(start, end, _distance(start, end)))[0]
        via = _seen_from(move.end, move.via)
        if is_straight(*(T[:, :3, 3] for T in (start, via, end))):
            return COLLINEAR
        arc = CircularArcs.through_points(*(T[:, :3, 3] for T in (start, via, end)))
        between = start[:, :3, :3] @ rotation_from_vector(arc.via_angle / arc.angle * _turn(start, end))
        if _LEVER * float(rotation_vector(between.mT @ via[:, :3, :3]).norm()) > self.tolerance:
            return OTHER_ORIENTATION
        length = float(arc.angle * arc.radius_vector.norm())
        return _round(start, via, end, _steps(start, end, length))[0]

    def waypoints(self, move: PathMove, commanded: CommandedPoses) -> list[Frame] | str:
        """Return the waypoints of a move (see `PathMove.waypoints`), or the reason why it is not split."""
        if not commanded.all_reached:
            return f"the {_kind(move)} has poses that are not reached, so it has no waypoints"
        if len(commanded.branches) > 1:
            return f"the {_kind(move)} changes from one branch to another, so it has no waypoints"
        whole = stride = len(commanded.T) - 1
        least = 2 if move.circular else 1
        while stride > least and _off(commanded.T, stride, move.circular) > self.tolerance:
            stride //= 2
        between = stride // least
        return list(commanded.T[between:-1:between]) if stride < whole else []


def _kind(move: PathMove) -> str:
    return "arc" if move.circular else "straight move"


def _edits(
    reached: Sequence[tuple[Pose, CommandedPoses]], cuts: Sequence[tuple[PathMove, list[Frame]]]
) -> list[Edit]:
    """Return the edits of targets and waypoints; the last waypoint of an arc replaces its via point."""
    added = [edit for move, way in cuts for edit in move.waypoints(way)]
    replaced = [edit.span for edit in added if edit.span[0] < edit.span[1]]
    corrected = [Edit(pose.span, pose.write(there.T[0])) for pose, there in reached]
    return added + [
        edit
        for edit in corrected
        if not any(begin <= edit.span[0] and edit.span[1] <= end for begin, end in replaced)
    ]


def _seen_from(end: Target, target: Target) -> Float64[Tensor, "1 4 4"]:
    """Return the pose of the end's tool in the end's frame when the robot is at a target."""
    T_flange = target.T_root_frame @ target.pose.T @ invert(target.T_flange_tool)
    return (invert(end.T_root_frame) @ T_flange @ end.T_flange_tool)[None]


def _off(T: Float64[Tensor, "points 4 4"], stride: int, circular: bool) -> float:
    """Compute the largest deviation of poses from the lines or arcs between every `stride`-th pose [m]."""
    start, end = T[:-1:stride], T[stride::stride]
    interpolated = (
        _round(start, T[stride // 2 :: stride], end, stride) if circular else _between(start, end, stride)
    )
    interpolated = interpolated[:, :-1].flatten(0, 1)
    turn = rotation_vector(interpolated[:, :3, :3].mT @ T[:-1, :3, :3]).norm(dim=-1)
    return float(((interpolated - T[:-1])[:, :3, 3].norm(dim=-1) + _LEVER * turn).max())


def _steps(start: Float64[Tensor, "1 4 4"], end: Float64[Tensor, "1 4 4"], length: float) -> int:
    """Return the number of steps of a path, a power of two that is large enough to resolve the correction."""
    angle = float(_turn(start, end).norm())
    steps = 8
    while steps < MAX_STEPS and steps < max(length / _SPACING, angle / _STEP_ANGLE):
        steps *= 2
    return steps


def _distance(start: Float64[Tensor, "1 4 4"], end: Float64[Tensor, "1 4 4"]) -> float:
    return float((end - start)[:, :3, 3].norm())


def _turn(start: Float64[Tensor, "ways 4 4"], end: Float64[Tensor, "ways 4 4"]) -> Float64[Tensor, "ways 3"]:
    """Compute rotation vectors from start to end poses [rad], in the frames of the start poses."""
    return rotation_vector(start[:, :3, :3].mT @ end[:, :3, :3])


def _round(
    start: Float64[Tensor, "ways 4 4"],
    via: Float64[Tensor, "ways 4 4"],
    end: Float64[Tensor, "ways 4 4"],
    steps: int,
) -> Float64[Tensor, "ways points 4 4"]:
    """Return poses from start by via to end: along an arc, with a rotation about one axis from start to end."""
    arcs = CircularArcs.through_points(*(T[:, :3, 3] for T in (start, via, end)))
    return transform(_between(start, end, steps)[..., :3, :3], arcs.sample(steps))


def _between(
    start: Float64[Tensor, "ways 4 4"], end: Float64[Tensor, "ways 4 4"], steps: int
) -> Float64[Tensor, "ways points 4 4"]:
    """Return poses from start to end: along a straight line, with a rotation about one axis."""
    share = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:, None]
    R = start[:, None, :3, :3] @ rotation_from_vector(share * _turn(start, end)[:, None])
    return transform(R, start[:, None, :3, 3] + share * (end - start)[:, None, :3, 3])


def _edited(text: str, edits: Sequence[Edit]) -> str:
    """Return a text with all edits; edits at the same position remain in order."""
    parts, position = [], 0
    for edit in sorted(edits, key=lambda edit: edit.span):
        parts += [text[position : edit.span[0]], edit.text]
        position = edit.span[1]
    return "".join([*parts, text[position:]])


@dataclass(frozen=True, eq=False)
class CircularArcs:
    """Arcs that start at first points, pass second points and end at third points.

    Attributes:
        centre: centres of the circles [m].
        radius_vector: vectors from the centres to the first points [m].
        axis: axes of counter-clockwise motion.
        via_angle: angles from the first to the second points [rad].
        angle: angles from the first to the third points [rad], below a full turn.
    """

    centre: Points
    radius_vector: Points
    axis: Points
    via_angle: Float64[Tensor, " arcs"]
    angle: Float64[Tensor, " arcs"]

    @staticmethod
    def through_points(first: Points, second: Points, third: Points) -> "CircularArcs":
        """Construct arcs through points [m], which must not be collinear, see `is_straight`."""
        u, v = second - first, third - first
        normal = torch.linalg.cross(u, v)
        # The circumcentre of the triangle 0, u, v.
        squares = (a.square().sum(-1, keepdim=True) for a in (u, v, normal))
        u_square, v_square, normal_square = squares
        middle = torch.linalg.cross(u_square * v - v_square * u, normal) / (2 * normal_square)
        axis = normal / normal_square.sqrt()
        passing, angle = (_angle(-middle, way - middle, axis) for way in (u, v))
        return CircularArcs(first + middle, -middle, axis, passing, angle)

    def sample(self, steps: int) -> Float64[Tensor, "arcs points 3"]:
        """Return equidistant points along the arcs, from the first to the third points [m]."""
        angles = torch.linspace(0, 1, steps + 1, dtype=torch.float64) * self.angle[:, None]
        turned = (
            rotation_from_vector(angles[..., None] * self.axis[:, None])
            @ self.radius_vector[:, None, :, None]
        )
        return self.centre[:, None] + turned[..., 0]


def is_straight(first: Points, second: Points, third: Points) -> bool:
    """Return whether three points of any arc are collinear, or two of them coincide."""
    u, v = second - first, third - first
    bends = torch.linalg.cross(u, v).norm(dim=-1) > _STRAIGHT * u.norm(dim=-1) * v.norm(dim=-1)
    return not bool(bends.all())


def _angle(start: Points, end: Points, axis: Points) -> Float64[Tensor, " arcs"]:
    """Return the angle about an axis from one direction to another, 0 to 2 pi [rad]."""
    sine = (axis * torch.linalg.cross(start, end)).sum(-1)
    return torch.atan2(sine, (start * end).sum(-1)) % (2 * math.pi)
