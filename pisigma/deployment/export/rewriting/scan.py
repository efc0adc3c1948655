"""Poses in the text of a program, their frames and tools, and the moves to these poses."""

import bisect
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float64
from torch import Tensor

Frame = Float64[Tensor, "4 4"]
_Item = TypeVar("_Item")

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NO_AXIS = 8.9e9
COMPUTED = "the target is computed or not stated in this file"
IDENTITY = torch.eye(4, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Pose:
    """A pose in a text.

    Attributes:
        span: span of the numbers of the pose.
        T: pose of the tool in the frame [m].
        write: function that formats another pose in the same way.
    """

    span: tuple[int, int]
    T: Frame
    write: Callable[[Frame], str]


@dataclass(frozen=True)
class Edit:
    """Replacement of a span of a program; an empty span is an insertion."""

    span: tuple[int, int]
    text: str


@dataclass(frozen=True, eq=False)
class Target:
    """A pose to which the robot moves.

    Attributes:
        line: line of the pose.
        pose: the pose.
        T_root_frame: frame of the pose, relative to the origin of the robot description.
        T_flange_tool: frame of the tool, relative to the last row of the robot description.
    """

    line: int
    pose: Pose
    T_root_frame: Frame
    T_flange_tool: Frame


@dataclass(frozen=True, eq=False)
class PathMove:
    """Straight move to a target, or arc to a target through another.

    Attributes:
        line: line of the move.
        start: previous target; None if the program does not determine it.
        via: via point of an arc; None for a straight move, or if the program does not state it.
        end: target of the move.
        circular: whether the move is an arc.
        waypoints: function that returns the edits for waypoints, which are poses of the end's tool in the end's
            frame. An arc is split into arcs: the poses alternate between via and end points, and the last one is the
            new via point of the move itself.
    """

    line: int
    start: Target | None
    via: Target | None
    end: Target
    circular: bool
    waypoints: Callable[[Sequence[Frame]], list[Edit]]


@dataclass(frozen=True, eq=False)
class ScannedProgram:
    """The parts of a program that are understood.

    Attributes:
        text: text of the program.
        targets: targets whose frame and tool are known, in the order of the text.
        moves: straight moves and arcs to these targets.
        unchanged_lines: line of every target that is not changed, and the reason.
        joint_lines: lines of moves to joint values, which are not changed.
        finish: function that is applied to the text after the edits, for example to number its lines.
    """

    text: str
    targets: tuple[Target, ...]
    moves: tuple[PathMove, ...]
    unchanged_lines: tuple[tuple[int, str], ...]
    joint_lines: tuple[int, ...]
    finish: Callable[[str], str] = lambda text: text


class NamedPoses:
    """Named poses that a program sets once, and whether they are used only in moves."""

    def __init__(self, text: str, assignment: re.Pattern[str], fold: Callable[[str], str]) -> None:
        """Count the names of a text.

        Args:
            text: text with comments and strings masked.
            assignment: pattern of statements that set a name, which is its first group.
            fold: normalisation of names in the language, for example `str.upper`.
        """
        self._fold = fold
        self._words = Counter(fold(word) for word in re.findall(r"\w+", text))
        self._set = Counter(fold(match[1]) for match in assignment.finditer(text))
        self._uses: Counter[str] = Counter()
        self._poses: dict[str, Pose] = {}
        self._reasons: dict[str, str] = {}

    def is_set_once(self, name: str) -> bool:
        """Return whether exactly one statement sets a name."""
        return self._set[self._fold(name)] == 1

    def add(self, name: str, pose: Pose | str) -> None:
        """Add a pose that is set once, or the reason why it is left unchanged."""
        if isinstance(pose, str):
            self._reasons[self._fold(name)] = pose
        else:
            self._poses[self._fold(name)] = pose

    def target(self, name: str) -> Pose | str:
        """Return the pose of a name as the target of a move, or the reason why it is unknown."""
        return self.get(name) or self._reasons.get(self._fold(name), COMPUTED)

    def get(self, name: str, is_target: bool = True) -> Pose | None:
        """Return the pose of a name, as the target of a move or as a frame."""
        pose = self._poses.get(self._fold(name))
        self._uses[self._fold(name)] += is_target and pose is not None
        return pose

    def poses_used_elsewhere(self) -> list[Pose]:
        """Return poses whose names also occur outside their assignment and moves to them."""
        return [pose for name, pose in self._poses.items() if self._words[name] - 1 > self._uses[name]]


class Scan:
    """Collector of the moves that a reader of a language finds, in the order of the text."""

    def __init__(self, text: str) -> None:
        """Start with the text of a program."""
        self.text = text
        self.line_end = "\r\n" if "\r\n" in text else "\n"
        self._breaks = [match.start() for match in re.finditer("\n", text)]
        self._targets: dict[tuple[int, int], Target] = {}
        self._unclear: set[tuple[int, int]] = set()
        self._moves: list[PathMove] = []
        self._left: dict[int, str] = {}
        self._joint_lines: list[int] = []
        self._last_two: tuple[Target | None, Target | None] = (None, None)

    def line_number(self, position: int) -> int:
        """Return the line of a position in the text, from 1."""
        return bisect.bisect_left(self._breaks, position) + 1

    def line_start(self, position: int) -> int:
        """Return the start of the line of a position."""
        return self.text.rfind("\n", 0, position) + 1

    def leave_unchanged(self, position: int, reason: str) -> None:
        """Record the first reason why a line is not changed."""
        self._left.setdefault(self.line_number(position), reason)

    def mark_unknown_start(self) -> None:
        """Record that the next statement may be reached from elsewhere, so the start of the next move is unknown."""
        self._last_two = (None, None)

    def add_joint_move(self, position: int) -> None:
        """Record a move to joint values, which is not changed."""
        self._joint_lines.append(self.line_number(position))
        self._last_two = (None, None)

    def mark_not_understood(self, pose: Pose) -> None:
        """Record that a pose is used in a way that is not understood, so it is not changed."""
        self._unclear.add(pose.span)

    def add_move(
        self,
        position: int,
        pose: Pose | str,
        frame: Frame | str,
        tool: Frame | str,
        waypoints: Callable[[Sequence[Frame]], list[Edit]] | None = None,
        circular: bool = False,
    ) -> None:
        """Record a move to a pose.

        Args:
            position: position of the move in the text.
            pose: the pose, or the reason why it is not understood; the same applies to `frame` and `tool`.
            frame: frame of the pose, relative to the origin of the robot description.
            tool: tool, relative to the last row of the robot description.
            waypoints: function for the waypoints of a straight move or an arc, see `PathMove`.
            circular: whether the pose is the end of an arc whose via point is the previous target.
        """
        start, via = self._last_two if circular else (self._last_two[1], None)
        self._last_two = (self._last_two[1], None)
        for part in (pose, frame, tool):
            if isinstance(part, str):
                self.leave_unchanged(position, part)
                if isinstance(pose, Pose):
                    self.mark_not_understood(pose)
                return
        assert isinstance(pose, Pose)
        assert isinstance(frame, Tensor)
        assert isinstance(tool, Tensor)
        target = Target(self.line_number(pose.span[0]), pose, frame, tool)
        same = self._targets.setdefault(pose.span, target)
        if not (torch.equal(same.T_root_frame, frame) and torch.equal(same.T_flange_tool, tool)):
            self.leave_unchanged(position, "the pose is used with several frames or tools")
            self.mark_not_understood(pose)
            return
        if waypoints is not None:
            self._moves.append(PathMove(self.line_number(position), start, via, target, circular, waypoints))
        self._last_two = (self._last_two[0], target)

    def program(
        self, named_poses: NamedPoses | None = None, finish: Callable[[str], str] = lambda text: text
    ) -> ScannedProgram:
        """Return the collected program, without poses that are used in ways that are not understood."""
        for pose in named_poses.poses_used_elsewhere() if named_poses else ():
            self.mark_not_understood(pose)
        for span, target in self._targets.items():
            if span in self._unclear:
                self._left.setdefault(target.line, "the pose is also used in a way that is not supported")
        kept = {span: target for span, target in self._targets.items() if span not in self._unclear}
        moves = [
            replace(move, start=_among(kept, move.start), via=_among(kept, move.via))
            for move in self._moves
            if _among(kept, move.end)
        ]
        targets = tuple(kept[span] for span in sorted(kept))
        left = tuple(sorted(self._left.items()))
        return ScannedProgram(self.text, targets, tuple(moves), left, tuple(self._joint_lines), finish)


def _among(kept: Mapping[tuple[int, int], Target], target: Target | None) -> Target | None:
    return None if target is None else kept.get(target.pose.span)


def mask_comments(text: str, comment_pattern: re.Pattern[str]) -> str:
    """Replace comments and strings by spaces, so that all positions are preserved."""
    return comment_pattern.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)


def argument_spans(text: str, start: int) -> Iterator[tuple[int, int]]:
    """Yield the spans between commas at one level of brackets, from `start` to the closing bracket.

    Args:
        text: text with comments and strings masked.
        start: position after the opening bracket, or the start of a list without brackets.
    """
    depth, begin = 0, start
    for position in range(start, len(text)):
        character = text[position]
        if character in "([{":
            depth += 1
        elif character in ")]}" or (character == ";" and depth == 0):
            depth -= 1
            if depth < 0 or character == ";":
                yield _stripped(text, begin, position)
                return
        elif character == "," and depth == 0:
            yield _stripped(text, begin, position)
            begin = position + 1


def _stripped(text: str, start: int, end: int) -> tuple[int, int]:
    inside = text[start:end]
    return start + len(inside) - len(inside.lstrip()), end - len(inside) + len(inside.rstrip())


def waypoint_groups(poses: Sequence[_Item], count: int) -> list[Sequence[_Item]]:
    """Return waypoints, or their names, grouped by inserted move: one per move, or two for arcs; see `PathMove`."""
    return [poses[first : first + count] for first in range(0, len(poses) - count + 1, count)]


def axes_in_use(values: Mapping[str, str]) -> dict[str, str]:
    """Return the external axes whose value is nonzero or unknown.

    Args:
        values: texts by name of the axis; 9E9 means that the axis does not exist or does not move.
    """
    return {name: text for name, text in values.items() if not _is_zero(text) and not _is_absent(text)}


def external_axes_reason(values: Mapping[str, str], in_use: Mapping[str, int]) -> str:
    """Return the reason why a pose with external axes is not changed; "" if no external axis is in use.

    The robot description has no external axes; it describes the robot with all of them at 0. A pose that does not state
    an axis leaves the axis where the program has moved it before.

    Args:
        values: texts by name of the axis, see `axes_in_use`.
        in_use: line in which the program moves each axis.
    """
    if used := axes_in_use(values):
        names = ", ".join(f"{name} = {_plain(text)}" for name, text in used.items())
        return f"the external axes {names} move robot or workpiece, and are not in the robot description"
    open_axes = [name for name in in_use if name not in values or _is_absent(values[name])]
    if not open_axes:
        return ""
    names = ", ".join(f"{name} (in use in line {in_use[name]})" for name in open_axes)
    return f"the external axes {names} may not be at 0, because the pose does not state them"


def _is_zero(text: str) -> bool:
    return _number(text) == 0


def _is_absent(text: str) -> bool:
    number = _number(text)
    return number is not None and abs(number) >= _NO_AXIS


def _number(text: str) -> float | None:
    return float(text) if re.fullmatch(NUMBER, text) else None


def _plain(text: str) -> str:
    number = _number(text)
    return text if number is None else f"{number:g}"


def numbers_in(text: str) -> list[float]:
    """Return all numbers in a text."""
    return [float(number) for number in re.findall(NUMBER, text)]
