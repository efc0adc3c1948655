"""What is understood of a program: poses in its text, the frame and tool they are of, and the moves to them."""

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
    """A pose that stands in a text.

    Attributes:
        span: where its numbers stand.
        T: the pose, of the tool in the frame [m].
        write: gives the text of another pose in the same form.
    """

    span: tuple[int, int]
    T: Frame
    write: Callable[[Frame], str]


@dataclass(frozen=True)
class Edit:
    """Text to put in place of a stretch of a program; an empty stretch is a place to insert at."""

    span: tuple[int, int]
    text: str


@dataclass(frozen=True, eq=False)
class Target:
    """A pose that the robot is sent to.

    Attributes:
        line: of the pose.
        pose: the pose.
        T_root_frame: the frame it is given in, seen from the origin of the robot description.
        T_flange_tool: the tool, seen from the last row of the robot description.
    """

    line: int
    pose: Pose
    T_root_frame: Frame
    T_flange_tool: Frame


@dataclass(frozen=True, eq=False)
class PathMove:
    """A straight move to a target, or an arc through another one.

    Attributes:
        line: of the move.
        start: the target before; None where the program does not say where the move begins.
        via: the target that an arc passes; None for a straight move, or where the program does not state it.
        end: where it leads.
        circular: whether it is an arc.
        way_points: gives the edits that make it go by poses of the end's tool in the end's frame. Those of an arc
            become arcs too: by turns a pose that one passes and the pose where it ends, and at last the one that the
            move itself passes then.
    """

    line: int
    start: Target | None
    via: Target | None
    end: Target
    circular: bool
    way_points: Callable[[Sequence[Frame]], list[Edit]]


@dataclass(frozen=True, eq=False)
class ScannedProgram:
    """A program as far as it is understood.

    Attributes:
        text: of the program.
        targets: those whose frame and tool are known, in the order of the text.
        moves: the straight ones and the arcs among the moves to them.
        left: line and reason of whatever is left alone.
        joint_lines: lines of moves to joint values, which stay.
        finish: what is done to the text after the edits, such as numbering its lines.
    """

    text: str
    targets: tuple[Target, ...]
    moves: tuple[PathMove, ...]
    left: tuple[tuple[int, str], ...]
    joint_lines: tuple[int, ...]
    finish: Callable[[str], str] = lambda text: text


class NamedPoses:
    """Poses that a program sets once, by their names, and whether moves are all that uses them."""

    def __init__(self, text: str, assignment: re.Pattern[str], fold: Callable[[str], str]) -> None:
        """Count the names of a text.

        Args:
            text: masked.
            assignment: matches whatever sets a name, which is its first group.
            fold: how the language writes a name alike, such as `str.upper`.
        """
        self._fold = fold
        self._words = Counter(fold(word) for word in re.findall(r"\w+", text))
        self._set = Counter(fold(match[1]) for match in assignment.finditer(text))
        self._uses: Counter[str] = Counter()
        self._poses: dict[str, Pose] = {}
        self._reasons: dict[str, str] = {}

    def is_set_once(self, name: str) -> bool:
        """Whether one statement sets the name."""
        return self._set[self._fold(name)] == 1

    def add(self, name: str, pose: Pose | str) -> None:
        """A pose that is set once, or why it is left alone."""
        if isinstance(pose, str):
            self._reasons[self._fold(name)] = pose
        else:
            self._poses[self._fold(name)] = pose

    def target(self, name: str) -> Pose | str:
        """The pose of a name as the target of a move, or why it is not known."""
        return self.get(name) or self._reasons.get(self._fold(name), COMPUTED)

    def get(self, name: str, target: bool = True) -> Pose | None:
        """The pose of a name; as the target of a move, or as a frame."""
        pose = self._poses.get(self._fold(name))
        self._uses[self._fold(name)] += target and pose is not None
        return pose

    def used_otherwise(self) -> list[Pose]:
        """Poses whose names stand elsewhere than where they are set and in moves to them."""
        return [pose for name, pose in self._poses.items() if self._words[name] - 1 > self._uses[name]]


class Scan:
    """Collects what a reader of a language understands, move after move in the order of the text."""

    def __init__(self, text: str) -> None:
        """Begin with the text of a program."""
        self.text = text
        self.line_end = "\r\n" if "\r\n" in text else "\n"
        self._breaks = [match.start() for match in re.finditer("\n", text)]
        self._targets: dict[tuple[int, int], Target] = {}
        self._unclear: set[tuple[int, int]] = set()
        self._moves: list[PathMove] = []
        self._left: dict[int, str] = {}
        self._joint_lines: list[int] = []
        self._last_two: tuple[Target | None, Target | None] = (None, None)

    def line(self, position: int) -> int:
        """The line of a place in the text, from 1."""
        return bisect.bisect_left(self._breaks, position) + 1

    def line_start(self, position: int) -> int:
        """Where the line of a place begins."""
        return self.text.rfind("\n", 0, position) + 1

    def leave(self, position: int, reason: str) -> None:
        """Name what is left alone; the first reason of a line counts."""
        self._left.setdefault(self.line(position), reason)

    def interrupt(self) -> None:
        """What follows may be reached from elsewhere: the next move begins nobody knows where."""
        self._last_two = (None, None)

    def joints(self, position: int) -> None:
        """A move to joint values, which stays."""
        self._joint_lines.append(self.line(position))
        self._last_two = (None, None)

    def blur(self, pose: Pose) -> None:
        """A pose is used in ways that are not understood, so it stays."""
        self._unclear.add(pose.span)

    def move(
        self,
        position: int,
        pose: Pose | str,
        frame: Frame | str,
        tool: Frame | str,
        way_points: Callable[[Sequence[Frame]], list[Edit]] | None = None,
        circular: bool = False,
    ) -> None:
        """A move to a pose.

        Args:
            position: where the move stands.
            pose: the pose, or why it is not understood; likewise `frame` and `tool`.
            frame: that the pose is given in, seen from the origin of the robot description.
            tool: that is brought there, seen from the last row of the robot description.
            way_points: of a straight move or an arc, see `PathMove`.
            circular: whether it is the end of an arc, whose other target came before.
        """
        start, via = self._last_two if circular else (self._last_two[1], None)
        self._last_two = (self._last_two[1], None)
        for part in (pose, frame, tool):
            if isinstance(part, str):
                self.leave(position, part)
                if isinstance(pose, Pose):
                    self.blur(pose)
                return
        assert isinstance(pose, Pose)
        assert isinstance(frame, Tensor)
        assert isinstance(tool, Tensor)
        target = Target(self.line(pose.span[0]), pose, frame, tool)
        same = self._targets.setdefault(pose.span, target)
        if not (torch.equal(same.T_root_frame, frame) and torch.equal(same.T_flange_tool, tool)):
            self.leave(position, "the pose is used with several frames or tools")
            self.blur(pose)
            return
        if way_points is not None:
            self._moves.append(PathMove(self.line(position), start, via, target, circular, way_points))
        self._last_two = (self._last_two[0], target)

    def program(
        self, names: NamedPoses | None = None, finish: Callable[[str], str] = lambda text: text
    ) -> ScannedProgram:
        """What was collected, without poses that are used in ways that are not understood."""
        for pose in names.used_otherwise() if names else ():
            self.blur(pose)
        for span, target in self._targets.items():
            if span in self._unclear:
                self._left.setdefault(target.line, "the pose is also used in a way that is not understood")
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


def masked(text: str, hidden: re.Pattern[str]) -> str:
    """The text with blanks in place of comments and strings, so that every place stays where it is."""
    return hidden.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)


def arguments(text: str, start: int) -> Iterator[tuple[int, int]]:
    """Spans of what stands between commas at one level of brackets, from `start` to the bracket that ends it.

    Args:
        text: masked.
        start: behind the opening bracket, or where a list without brackets begins.
    """
    depth, begin = 0, start
    for position in range(start, len(text)):
        letter = text[position]
        if letter in "([{":
            depth += 1
        elif letter in ")]}" or (letter == ";" and depth == 0):
            depth -= 1
            if depth < 0 or letter == ";":
                yield _stripped(text, begin, position)
                return
        elif letter == "," and depth == 0:
            yield _stripped(text, begin, position)
            begin = position + 1


def _stripped(text: str, start: int, end: int) -> tuple[int, int]:
    inside = text[start:end]
    return start + len(inside) - len(inside.lstrip()), end - len(inside) + len(inside.rstrip())


def groups_of(poses: Sequence[_Item], count: int) -> list[Sequence[_Item]]:
    """The way points, or their names, of every move that is put in: one each, or two for arcs; see `PathMove`."""
    return [poses[first : first + count] for first in range(0, len(poses) - count + 1, count)]


def axes_in_use(values: Mapping[str, str]) -> dict[str, str]:
    """The external axes that stand elsewhere than at 0, or nobody knows where.

    Args:
        values: texts by name of the axis; 9E9 says that there is none, or that it stays where it is.
    """
    return {name: text for name, text in values.items() if not _is_zero(text) and not _is_absent(text)}


def external_axes(values: Mapping[str, str], in_use: Mapping[str, int]) -> str:
    """Why a pose with values of external axes is left alone; "" where none of them is in use.

    The robot description has no external axes: it is the robot as it stands where all of them are 0. A pose that does
    not state one leaves it where the program has moved it before.

    Args:
        values: texts by name of the axis, see `axes_in_use`.
        in_use: line in which the program moves each of them.
    """
    if used := axes_in_use(values):
        names = ", ".join(f"{name} = {_plain(text)}" for name, text in used.items())
        return f"the external axes {names} move robot or workpiece, and are not drawn"
    open_axes = [name for name in in_use if name not in values or _is_absent(values[name])]
    if not open_axes:
        return ""
    names = ", ".join(f"{name} (in use in line {in_use[name]})" for name in open_axes)
    return f"the external axes {names} may stand elsewhere than at 0, as the pose does not state them"


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
    """All numbers of a stretch of text."""
    return [float(number) for number in re.findall(NUMBER, text)]
