"""Poses of KRL programs: `{X .., Y .., Z .., A .., B .., C ..}` in millimetres and degrees."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch

from pisigma.deployment.export.programs.text import format_labelled, millimetres_and_euler
from pisigma.deployment.export.rewriting.control_flow import ActiveFrames, Step
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.known_routines import KRL
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
    axes_in_use,
    external_axes_reason,
    mask_comments,
    numbers_in,
    waypoint_groups,
)
from pisigma.robot.se3 import transform_from_xyz_zyx

_HIDDEN = re.compile(r';[^\n]*|"[^"\n]*"')
_SIX = r"\s*,\s*".join(rf"{letter}\s*{NUMBER}" for letter in "XYZABC")
_AGGREGATE = re.compile(rf"\{{\s*(?:(?:FRAME|E?\d?POS)\s*:\s*)?({_SIX})\s*((?:,[^{{}}]*)?)\}}", re.IGNORECASE)
_EXTERNAL = re.compile(r"(?:[{,]\s*|\.)(E[1-6])\s*[\s=]\s*([^,}\n]+)", re.IGNORECASE)
"""External axis in an aggregate or as the component of a variable."""
_WITH = re.compile(r"\$(BASE|TOOL)\b[^=\n]*=", re.IGNORECASE)
_ASSIGNMENT = re.compile(
    r"(?im)^[ \t]*(?:DECL\s+|GLOBAL\s+)*(?:(?:E6|E3)?POS\s+|FRAME\s+)?(\w+)\s*=\s*(?=\{)"
)
_SET = re.compile(r"(?im)^[^\n=]*?\b(\w+)(?:\.\w+)*\s*=(?!=)")
_AXES = re.compile(r"\{\s*(?:(?:AXIS|E6AXIS)\s*:|A1\b)", re.IGNORECASE)
_NAME = re.compile(r"\w+(?![\w.:\[])")
_STATEMENT = re.compile(
    r"^[ \t]*(?:"
    r"(?:GLOBAL[ \t]+)?DEF(?:FCT[ \t]+\w+)?[ \t]+(?P<routine>\w+)"
    r"|(?P<flow>ENDFCT|END|IF|ELSE|ENDIF|FOR|ENDFOR|WHILE|ENDWHILE|LOOP|ENDLOOP|REPEAT|UNTIL|SWITCH|CASE|DEFAULT|"
    r"ENDSWITCH|GOTO|INTERRUPT|RETURN|\w+:)(?=\W|$)"
    r"|\$(?P<system>BASE|TOOL)(?P<part>\.\w+)?\s*=\s*(?P<value>[^\n]*?)[ \t\r]*$"
    r"|BAS\s*\(\s*#(?P<bas>BASE|TOOL)\s*,\s*(?P<number>[^)\n]*?)\s*\)"
    r"|(?P<form>FDAT_ACT)\s*="
    r"|(?P<move>S?(?:PTP|LIN|CIRC)|SPL)(?P<relative>_REL)?\s+(?P<target>[^\n]*?)[ \t\r]*$)"
    r"|\b(?P<call>\w+)[ \t]*\(",
    re.MULTILINE | re.IGNORECASE,
)
_TURNING = re.compile(r"\$(?:CIRC_TYPE|ORI_TYPE)\b", re.IGNORECASE)
_FIXED_TOOL = re.compile(r"(?:\$IPO_MODE\s*=\s*|IPO_FRAME\s+)#TCP\b", re.IGNORECASE)
_LOOPS = ("FOR", "WHILE", "LOOP", "REPEAT")
_FRAMES_OF_MOVES = ("$BASE", "$TOOL")


FIXED_TOOL = "the tool is fixed and the workpiece moves"
STATED_ARC = "the angle of the arc or its orientation is stated, so it has no waypoints"


def scan_krl(text: str, frame_file: FrameFile) -> ScannedProgram:
    """Scan a program in KRL; its poses of `$TOOL` in `$BASE` are known after the program has set both.

    Args:
        text: text of the program.
        frame_file: frames that the program names but does not state, such as `BASE_DATA[1]` and `TOOL_DATA[2]`.
    """
    return _Reader(Scan(text), mask_comments(text, _HIDDEN), frame_file).read()


_POINT = re.compile(r"(?im)^[ \t]*(?:DECL\s+|GLOBAL\s+)+E?\d?POS\s+X(\w+)\s*=\s*(?=\{)")
_FRAMES = re.compile(
    r"(?im)^[ \t]*(?:DECL\s+|GLOBAL\s+)+FDAT\s+F(\w+)\s*=\s*\{\s*TOOL_NO\s+(\d+)\s*,\s*BASE_NO\s+(\d+)\s*,"
    r"\s*IPO_FRAME\s+#(\w+)"
)


def scan_krl_data(text: str, frame_file: FrameFile) -> ScannedProgram:
    """Scan a data list (`.dat`) for points of inline forms, whose frame and tool are in the `FDAT` of the same name.

    The moves are in the program that belongs to the list, so they get no waypoints.

    Args:
        text: text of the data list.
        frame_file: `BASE_DATA[n]` and `TOOL_DATA[n]`; number 0 is the origin and the flange.
    """
    scan, visible = Scan(text), mask_comments(text, _HIDDEN)
    frames = {match[1].upper(): match for match in _FRAMES.finditer(visible)}
    in_use = _axes_in_use(scan, visible)
    for match in _POINT.finditer(visible):
        literal, data = _AGGREGATE.match(visible, match.end()), frames.get(match[1].upper())
        if data is None or literal is None or data[4].upper() != "BASE":
            reason = f"no FDAT F{match[1]} with IPO_FRAME #BASE states the frame and the tool of the point"
            scan.add_move(match.start(), reason, IDENTITY, IDENTITY)
            continue
        tool = IDENTITY if data[2] == "0" else frame_file.tool(f"TOOL_DATA[{data[2]}]")
        frame = IDENTITY if data[3] == "0" else frame_file.frame(f"BASE_DATA[{data[3]}]")
        scan.add_move(match.start(), _target_pose(literal, in_use), frame, tool)
    return scan.program()


@dataclass
class _Reader:
    """Reader of the statements of a program."""

    scan: Scan
    text: str
    stated: FrameFile
    frames: ActiveFrames = field(init=False)
    axes_in_use: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.names = NamedPoses(self.text, _SET, str.upper)
        self.axes_in_use = _axes_in_use(self.scan, self.text)

    def read(self) -> ScannedProgram:
        for match in _ASSIGNMENT.finditer(self.text):
            literal = _AGGREGATE.match(self.text, match.end())
            if literal and self.names.is_set_once(match[1]):
                pose = _target_pose(literal, self.axes_in_use)
                where = f" (line {self.scan.line_number(match.start())})"
                self.names.add(match[1], pose if isinstance(pose, Pose) else pose + where)
        steps = [(match, step) for match in _STATEMENT.finditer(self.text) for step in self._steps(match)]
        unknown = FIXED_TOOL if _FIXED_TOOL.search(self.text) else ""
        self.frames = ActiveFrames(
            [step for _, step in steps],
            {name: unknown or f"{name} is not stated before the move" for name in _FRAMES_OF_MOVES},
        )
        for place, (match, step) in enumerate(steps):
            if match["flow"] or step.kind == "routine":
                self.scan.mark_unknown_start()
            if match["move"]:
                self._move(match)
            self.frames.advance_past(place, unknown or self._value(match, step))
        return self.scan.program(self.names)

    def _steps(self, match: re.Match[str]) -> list[Step]:
        """Convert a statement to steps of control flow."""
        return [
            Step("other")
            if step.kind == "call" and (step.name in KRL or self.stated.sets_no_frame(step.name))
            else step
            for step in _steps(match)
        ]

    def _value(self, match: re.Match[str], step: Step) -> Frame | str:
        """Return the frame or tool that a statement sets, or the reason why it is unknown."""
        if match["form"]:
            return f"{step.name} is that of FDAT_ACT"
        look_up = self.stated.frame if step.name == "$BASE" else self.stated.tool
        if match["bas"]:
            return look_up(f"{step.name[1:]}_DATA[{match['number']}]")
        value = match["value"] or ""
        if match["part"]:
            return f"a part of {step.name} is set"
        if literal := _AGGREGATE.fullmatch(value):
            return _pose(literal).T
        return IDENTITY if value.upper() == "$NULLFRAME" else look_up(value)

    def _move(self, match: re.Match[str]) -> None:
        start, kind = match.start("target"), match["move"].upper()
        spans = [(start + begin, start + end) for begin, end in argument_spans(match["target"] + ";", 0)]
        operands = []
        for begin, _ in spans[: 2 if kind.endswith("CIRC") else 1]:
            if _AXES.match(self.text, begin):
                self.scan.add_joint_move(match.start())
                continue
            pose = self._target(begin) if not match["relative"] else COMPUTED
            operands.append(begin)
            circular, cut = len(operands) == 2, None
            if isinstance(pose, Pose) and (circular or kind.endswith("LIN")):
                if circular and (len(spans) > 2 or _TURNING.search(self.text)):
                    self.scan.leave_unchanged(match.start(), STATED_ARC)
                else:
                    cut = partial(self._waypoints, match, operands)
            self.scan.add_move(match.start(), pose, *self._frames(match["target"]), cut, circular)

    def _frames(self, target: str) -> tuple[Frame | str, Frame | str]:
        """Return the frame and tool of a move, which may be stated after WITH."""
        own = {f"${match[1].upper()}" for match in _WITH.finditer(target)}
        base, tool = (
            f"the move states {name}" if name in own else self.frames[name] for name in _FRAMES_OF_MOVES
        )
        return base, tool

    def _target(self, start: int) -> Pose | str:
        if literal := _AGGREGATE.match(self.text, start):
            return _target_pose(literal, self.axes_in_use)
        name = _NAME.match(self.text, start)
        return self.names.target(name[0]) if name else COMPUTED

    def _waypoints(self, move: re.Match[str], operands: Sequence[int], poses: Sequence[Frame]) -> list[Edit]:
        """Return straight moves or arcs to all waypoints, with approximate positioning."""
        start = self.scan.line_start(move.start())
        word = self.text[start : operands[0]]
        smooth = "" if re.match(r"\s*S(LIN|CIRC)", word, re.IGNORECASE) else " C_DIS"
        lines = (
            f"{word}{', '.join(f'{{{_six(T)}}}' for T in group)}{smooth}{self.scan.line_end}"
            for group in waypoint_groups(poses, len(operands))
        )
        edits = [Edit((start, start), "".join(lines))]
        if len(operands) == 2:
            passed = _AGGREGATE.match(self.text, operands[0]) or _NAME.match(self.text, operands[0])
            assert passed is not None
            edits.append(Edit(passed.span(), f"{{{_six(poses[-1])}}}"))
        return edits


def _steps(match: re.Match[str]) -> list[Step]:
    """Convert a statement to steps of control flow."""
    word = (match["flow"] or "").upper()
    if name := match["system"] or match["bas"]:
        return [Step("set", f"${name.upper()}")]
    if match["form"]:
        return [Step("set", name) for name in _FRAMES_OF_MOVES]
    if match["routine"]:
        return [Step("routine", match["routine"].upper())]
    if match["call"]:
        return [Step("call", match["call"].upper())]
    if word in _LOOPS:
        return [Step("loop")]
    if word in ("IF", "SWITCH"):
        return [Step("branch")]
    if word in ("ELSE", "CASE", "DEFAULT"):
        return [Step("else")]
    if word.startswith("END") or word == "UNTIL":
        return [Step("end")]
    return [Step("jump" if word == "GOTO" or word.endswith(":") else "other")]


def _axes_in_use(scan: Scan, visible: str) -> dict[str, int]:
    """Return the first line in which a text moves each external axis, by name."""
    lines: dict[str, int] = {}
    for match in _EXTERNAL.finditer(visible):
        for name in axes_in_use({match[1].upper(): match[2].strip()}):
            lines.setdefault(name, scan.line_number(match.start()))
    return lines


def _target_pose(literal: re.Match[str], in_use: Mapping[str, int]) -> Pose | str:
    """Return the pose of a target, or the reason why external axes leave it unchanged."""
    values = {match[1].upper(): match[2].strip() for match in _EXTERNAL.finditer(literal[2])}
    return external_axes_reason(values, in_use) or _pose(literal)


def _pose(literal: re.Match[str]) -> Pose:
    values = torch.tensor(numbers_in(re.sub(r"[A-Ca-cX-Zx-z]", " ", literal[1])), dtype=torch.float64)
    xyz_zyx = torch.cat([values[:3] / 1e3, torch.deg2rad(values[3:])])
    return Pose(literal.span(1), transform_from_xyz_zyx(xyz_zyx), _six)


def _six(T: Frame) -> str:
    return format_labelled(millimetres_and_euler(T).tolist(), "XYZABC")
