"""A pose is of the frame and the tool that hold when the program comes to it, or it stays."""

import re

import pytest
import torch

from pisigma.export.rewriting.control_flow import FramesInForce, Step
from pisigma.export.rewriting.fanuc import scan_fanuc
from pisigma.export.rewriting.frame_file import FrameFile
from pisigma.export.rewriting.krl import scan_krl
from pisigma.export.rewriting.rapid import scan_rapid
from pisigma.export.rewriting.scan import IDENTITY
from pisigma.export.rewriting.urscript import scan_urscript

FIRST, SECOND = (f"$TOOL={{X 0, Y 0, Z {z}, A 0, B 0, C 0}}" for z in (100, 200))
LIN = "LIN {X 600, Y 0, Z 400, A 0, B 90, C 0}"
SET_FIRST, SET_SECOND = (f"set_tcp(p[0, 0, {z}, 0, 0, 0])" for z in (0.1, 0.2))
MOVE = "movel(p[0.6, 0, 0.4, 0, 1.57, 0])"


def krl(*lines: str) -> str:
    return "\n".join(["DEF main()", "$BASE=$NULLFRAME", *lines, "END", ""])


FRAMES = FrameFile.model_validate({"frames": {"UFRAME 1": {"x_mm": 800}}})


def fanuc(*lines: str) -> str:
    numbered = "".join(f"{number:4d}:{line} ;\n" for number, line in enumerate(lines, 1))
    return (
        f"/PROG CELL\n/MN\n{numbered}/POS\nP[1]{{\n   GP1:\n    UF : 1, UT : 0,     CONFIG : 'N U T, 0, 0, 0',\n"
        "    X = 600.0 mm, Y = 0.0 mm, Z = 400.0 mm,\n    W = 0.0 deg, P = 90.0 deg, R = 0.0 deg\n};\n/END\n"
    )


def kept(scan, text, frames=None):
    """Tools [m] of the poses that are understood, and the reasons for leaving the others."""
    program = scan(text, frames or FrameFile())
    assert len(program.targets) + len(program.left) == text.count("LIN {") + text.count("movel(")
    return [float(target.T_flange_tool[2, 3]) for target in program.targets], [why for _, why in program.left]


@pytest.mark.parametrize(
    ("lines", "tools", "reason"),
    [
        ((FIRST, "LOOP", LIN, "ENDLOOP"), [0.1], None),
        ((FIRST, LIN, SECOND, LIN), [0.1, 0.2], None),
        ((FIRST, "LOOP", LIN, SECOND, "ENDLOOP"), [], "which way"),
        ((FIRST, "LOOP", LIN, "IF $IN[1] THEN", SECOND, "ENDIF", "ENDLOOP"), [], "which way"),
        ((FIRST, "IF $IN[1] THEN", SECOND, "ENDIF", LIN), [], "which way"),
        ((FIRST, "IF $IN[1] THEN", SECOND, "ENDIF", FIRST, LIN), [0.1], None),
        ((FIRST, "LOOP", SECOND, LIN, FIRST, LIN, "ENDLOOP"), [0.2, 0.1], None),
        ((FIRST, "LOOP", SECOND, LIN, "ENDLOOP", LIN), [0.2], "which way"),
        ((FIRST, "IF $IN[1] THEN", SECOND, LIN, "ELSE", LIN, "ENDIF"), [0.2, 0.1], None),
        (
            (FIRST, "SWITCH I", "CASE 1", SECOND, LIN, "CASE 2", LIN, "ENDSWITCH", LIN),
            [0.2, 0.1],
            "which way",
        ),
        ((FIRST, "WHILE TRUE", "IF $IN[1] THEN", SECOND, "ENDIF", LIN, "ENDWHILE"), [], "which way"),
        ((FIRST, "again:", LIN, SECOND, "GOTO again"), [], "which way"),
        ((FIRST, "again:", LIN, "sub()", "GOTO again", "END", "DEF sub()", SECOND), [], "which way"),
        (("again:", FIRST, LIN, "GOTO again"), [0.1], None),
        ((FIRST, "sub()", LIN, "END", "DEF sub()", SECOND), [], "set by the routine SUB"),
        ((FIRST, "one()", LIN, "END", "DEF one()", "two()", "END", "DEF two()", SECOND), [], "routine ONE"),
        ((FIRST, "sub()", SECOND, "sub()", "END", "DEF sub()", LIN), [], "not stated"),
        (
            (FIRST, "done=sub()", LIN, "END", "DEFFCT BOOL sub()", SECOND, "ENDFCT"),
            [],
            "set by the routine SUB",
        ),
        ((FIRST, "IF sub() THEN", "ELSE", LIN, "ENDIF", "END", "DEFFCT BOOL sub()", SECOND), [], "which way"),
        ((FIRST, "grip()", LIN, "END", "DEF grip()", "$OUT[1]=TRUE"), [0.1], None),
        ((FIRST, "sub()", "END", "DEF sub()", LIN), [0.1], None),
        ((FIRST, "$TOOL.Z=200", LIN), [], "a part of"),
        ((FIRST, "BAS(#TOOL, number)", LIN), [], "TOOL_DATA.number.' is not stated"),
        ((FIRST, "FDAT_ACT=FP1", "BAS(#PTP_PARAMS, 100)", LIN), [], "FDAT_ACT"),
        ((FIRST, "$IPO_MODE=#TCP", LIN), [], "workpiece moves"),
    ],
)
def test_krl(lines, tools, reason):
    found, reasons = kept(scan_krl, krl(*lines))
    assert found == tools
    assert all(re.search(reason, why) for why in reasons)
    assert bool(reasons) == (reason is not None)


@pytest.mark.parametrize(
    ("lines", "tools", "reason"),
    [
        ((SET_FIRST, "while True:", MOVE, "end"), [0.1], None),
        ((SET_FIRST, MOVE, SET_SECOND, MOVE), [0.1, 0.2], None),
        ((SET_FIRST, "while True:", MOVE, SET_SECOND, "end"), [], "which way"),
        ((SET_FIRST, "while True:", SET_SECOND, MOVE, SET_FIRST, MOVE, "end"), [0.2, 0.1], None),
        (
            (SET_FIRST, "if x:", SET_SECOND, MOVE, "elif y:", MOVE, "else:", SET_SECOND, "end"),
            [0.2, 0.1],
            None,
        ),
        ((SET_FIRST, "if x:", SET_SECOND, "end", MOVE), [], "which way"),
        (("def sub():", SET_SECOND, "end", SET_FIRST, "sub()", MOVE), [], "set by the routine sub"),
        (("def sub():", SET_SECOND, "end", SET_FIRST, MOVE), [0.1], None),
        (("def sub():", SET_SECOND, "end", SET_FIRST, "if sub():", "else:", MOVE, "end"), [], "which way"),
        ((SET_FIRST, "def sub():", MOVE, "end", "sub()", SET_SECOND, "sub()"), [], "called from"),
        (("def sub():", SET_SECOND, "end", MOVE), [], "not stated"),
        ((SET_FIRST, "tool = get_tcp_offset()", "set_tcp(tool)", MOVE), [], "computed"),
    ],
)
def test_urscript(lines, tools, reason):
    found, reasons = kept(scan_urscript, "\n".join(["def cell():", *lines, "end", ""]))
    assert found == tools
    assert [why for why in reasons if reason not in why] == []
    assert bool(reasons) == (reason is not None)


def test_displaced_poses_of_a_module_stay():
    target = "[[600, 0, 400], [0.5, 0.5, 0.5, 0.5], [0, 0, 0, 0], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]]"
    text = f"MODULE cell\nPROC main()\n{{}}MoveL {target}, v100, fine, tool0;\nENDPROC\nENDMODULE\n"
    assert len(scan_rapid(text.format(""), FrameFile()).targets) == 1
    displaced = scan_rapid(text.format("PDispSet shift;\n"), FrameFile())
    assert not displaced.targets
    assert displaced.left == ((4, "PDispSet displaces the poses of the module"),)


@pytest.mark.parametrize(
    ("line", "understood"),
    [
        ("UFRAME[1]=PR[3]", False),
        ("UFRAME[R[2]]=PR[3]", False),
        ("UFRAME[2]=PR[3]", True),
        ("PR[3]=UFRAME[1]", True),
    ],
)
def test_a_frame_that_a_fanuc_program_sets_is_not_as_stated(line, understood):
    program = scan_fanuc(fanuc(f"  {line}", "L P[1] 100mm/sec FINE"), FRAMES)
    assert bool(program.targets) == understood
    assert understood or program.left == ((4, "the program sets UFRAME 1"),)


def test_values_outside_of_routines_hold_from_their_place_on():
    frames = FramesInForce([Step("set", "tool"), Step("loop"), Step("end"), Step("end")], {"tool": "unknown"})
    assert frames["tool"] == "unknown"
    frames.advance(0, IDENTITY)
    for number in (1, 2, 3):
        frames.advance(number)
        assert isinstance(frames["tool"], torch.Tensor)


def test_all_kinds_of_moves_are_seen():
    """Those of splines as well; straight ones of a process are straight."""
    pose = "{X 600, Y 0, Z 400, A 0, B 90, C 0}"
    words = ("SPTP", "PTP", "SPL", "SLIN", "LIN", "spl")
    program = scan_krl(krl(FIRST, *(f"{word} {pose}" for word in words)), FrameFile())
    assert [target.line for target in program.targets] == [4, 5, 6, 7, 8, 9]
    assert [move.line for move in program.moves] == [7, 8]
    arc = scan_krl(krl(FIRST, f"SCIRC {pose}, {pose}"), FrameFile())
    assert (len(arc.targets), [move.circular for move in arc.moves]) == (2, [True])
    moves = [MOVE.replace("movel", name) for name in ("movej", "movel", "movep", "servoj")]
    program = scan_urscript("\n".join(["def cell():", SET_FIRST, *moves, "end", ""]), FrameFile())
    assert len(program.targets) == 4
    assert [move.line for move in program.moves] == [4, 5]


def test_arcs_without_way_points_are_named():
    text = fanuc("A P[1] 100mm/sec CNT50")
    assert "no way points" in dict(scan_fanuc(text, FRAMES).left)[3]
