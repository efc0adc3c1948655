"""Poses of FANUC TP programs in ASCII: positions `P[n]` in millimetres and degrees."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count

import torch

from pisigma.deployment.export.programs.text import DIGITS, format_number, millimetres_and_euler
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.scan import (
    COMPUTED,
    IDENTITY,
    NUMBER,
    Edit,
    Frame,
    Pose,
    Scan,
    ScannedProgram,
    axes_in_use,
    external_axes_reason,
    waypoint_groups,
)
from pisigma.robot.se3 import transform_from_xyz_zyx

_LINE = re.compile(r"(?m)^(?P<head>[ \t]*\d+:)(?P<body>(?:[^;\r\n]|\r?\n[ \t]*:)*)(?P<end>;[^\n]*\n)")
_MOVE = re.compile(r"[ \t]*(?P<kind>[JLCA])[ \t]+(?P<target>(?:P|PR)\[[^\]]*\])(?P<rest>[\s\S]*)")
_POSITION = re.compile(
    r"(?m)^P\[(?P<number>\d+)[^\]]*\]\s*\{\s*GP1:\s*UF\s*:\s*(?P<uf>\w+)\s*,\s*UT\s*:\s*(?P<ut>\w+)\s*,(?P<body>[^}]*)\};?[^\n]*\n"
)
_SIX = r"\s*,\s*".join(
    rf"{letter}\s*=\s*{NUMBER}\s*{unit}"
    for letters, unit in (("XYZ", "mm"), ("WPR", "deg"))
    for letter in letters
)
_VALUES = re.compile(rf"(?P<config>\s*CONFIG\s*:\s*'[^']*'\s*,\s*)(?P<six>{_SIX})")
_EXTERNAL = re.compile(r"\b(E[1-6])\s*=\s*([^\s,}]+)")
_VALUE = re.compile(rf"(=\s*)({NUMBER})")
_FLOW = re.compile(r"[ \t]*(LBL|JMP|IF|ELSE|ENDIF|FOR|ENDFOR|SELECT|CALL|RUN|END|ABORT)\b")
_CALL = re.compile(r"\b(?:CALL|RUN)[ \t]+(\w+)")
_AGAIN = re.compile(r"\b(?:LBL|JMP|FOR)\b")
_REDEFINED = re.compile(r"\b(UFRAME|UTOOL)\[(\d+)?[^\]]*\]+(?:\.\w+)?\s*=|\$MN(UFRAME|UTOOL)\[")
_MODIFIED = re.compile(r"\b(Offset|Tool_Offset|INC|VOFFSET|TOOL_OFFSET|Skip|OFFSET|COORD|RTCP)\b")


def scan_fanuc(text: str, frame_file: FrameFile) -> ScannedProgram:
    """Scan a program; a position is that of tool `UT` (0 is the flange) in frame `UF` (0 is the world).

    Args:
        text: text of the program.
        frame_file: frames and tools by number, as `UFRAME 1` and `UTOOL 1`.
    """
    return _Reader(Scan(text), text, frame_file).read()


@dataclass
class _Reader:
    """Reader of the lines of a program."""

    scan: Scan
    text: str
    stated: FrameFile
    positions: dict[str, re.Match[str]] = field(default_factory=dict)
    numbers: Iterator[int] = field(default_factory=count)
    redefined: list[re.Match[str]] = field(default_factory=list)
    axes_in_use: dict[str, int] = field(default_factory=dict)
    call: re.Match[str] | None = None
    """First call of a routine in another file; `uncertain` is the position after which frames are uncertain."""
    uncertain: float = math.inf

    def read(self) -> ScannedProgram:
        self.positions = {match["number"]: match for match in _POSITION.finditer(self.text)}
        for position in self.positions.values():
            for name in axes_in_use(dict(_EXTERNAL.findall(position["body"]))):
                self.axes_in_use.setdefault(name, self.scan.line_number(position.start()))
        self.numbers = count(1 + max(map(int, self.positions), default=0))
        lines = [(line.start(), re.sub(r"!.*", "", line["body"])) for line in _LINE.finditer(self.text)]
        self.redefined = [match for _, body in lines for match in _REDEFINED.finditer(body)]
        for start, body in lines:
            for match in _CALL.finditer(body):
                if self.call is None and not self.stated.sets_no_frame(match[1]):
                    self.call, self.uncertain = match, start
        if self.call and any(_AGAIN.search(body) for _, body in lines):
            self.uncertain = 0
        computed: set[str] = set()
        for line in _LINE.finditer(self.text):
            body = re.sub(r"!.*", "", line["body"])
            if _FLOW.match(body):
                self.scan.mark_unknown_start()
            if move := _MOVE.match(body):
                self._move(line, move)
            else:
                computed |= set(re.findall(r"\bP\[(\d+)", body))
        for name in computed & set(self.positions):
            if isinstance(pose := self._pose(name), Pose):
                self.scan.mark_not_understood(pose)
        return self.scan.program(finish=_numbered)

    def _move(self, line: re.Match[str], move: re.Match[str]) -> None:
        names = [move["target"], *re.findall(r":\s*(P\[[^\]]*\])", move["rest"])]
        for order, name in enumerate(names):
            index = re.match(r"P\[(\d+)", name)
            match = self.positions.get(index[1]) if index else None
            if match is not None and re.search(r"\bJ1\s*=", match["body"]):
                self.scan.add_joint_move(line.start())
                continue
            pose: Pose | str = COMPUTED
            frame: Frame | str = ""
            tool: Frame | str = ""
            if index and match is not None:
                pose = self._pose(index[1])
                frame = IDENTITY if match["uf"] == "0" else self._stated("UFRAME", match["uf"], line.start())
                tool = IDENTITY if match["ut"] == "0" else self._stated("UTOOL", match["ut"], line.start())
                if modified := _MODIFIED.search(move["rest"]):
                    if isinstance(pose, Pose):
                        self.scan.mark_not_understood(pose)
                    pose = f"{modified[0]} moves the target"
            circular = move["kind"] == "C" and order == 1
            cuttable = isinstance(pose, Pose) and (circular or move["kind"] == "L")
            if move["kind"] == "A":
                self.scan.leave_unchanged(
                    line.start(), "arcs of A have no waypoints, only their poses are corrected"
                )
            cut = partial(self._waypoints, line, move, match, len(names)) if cuttable and match else None
            self.scan.add_move(line.start(), pose, frame, tool, cut, circular)

    def _stated(self, kind: str, index: str, position: int) -> Frame | str:
        """Return a stated frame or tool, unless the program or a called routine may set it."""
        if any(kind in (match[1], match[3]) and match[2] in (None, index) for match in self.redefined):
            return f"the program sets {kind} {index}"
        name = f"{kind} {index}"
        if self.call and position > self.uncertain:
            return f"{name} may be set by the routine {self.call[1]} in another file"
        return self.stated.frame(name) if kind == "UFRAME" else self.stated.tool(name)

    def _pose(self, name: str) -> Pose | str:
        match = self.positions[name]
        values = _VALUES.match(self.text, match.start("body"))
        if values is None or "GP2" in match["body"]:
            return f"the values of P[{name}] cannot be read"
        if used := external_axes_reason(dict(_EXTERNAL.findall(match["body"])), self.axes_in_use):
            return f"{used} (P[{name}], line {self.scan.line_number(match.start())})"
        six = torch.tensor([float(match[2]) for match in _VALUE.finditer(values["six"])], dtype=torch.float64)
        x, y, z, w, p, r = torch.cat([six[:3] / 1e3, torch.deg2rad(six[3:])])
        T = transform_from_xyz_zyx(torch.stack([x, y, z, r, p, w]))
        return Pose(values.span("six"), T, partial(_written, values["six"]))

    def _waypoints(
        self,
        line: re.Match[str],
        move: re.Match[str],
        match: re.Match[str],
        count: int,
        poses: Sequence[Frame],
    ) -> list[Edit]:
        """Return lines and positions of waypoints, with the speed of the move and continuous termination."""
        speed = re.match(r"(?:\s*:\s*P\[[^\]]*\])?\s*(\S+)", move["rest"])
        span = _VALUES.match(self.text, match.start("body"))
        assert span is not None
        names, positions = [], []
        for T in poses:
            names.append(f"P[{next(self.numbers)}]")
            head = re.sub(r"^P\[[^\]]*\]", names[-1], self.text[match.start() : span.start("six")])
            positions.append(f"{head}{_written(span['six'], T)}{self.text[span.end('six') : match.end()]}")
        letter, between = ("L", "") if count == 1 else ("C", f"{self.scan.line_end}    :  ")
        lines = (
            f"   1:{letter} {between.join(group)} {speed[1] if speed else ''} CNT100 ;{self.scan.line_end}"
            for group in waypoint_groups(names, count)
        )
        end, target = self.text.rindex("/END"), line.start("body") + move.start("target")
        passed = [Edit((target, target + len(move["target"])), names[-1])] if count == 2 else []
        return [Edit((line.start(),) * 2, "".join(lines)), Edit((end, end), "".join(positions)), *passed]


def _written(text: str, T: Frame) -> str:
    """Return the text of a position with the values of a pose."""
    x, y, z, r, p, w = millimetres_and_euler(T).tolist()
    values = iter([x, y, z, w, p, r])
    return _VALUE.sub(lambda match: match[1] + format_number(next(values), DIGITS), text)


def _numbered(text: str) -> str:
    """Renumber the lines from 1, and update the number of lines in the header."""
    numbers = count(1)

    def numbered(line: re.Match[str]) -> str:
        return f"{next(numbers):4d}:{line['body']}{line['end']}"

    main, positions, rest = text.partition("/POS")
    begin, mark, body = main.partition("/MN")
    body = _LINE.sub(numbered, body)
    begin = re.sub(r"LINE_COUNT(\s*)=(\s*)\d+", rf"LINE_COUNT\1=\g<2>{next(numbers) - 1}", begin)
    return "".join([begin, mark, body, positions, rest])
