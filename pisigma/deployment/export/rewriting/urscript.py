"""Poses of URScript programs: `p[x, y, z, rx, ry, rz]` in metres and rotation vectors."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch

from pisigma.deployment.export.programs.text import format_number, format_numbers, metres_and_rotation_vector
from pisigma.deployment.export.rewriting.control_flow import ActiveFrames, Step
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.known_routines import URSCRIPT
from pisigma.deployment.export.rewriting.scan import (
    COMPUTED,
    IDENTITY,
    NUMBER,
    Edit,
    Frame,
    NamedPoses,
    Pose,
    Scan,
    ScannedProgram,
    argument_spans,
    mask_comments,
    numbers_in,
    waypoint_groups,
)
from pisigma.robot.se3 import rotation_from_vector, transform

_HIDDEN = re.compile(r'#[^\n]*|"[^"\n]*"')
_LITERAL = re.compile(rf"p\[\s*{NUMBER}(?:\s*,\s*{NUMBER}){{5}}\s*\]")
_ASSIGNMENT = re.compile(r"(?m)^[ \t]*(?:global\s+|local\s+)?(\w+)\s*=(?!=)\s*")
_STATEMENT = re.compile(
    r"^[ \t]*(?:def|thread)[ \t]+(?P<routine>\w+)"
    r"|(?P<flow>^[ \t]*(?:while|if|elif|else|for|end|return|break|continue|halt)\b)"
    r"|(?P<call>\b(?P<name>\w+)\s*\()",
    re.MULTILINE,
)
_MOVES = ("movej", "movel", "movep", "movec", "servoj", "servoc")
_TOOL = "the tool"
_TURNING = re.compile(r"mode\s*=\s*(?!0$)")
_Span = tuple[int, int]

_BLEND = 1e-3
"""Blend radius at waypoints [m], which is reduced if they are close together."""


def scan_urscript(text: str, frame_file: FrameFile) -> ScannedProgram:
    """Scan a program; poses are relative to the base, or to the frame of a `pose_trans`.

    Args:
        text: text of the program.
        frame_file: frames that the program does not state; their tool `tcp` applies until a `set_tcp` with numbers.
    """
    return _Reader(Scan(text), mask_comments(text, _HIDDEN), frame_file).read()


@dataclass
class _Reader:
    """Reader of the statements of a program."""

    scan: Scan
    text: str
    stated: FrameFile
    frames: ActiveFrames = field(init=False)

    def __post_init__(self) -> None:
        self.names = NamedPoses(self.text, _ASSIGNMENT, str)

    def read(self) -> ScannedProgram:
        for match in _ASSIGNMENT.finditer(self.text):
            literal = _LITERAL.match(self.text, match.end())
            if literal and self.names.is_set_once(match[1]):
                self.names.add(match[1], _pose(self.text, literal.span()))
        statements = list(_STATEMENT.finditer(self.text))
        self.frames = ActiveFrames(
            [self._step(match) for match in statements], {_TOOL: self.stated.tool("tcp")}
        )
        for place, match in enumerate(statements):
            tool: Frame | str = f"{_TOOL} is computed"
            if match["routine"] or match["flow"]:
                self.scan.mark_unknown_start()
            elif match["name"] in _MOVES:
                self._move(match)
            elif literal := _LITERAL.match(self.text, match.end()):
                tool = _pose(self.text, literal.span()).T
            self.frames.advance_past(place, tool)
        return self.scan.program(self.names)

    def _step(self, match: re.Match[str]) -> Step:
        """Convert a statement to steps of control flow."""
        step = _step(match)
        is_harmless = step.name in URSCRIPT or self.stated.sets_no_frame(step.name)
        return Step("other") if step.kind == "call" and is_harmless else step

    def _move(self, call: re.Match[str]) -> None:
        spans = list(argument_spans(self.text, call.end()))
        circular = call["name"] in ("movec", "servoc")
        operands = []
        for span in spans[: 2 if circular else 1]:
            if self.text[span[0]] == "[":
                self.scan.add_joint_move(call.start())
                continue
            pose, frame, operand = self._target(span)
            operands.append(operand)
            cut = None
            if call["name"] in ("movel", "movep") or len(operands) == 2:
                cut = self._cut(call, spans, operands, pose)
            self.scan.add_move(
                call.start(), pose, frame, self.frames[_TOOL], cut, circular=len(operands) == 2
            )

    def _cut(
        self, call: re.Match[str], spans: Sequence[_Span], operands: Sequence[_Span], pose: Pose | str
    ) -> Callable[[Sequence[Frame]], list[Edit]] | None:
        """Return the function that inserts waypoints, or None if that is not possible."""
        rest = [self.text[slice(*span)] for span in spans[len(operands) :]]
        if isinstance(pose, str) or call["name"] == "servoc":
            return None
        if any(re.match(r"t\s*=", argument) for argument in rest):
            self.scan.leave_unchanged(call.start(), "the move has a time, so it has no waypoints")
            return None
        if sum("=" not in argument for argument in rest) > 2 or any(map(_TURNING.match, rest)):
            self.scan.leave_unchanged(
                call.start(), "an unnamed radius or a mode is stated, so the move has no waypoints"
            )
            return None
        return partial(self._waypoints, call, spans, operands, rest, pose)

    def _target(self, span: _Span) -> tuple[Pose | str, Frame | str, _Span]:
        """Return the pose of an argument, its frame, and its span."""
        expression = self.text[slice(*span)]
        if function := re.match(r"(get_inverse_kin|pose_trans)\s*\(", expression):
            inner = list(argument_spans(self.text, span[0] + function.end()))
            if len(inner) < (1 if function[1] == "get_inverse_kin" else 2):
                return COMPUTED, IDENTITY, span
            if function[1] == "get_inverse_kin":
                return self._target(inner[0])
            frame = self._constant(inner[0], target=False)
            pose, _, operand = self._target(inner[1])
            return pose, frame.T if frame else "the frame is computed", operand
        return self._constant(span, target=True) or COMPUTED, IDENTITY, span

    def _constant(self, span: _Span, target: bool) -> Pose | None:
        expression = self.text[slice(*span)]
        if _LITERAL.fullmatch(expression):
            return _pose(self.text, span)
        return self.names.get(expression, target)

    def _waypoints(
        self,
        call: re.Match[str],
        spans: Sequence[_Span],
        operands: Sequence[_Span],
        rest: Sequence[str],
        pose: Pose,
        poses: Sequence[Frame],
    ) -> list[Edit]:
        """Insert a copy of the move for every waypoint before the move, with a small blend radius."""
        start, count = self.scan.line_start(call.start()), len(operands)
        ends = torch.stack([*poses[count - 1 :: count], pose.T])[:, :3, 3]
        nearest = float((ends[1:] - ends[:-1]).norm(dim=-1).min())
        radius = f"r={format_number(min(_BLEND, nearest / 4), 6)}"
        named = [index for index, argument in enumerate(rest) if re.match(r"r\s*=", argument)]
        rest = [radius if index in named else argument for index, argument in enumerate(rest)]
        rest += [] if named else [radius]
        head, lines = self.text[start : spans[0][0]], []
        for group in waypoint_groups(poses, count):
            targets = [
                self.text[span[0] : operand[0]] + pose.write(T) + self.text[operand[1] : span[1]]
                for span, operand, T in zip(spans, operands, group, strict=False)
            ]
            lines.append(f"{head}{', '.join([*targets, *rest])}){self.scan.line_end}")
        passed = [Edit(operands[0], pose.write(poses[-1]))] if count == 2 else []
        return [Edit((start, start), "".join(lines)), *passed]


def _step(match: re.Match[str]) -> Step:
    """Convert a statement to steps of control flow."""
    word = (match["flow"] or "").strip()
    if match["routine"]:
        return Step("routine", match["routine"])
    if match["name"]:
        return Step("set", _TOOL) if match["name"] == "set_tcp" else Step("call", match["name"])
    if word in ("while", "for"):
        return Step("loop")
    kinds: dict[str, Step] = {
        "if": Step("branch"),
        "elif": Step("else"),
        "else": Step("else"),
        "end": Step("end"),
    }
    return kinds.get(word, Step("other"))


def _pose(text: str, span: _Span) -> Pose:
    values = torch.tensor(numbers_in(text[slice(*span)]), dtype=torch.float64)
    return Pose(span, transform(rotation_from_vector(values[3:]), values[:3]), _written)


def _written(T: Frame) -> str:
    return f"p[{format_numbers(metres_and_rotation_vector(T), 9)}]"
