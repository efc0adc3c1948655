"""Poses of RAPID modules: robtargets in millimetres and quaternions (w, x, y, z)."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import torch

from pisigma.deployment.export.programs.text import format_numbers, position_in_mm, quaternion
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.known_routines import RAPID
from pisigma.deployment.export.rewriting.scan import (
    IDENTITY,
    NUMBER,
    Edit,
    Frame,
    NamedPoses,
    Pose,
    Scan,
    ScannedProgram,
    argument_spans,
    axes_in_use,
    external_axes_reason,
    mask_comments,
    numbers_in,
    waypoint_groups,
)
from pisigma.measurement.foreign.rotations import ORTHONORMALITY_TOLERANCE
from pisigma.robot.se3 import rotation_from_quaternion, transform

_Read = TypeVar("_Read", Pose, Frame)

_HIDDEN = re.compile(r'![^\n]*|"[^"\n]*"')


def _list(count: int) -> str:
    return rf"\[\s*{NUMBER}(?:\s*,\s*{NUMBER}){{{count - 1}}}\s*\]"


_PLACEMENT = rf"{_list(3)}\s*,\s*{_list(4)}"
_TARGET = re.compile(rf"\[\s*({_PLACEMENT})\s*,\s*{_list(4)}\s*,\s*({_list(6)})\s*\]")
_EXTERNAL = re.compile(rf"\]\s*,\s*({_list(6)})\s*\]")
"""External axes of robtargets and jointtargets."""
_AXES = ("eax_a", "eax_b", "eax_c", "eax_d", "eax_e", "eax_f")
_TOOL = re.compile(rf"\[\s*TRUE\s*,\s*\[\s*({_PLACEMENT})\s*\]", re.IGNORECASE)
_WOBJ = re.compile(
    rf"\[\s*FALSE\s*,\s*TRUE\s*,\s*(?:\"\")?\s*,\s*\[\s*({_PLACEMENT})\s*\]\s*,\s*\[\s*({_PLACEMENT})\s*\]",
    re.IGNORECASE,
)
_DATA = re.compile(
    r"(?im)^[ \t]*(?:LOCAL\s+|TASK\s+)?(?:CONST|PERS|VAR)\s+(robtarget|tooldata|wobjdata)\s+(\w+)\s*:=\s*"
)
_TURNING = re.compile(r"(?i)\bCirPathMode\b")
_DISPLACED = re.compile(r"(?i)\b(?:PDisp|EOffs)(?:On|Set)\b")
_SET = re.compile(r"\b(\w+)(?:\.\w+)*\s*:=")
_ROUTINE = re.compile(r"(?im)^[ \t]*(?:LOCAL\s+)?(?:PROC|TRAP)\s+(\w+)")
_RECORD = re.compile(
    r"^[ \t]*(?:LOCAL\s+)?RECORD\b(?:(?!^[ \t]*(?:LOCAL\s+)?RECORD\b).){0,4000}?\bENDRECORD\b",
    re.IGNORECASE | re.MULTILINE | re.DOTALL,
)
_CALL = re.compile(
    r"(?i)(?:;|\b(?:THEN|ELSE|DO|END(?:IF|FOR|WHILE|TEST|PROC|FUNC|TRAP)|ERROR|UNDO)(?=\s)|\b(?:CASE\b[^:;\n]{0,400}|DEFAULT\s*):"
    r"|\b(?:PROC|TRAP|MODULE)\s+\w+[ \t]*(?:\([^)]{0,2000}\))?|^[ \t]*\w+:(?!=))\s*"
    r"(?=(?P<name>[A-Za-z]\w*|%)(?:\s*;|[ \t]+[^\s:=;.{]|\\|(?<=%)))",
    re.MULTILINE,
)
"""Pattern of a call, or of a word that starts a statement."""
_FLOW = (
    "PROC|ENDPROC|FUNC|ENDFUNC|TRAP|ENDTRAP|IF|ELSEIF|ELSE|ENDIF|FOR|ENDFOR|WHILE|ENDWHILE|TEST|CASE|DEFAULT|ENDTEST|"
    "GOTO|RETURN|ERROR"
)
_STATEMENT = re.compile(
    rf"(?P<flow>^[ \t]*(?:LOCAL\s+)?(?:{_FLOW}|\w+:(?!=))(?=\W|$))"
    r"|\b(?P<move>MoveAbsJ|Move[JLC](?:DO|AO|GO|Sync)?|Trigg[JLC]|Search[LC])\b",
    re.MULTILINE | re.IGNORECASE,
)


def scan_rapid(text: str, frame_file: FrameFile) -> ScannedProgram:
    """Scan a module in RAPID; every move states tool and work object.

    Args:
        text: text of the module.
        frame_file: tools and work objects that are declared in other modules.
    """
    return _Reader(Scan(text), mask_comments(text, _HIDDEN), frame_file).read()


@dataclass
class _Reader:
    """Reader of the statements of a module."""

    scan: Scan
    text: str
    stated: FrameFile
    frames: dict[str, Frame | str] = field(default_factory=dict)
    axes_in_use: dict[str, int] = field(default_factory=dict)
    foreign: str = ""
    """Reason why no frame and no tool is certain; "" if there is none."""

    def __post_init__(self) -> None:
        self.names = NamedPoses(self.text, _SET, str.upper)
        for match in _EXTERNAL.finditer(self.text):
            for name in axes_in_use(_axes(match[1])):
                self.axes_in_use.setdefault(name, self.scan.line_number(match.start(1)))

    def read(self) -> ScannedProgram:
        self.foreign = self._foreign()
        self.frames = {"TOOL0": IDENTITY, "WOBJ0": IDENTITY}
        for match in _DATA.finditer(self.text):
            kind, name = match[1].lower(), match[2].upper()
            form = {"robtarget": _TARGET, "tooldata": _TOOL, "wobjdata": _WOBJ}[kind]
            literal = form.match(self.scan.text, match.end())  # where strings are not hidden
            if literal and self.names.is_set_once(name):
                if kind == "robtarget":
                    self.names.add(name, self._placed(_target_pose(literal, self.axes_in_use), match))
                else:
                    self.frames[name] = self._placed(_product(literal), match)
        for match in _STATEMENT.finditer(self.text):
            if match["flow"]:
                self.scan.mark_unknown_start()
            elif match["move"].upper() == "MOVEABSJ":
                self.scan.add_joint_move(match.start())
            else:
                self._move(match)
        return self.scan.program(self.names)

    def _foreign(self) -> str:
        """Return the reason why a call of another module's routine makes frames and tools uncertain; "" without one.

        The data persist and a module may run again, so the position of the call does not matter.
        """
        own = {match[1].upper() for match in _ROUTINE.finditer(self.text)}
        for match in _CALL.finditer(mask_comments(self.text, _RECORD)):
            name = match["name"].upper()
            is_move = _STATEMENT.match(self.text, match.start("name"))
            if name in own | RAPID or is_move or self.stated.sets_no_frame(name):
                continue
            called = (
                "a routine that is named at run time"
                if name == "%"
                else f"the routine {match['name']} in another file"
            )
            return f"tool and work object may be set by {called} (line {self.scan.line_number(match.start('name'))})"
        return ""

    def _placed(self, read: _Read | str, match: re.Match[str]) -> _Read | str:
        """Return the value of a declaration, or the reason, with its line, why there is none."""
        return f"{read} (line {self.scan.line_number(match.start())})" if isinstance(read, str) else read

    def _move(self, match: re.Match[str]) -> None:
        spans = [
            span
            for span in argument_spans(self.text, match.end())
            if not self.text[slice(*span)].startswith("\\")
        ]
        kind = re.match(r"Move([JLC])", match["move"], re.IGNORECASE)
        count = 2 if kind and kind[1].upper() == "C" else 1
        if kind is None or len(spans) < count + 3:
            self.scan.add_move(match.start(), "this kind of move is not supported", IDENTITY, IDENTITY)
            return
        frame, tool = self._frames(self.text[slice(*spans[count + 2])])
        if displaced := _DISPLACED.search(self.text):
            frame = f"{displaced[0]} displaces the poses of the module"
        elif self.foreign:
            frame = self.foreign
        timed = re.search(r"(?i)\\T\s*:=", self.text[slice(*spans[count])])
        for index, span in enumerate(spans[:count]):
            pose = self._target(re.split(r"\s*\\", self.text[slice(*span)])[0], span)
            circular, cut = index == 1, None
            if isinstance(pose, Pose) and (circular or kind[1].upper() == "L"):
                if timed:
                    self.scan.leave_unchanged(
                        match.start(), "the move states its duration, so no waypoints are added"
                    )
                elif circular and _TURNING.search(self.text):
                    self.scan.leave_unchanged(
                        match.start(),
                        "the module states the orientation along arcs, so they have no waypoints",
                    )
                else:
                    cut = partial(self._waypoints, match, spans, count, pose)
            self.scan.add_move(match.start(), pose, frame, tool, cut, circular)

    def _target(self, expression: str, span: tuple[int, int]) -> Pose | str:
        if literal := _TARGET.match(self.text, span[0]):
            return _target_pose(literal, self.axes_in_use)
        return self.names.target(expression)

    def _frames(self, expression: str) -> tuple[Frame | str, Frame | str]:
        """Return work object and tool of a move from its last argument."""
        words = re.split(r"\s*\\\s*", expression)
        wobj = next(
            (word.split(":=")[1].strip() for word in words if re.match(r"(?i)WObj\s*:=", word)), "wobj0"
        )
        frame, tool = self.frames.get(wobj.upper()), self.frames.get(words[0].upper())
        return (
            self.stated.frame(wobj) if frame is None else frame,
            self.stated.tool(words[0]) if tool is None else tool,
        )

    def _waypoints(
        self,
        move: re.Match[str],
        spans: Sequence[tuple[int, int]],
        count: int,
        pose: Pose,
        poses: Sequence[Frame],
    ) -> list[Edit]:
        """Insert a copy of the move for every waypoint before the move, as fly-by points."""
        start = self.scan.line_start(move.start())
        text, (begin, end) = self.scan.text, pose.span
        literal = _TARGET.search(text, text.rfind("[", 0, begin))
        assert literal is not None
        rest = text[end : literal.end()]
        speed, last = text[slice(*spans[count])], text[slice(*spans[count + 2])]
        indent = re.match(r"[ \t]*", text[start:])
        word = f"{indent[0] if indent else ''}Move{'L' if count == 1 else 'C'}"
        lines = (
            f"{word} {', '.join(f'[{pose.write(T)}{rest}' for T in group)}, {speed}, z1, {last};{self.scan.line_end}"
            for group in waypoint_groups(poses, count)
        )
        passed = [Edit(spans[0], f"[{pose.write(poses[-1])}{rest}")] if count == 2 else []
        return [Edit((start, start), "".join(lines)), *passed]


def _frame(text: str) -> Frame:
    values = torch.tensor(numbers_in(text), dtype=torch.float64)
    return transform(rotation_from_quaternion(values[[4, 5, 6, 3]]), values[:3] / 1e3)


def _pose(literal: re.Match[str]) -> Pose:
    return Pose(literal.span(1), _frame(literal[1]), _written)


def _axes(text: str) -> dict[str, str]:
    """Return the values of external axes in a list of all six, as strings."""
    return dict(zip(_AXES, (value.strip() for value in text.strip("[]").split(",")), strict=True))


def _target_pose(literal: re.Match[str], in_use: Mapping[str, int]) -> Pose | str:
    """Return the pose of a robtarget, or the reason why it is left unchanged."""
    return external_axes_reason(_axes(literal[2]), in_use) or _not_normalised(literal[1]) or _pose(literal)


def _product(literal: re.Match[str]) -> Frame | str:
    """Multiply the frames of tooldata or wobjdata, or return the reason why they are invalid."""
    T = IDENTITY
    for frame in literal.groups():
        if fault := _not_normalised(frame):
            return fault
        T = T @ _frame(frame)
    return T


def _not_normalised(text: str) -> str:
    """Return the reason why position and quaternion do not form a frame; "" if they do."""
    quaternion = numbers_in(text)[3:]
    norm = math.hypot(*quaternion)
    if abs(norm - 1) <= ORTHONORMALITY_TOLERANCE:
        return ""
    written = ", ".join(f"{value:g}" for value in quaternion)
    return f"expected a quaternion of norm 1, got [{written}] with norm {norm:g}"


def _written(T: Frame) -> str:
    return f"[{format_numbers(position_in_mm(T))}], [{format_numbers(quaternion(T), 9)}]"
