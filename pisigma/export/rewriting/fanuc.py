"""Poses of FANUC TP programs in ASCII: positions `P[n]` in millimetres and degrees."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count

import torch

from pisigma.export.programs.text import labelled, millimetres_and_euler
from pisigma.export.rewriting.frame_file import FrameFile
from pisigma.export.rewriting.scan import (
    IDENTITY,
    NUMBER,
    Edit,
    Frame,
    Pose,
    Scan,
    ScannedProgram,
    numbers_in,
)
from pisigma.se3 import transform_from_xyzrpy

_LINE = re.compile(r"(?m)^(?P<head>[ \t]*\d+:)(?P<body>(?:[^;\n]|\r?\n[ \t]*:)*)(?P<end>;[^\n]*\n)")
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
_FLOW = re.compile(r"[ \t]*(LBL|JMP|IF|ELSE|ENDIF|FOR|ENDFOR|SELECT|CALL|RUN|END|ABORT)\b")
_MODIFIED = re.compile(r"\b(Offset|Tool_Offset|INC|VOFFSET|TOOL_OFFSET|Skip|OFFSET)\b")


def scan_fanuc(text: str, stated: FrameFile) -> ScannedProgram:
    """Read a program; a position is of its `UT` in its `UF`, of which 0 are the flange and the world.

    Args:
        text: of the program.
        stated: frames and tools by number, as `UFRAME 1` and `UTOOL 1`.
    """
    return _Reader(Scan(text), text, stated).read()


@dataclass
class _Reader:
    """Walks through the lines of a program."""

    scan: Scan
    text: str
    stated: FrameFile
    positions: dict[str, re.Match[str]] = field(default_factory=dict)
    numbers: "count[int]" = field(default_factory=count)

    def read(self) -> ScannedProgram:
        self.positions = {found["number"]: found for found in _POSITION.finditer(self.text)}
        self.numbers = count(1 + max(map(int, self.positions), default=0))
        computed: set[str] = set()
        for line in _LINE.finditer(self.text):
            body = re.sub(r"!.*", "", line["body"])
            if _FLOW.match(body):
                self.scan.interrupt()
            if move := _MOVE.match(body):
                self._move(line, move)
            else:
                computed |= set(re.findall(r"\bP\[(\d+)", body))
        for number in computed & set(self.positions):
            if isinstance(pose := self._pose(number), Pose):
                self.scan.blur(pose)
        return self.scan.program(_numbered)

    def _move(self, line: re.Match[str], move: re.Match[str]) -> None:
        names = [move["target"], *re.findall(r":\s*(P\[[^\]]*\])", move["rest"])]
        for name in names:
            number = re.match(r"P\[(\d+)", name)
            found = self.positions.get(number[1]) if number else None
            if found is not None and re.search(r"\bJ1\s*=", found["body"]):
                self.scan.joints(line.start())
                continue
            pose: Pose | str = "the target is a register or not stated in this file"
            frame: Frame | str = ""
            tool: Frame | str = ""
            if number and found is not None:
                pose = self._pose(number[1])
                frame = IDENTITY if found["uf"] == "0" else self.stated.frame(f"UFRAME {found['uf']}")
                tool = IDENTITY if found["ut"] == "0" else self.stated.tool(f"UTOOL {found['ut']}")
                if modified := _MODIFIED.search(move["rest"]):
                    if isinstance(pose, Pose):
                        self.scan.blur(pose)
                    pose = f"{modified[0]} moves the target"
            linear = move["kind"] == "L" and isinstance(pose, Pose)
            cut = partial(self._way_points, line, move, found) if linear and found else None
            self.scan.move(line.start(), pose, frame, tool, cut)

    def _pose(self, number: str) -> Pose | str:
        found = self.positions[number]
        values = _VALUES.match(self.text, found.start("body"))
        if values is None or "GP2" in found["body"]:
            return f"the values of P[{number}] are not understood"
        six = torch.tensor(numbers_in(re.sub(r"[A-Za-z=]", " ", values["six"])), dtype=torch.float64)
        x, y, z, w, p, r = torch.cat([six[:3] / 1e3, torch.deg2rad(six[3:])])
        T = transform_from_xyzrpy(torch.stack([x, y, z, r, p, w]))
        return Pose(values.span("six"), T, _written)

    def _way_points(
        self, line: re.Match[str], move: re.Match[str], found: re.Match[str], poses: Sequence[Frame]
    ) -> list[Edit]:
        """Lines and positions of way points, with the speed of the move and continuous termination."""
        line_end = "\r\n" if "\r\n" in self.text else "\n"
        speed = re.match(r"\s*(\S+)", move["rest"])
        lines, positions = [], []
        span = _VALUES.match(self.text, found.start("body"))
        assert span is not None
        for T in poses:
            number = next(self.numbers)
            lines.append(f"   1:L P[{number}] {speed[1] if speed else ''} CNT100 ;{line_end}")
            head = re.sub(r"^P\[[^\]]*\]", f"P[{number}]", self.text[found.start() : span.start("six")])
            positions.append(f"{head}{_written(T)}{self.text[span.end('six') : found.end()]}")
        end = self.text.rindex("/END")
        return [Edit((line.start(),) * 2, "".join(lines)), Edit((end, end), "".join(positions))]


def _written(T: Frame) -> str:
    x, y, z, r, p, w = millimetres_and_euler(T).tolist()
    lengths = labelled([x, y, z], ["X =", "Y =", "Z ="], " mm")
    return f"{lengths},\n\t{labelled([w, p, r], ['W =', 'P =', 'R ='], ' deg')}"


def _numbered(text: str) -> str:
    """Lines numbered again from 1, and their count in the head."""
    numbers = count(1)

    def numbered(line: re.Match[str]) -> str:
        return f"{next(numbers):4d}:{line['body']}{line['end']}"

    main, positions, rest = text.partition("/POS")
    begin, mark, body = main.partition("/MN")
    body = _LINE.sub(numbered, body)
    begin = re.sub(r"LINE_COUNT(\s*)=(\s*)\d+", rf"LINE_COUNT\1=\g<2>{next(numbers) - 1}", begin)
    return "".join([begin, mark, body, positions, rest])
