"""Poses of RAPID modules: robtargets in millimetres and quaternions (w, x, y, z)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import torch

from pisigma.export.programs.text import millimetres, numbers, quaternion
from pisigma.export.rewriting.frame_file import FrameFile
from pisigma.export.rewriting.scan import (
    COMPUTED,
    IDENTITY,
    NUMBER,
    Edit,
    Frame,
    NamedPoses,
    Pose,
    Scan,
    ScannedProgram,
    arguments,
    groups_of,
    masked,
    numbers_in,
)
from pisigma.se3 import rotation_from_quaternion, transform

_HIDDEN = re.compile(r'![^\n]*|"[^"\n]*"')


def _list(count: int) -> str:
    return rf"\[\s*{NUMBER}(?:\s*,\s*{NUMBER}){{{count - 1}}}\s*\]"


_PLACEMENT = rf"{_list(3)}\s*,\s*{_list(4)}"
_TARGET = re.compile(rf"\[\s*({_PLACEMENT})\s*,\s*{_list(4)}\s*,\s*{_list(6)}\s*\]")
_TOOL = re.compile(rf"\[\s*TRUE\s*,\s*\[\s*({_PLACEMENT})\s*\]", re.IGNORECASE)
_WOBJ = re.compile(
    rf"\[\s*FALSE\s*,\s*TRUE\s*,\s*(?:\"\")?\s*,\s*\[\s*({_PLACEMENT})\s*\]\s*,\s*\[\s*({_PLACEMENT})\s*\]",
    re.IGNORECASE,
)
_DATA = re.compile(
    r"(?im)^[ \t]*(?:LOCAL\s+|TASK\s+)?(?:CONST|PERS|VAR)\s+(robtarget|tooldata|wobjdata)\s+(\w+)\s*:=\s*"
)
_TURNING = re.compile(r"(?i)\bCirPathMode\b")
_DISPLACED = re.compile(r"(?i)\bPDisp(?:On|Set)\b")
_SET = re.compile(r"\b(\w+)(?:\.\w+)*\s*:=")
_FLOW = (
    "PROC|ENDPROC|FUNC|ENDFUNC|TRAP|ENDTRAP|IF|ELSEIF|ELSE|ENDIF|FOR|ENDFOR|WHILE|ENDWHILE|TEST|CASE|DEFAULT|ENDTEST|"
    "GOTO|RETURN|ERROR"
)
_STATEMENT = re.compile(
    rf"(?P<flow>^[ \t]*(?:LOCAL\s+)?(?:{_FLOW}|\w+:(?!=))(?=\W|$))"
    r"|\b(?P<move>MoveAbsJ|Move[JLC](?:DO|AO|GO|Sync)?|Trigg[JLC]|Search[LC])\b",
    re.MULTILINE | re.IGNORECASE,
)


def scan_rapid(text: str, stated: FrameFile) -> ScannedProgram:
    """Read a module; tool and work object are those of each move.

    Args:
        text: of the module.
        stated: tools and work objects that are declared in other modules.
    """
    return _Reader(Scan(text), masked(text, _HIDDEN), stated).read()


@dataclass
class _Reader:
    """Walks through the statements of a module."""

    scan: Scan
    text: str
    stated: FrameFile
    frames: dict[str, Frame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = NamedPoses(self.text, _SET, str.upper)

    def read(self) -> ScannedProgram:
        self.frames = {"TOOL0": IDENTITY, "WOBJ0": IDENTITY}
        for match in _DATA.finditer(self.text):
            kind, name = match[1].lower(), match[2].upper()
            form = {"robtarget": _TARGET, "tooldata": _TOOL, "wobjdata": _WOBJ}[kind]
            literal = form.match(self.scan.text, match.end())  # where strings are not hidden
            if literal and self.names.is_set_once(name):
                if kind == "robtarget":
                    self.names.add(name, _pose(literal))
                else:
                    self.frames[name] = _product(literal)
        for match in _STATEMENT.finditer(self.text):
            if match["flow"]:
                self.scan.interrupt()
            elif match["move"].upper() == "MOVEABSJ":
                self.scan.joints(match.start())
            else:
                self._move(match)
        return self.scan.program(self.names)

    def _move(self, match: re.Match[str]) -> None:
        spans = [
            span for span in arguments(self.text, match.end()) if not self.text[slice(*span)].startswith("\\")
        ]
        kind = re.match(r"Move([JLC])", match["move"], re.IGNORECASE)
        count = 2 if kind and kind[1].upper() == "C" else 1
        if kind is None or len(spans) < count + 3:
            self.scan.move(match.start(), "the move is of a kind that is not understood", IDENTITY, IDENTITY)
            return
        frame, tool = self._frames(self.text[slice(*spans[count + 2])])
        if displaced := _DISPLACED.search(self.text):
            frame = f"{displaced[0]} displaces the poses of the module"
        timed = re.search(r"(?i)\\T\s*:=", self.text[slice(*spans[count])])
        for index, span in enumerate(spans[:count]):
            pose = self._target(re.split(r"\s*\\", self.text[slice(*span)])[0], span)
            circular, cut = index == 1, None
            if isinstance(pose, Pose) and (circular or kind[1].upper() == "L"):
                if timed:
                    self.scan.leave(match.start(), "the move has a time, so no way points are put in")
                elif circular and _TURNING.search(self.text):
                    self.scan.leave(match.start(), "the module states how the tool turns along arcs")
                else:
                    cut = partial(self._way_points, match, spans, count, pose)
            self.scan.move(match.start(), pose, frame, tool, cut, circular)

    def _target(self, expression: str, span: tuple[int, int]) -> Pose | str:
        if literal := _TARGET.match(self.text, span[0]):
            return _pose(literal)
        return self.names.get(expression) or COMPUTED

    def _frames(self, expression: str) -> tuple[Frame | str, Frame | str]:
        """Work object and tool of a move, from its last argument."""
        words = re.split(r"\s*\\\s*", expression)
        wobj = next(
            (word.split(":=")[1].strip() for word in words if re.match(r"(?i)WObj\s*:=", word)), "wobj0"
        )
        frame, tool = self.frames.get(wobj.upper()), self.frames.get(words[0].upper())
        return (
            self.stated.frame(wobj) if frame is None else frame,
            self.stated.tool(words[0]) if tool is None else tool,
        )

    def _way_points(
        self,
        move: re.Match[str],
        spans: Sequence[tuple[int, int]],
        count: int,
        pose: Pose,
        poses: Sequence[Frame],
    ) -> list[Edit]:
        """The move again before itself, once a way point, past which the tool flies."""
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
            for group in groups_of(poses, count)
        )
        passed = [Edit(spans[0], f"[{pose.write(poses[-1])}{rest}")] if count == 2 else []
        return [Edit((start, start), "".join(lines)), *passed]


def _frame(text: str) -> Frame:
    values = torch.tensor(numbers_in(text), dtype=torch.float64)
    return transform(rotation_from_quaternion(values[[4, 5, 6, 3]]), values[:3] / 1e3)


def _pose(literal: re.Match[str]) -> Pose:
    return Pose(literal.span(1), _frame(literal[1]), _written)


def _product(literal: re.Match[str]) -> Frame:
    """The frames of tooldata or wobjdata, one in the other."""
    T = IDENTITY
    for frame in literal.groups():
        T = T @ _frame(frame)
    return T


def _written(T: Frame) -> str:
    return f"[{numbers(millimetres(T))}], [{numbers(quaternion(T), 9)}]"
