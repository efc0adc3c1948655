"""A pose is corrected with the frame and tool in force when the program reaches it, or left unchanged."""

import re

import pytest
import torch

from pisigma.deployment.export.rewriting.control_flow import (
    DEPENDS_ON_CALLER,
    DEPENDS_ON_PATH,
    ActiveFrames,
    Step,
)
from pisigma.deployment.export.rewriting.fanuc import scan_fanuc
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.krl import FIXED_TOOL, scan_krl, scan_krl_data
from pisigma.deployment.export.rewriting.rapid import scan_rapid
from pisigma.deployment.export.rewriting.scan import IDENTITY
from pisigma.deployment.export.rewriting.urscript import scan_urscript

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
    """Tools [m] of the poses that are understood, and the reasons for leaving the others unchanged."""
    program = scan(text, frames or FrameFile())
    assert len(program.targets) + len(program.unchanged_lines) == text.count("LIN {") + text.count("movel(")
    return [float(target.T_flange_tool[2, 3]) for target in program.targets], [
        why for _, why in program.unchanged_lines
    ]


@pytest.mark.parametrize(
    ("lines", "tools", "reason"),
    [
        ((FIRST, "LOOP", LIN, "ENDLOOP"), [0.1], None),
        ((FIRST, LIN, SECOND, LIN), [0.1, 0.2], None),
        ((FIRST, "LOOP", LIN, SECOND, "ENDLOOP"), [], DEPENDS_ON_PATH),
        ((FIRST, "LOOP", LIN, "IF $IN[1] THEN", SECOND, "ENDIF", "ENDLOOP"), [], DEPENDS_ON_PATH),
        ((FIRST, "IF $IN[1] THEN", SECOND, "ENDIF", LIN), [], DEPENDS_ON_PATH),
        ((FIRST, "IF $IN[1] THEN", SECOND, "ENDIF", FIRST, LIN), [0.1], None),
        ((FIRST, "LOOP", SECOND, LIN, FIRST, LIN, "ENDLOOP"), [0.2, 0.1], None),
        ((FIRST, "LOOP", SECOND, LIN, "ENDLOOP", LIN), [0.2], DEPENDS_ON_PATH),
        ((FIRST, "IF $IN[1] THEN", SECOND, LIN, "ELSE", LIN, "ENDIF"), [0.2, 0.1], None),
        (
            (FIRST, "SWITCH I", "CASE 1", SECOND, LIN, "CASE 2", LIN, "ENDSWITCH", LIN),
            [0.2, 0.1],
            DEPENDS_ON_PATH,
        ),
        ((FIRST, "WHILE TRUE", "IF $IN[1] THEN", SECOND, "ENDIF", LIN, "ENDWHILE"), [], DEPENDS_ON_PATH),
        ((FIRST, "again:", LIN, SECOND, "GOTO again"), [], DEPENDS_ON_PATH),
        ((FIRST, "again:", LIN, "sub()", "GOTO again", "END", "DEF sub()", SECOND), [], DEPENDS_ON_PATH),
        (("again:", FIRST, LIN, "GOTO again"), [0.1], None),
        ((FIRST, "sub()", LIN, "END", "DEF sub()", SECOND), [], "routine SUB"),
        ((FIRST, "one()", LIN, "END", "DEF one()", "two()", "END", "DEF two()", SECOND), [], "routine ONE"),
        ((FIRST, "sub()", SECOND, "sub()", "END", "DEF sub()", LIN), [], "not stated"),
        (
            (FIRST, "done=sub()", LIN, "END", "DEFFCT BOOL sub()", SECOND, "ENDFCT"),
            [],
            "routine SUB",
        ),
        (
            (FIRST, "IF sub() THEN", "ELSE", LIN, "ENDIF", "END", "DEFFCT BOOL sub()", SECOND),
            [],
            DEPENDS_ON_PATH,
        ),
        ((FIRST, "grip()", LIN, "END", "DEF grip()", "$OUT[1]=TRUE"), [0.1], None),
        ((FIRST, "sub()", "END", "DEF sub()", LIN), [0.1], None),
        ((FIRST, "foreign()", LIN), [], "FOREIGN"),
        ((FIRST, "foreign()", FIRST, "$BASE=$NULLFRAME", LIN), [0.1], None),
        ((FIRST, "foreign()", FIRST, LIN), [], r"\$BASE .* FOREIGN"),
        ((FIRST, "IF foreign() THEN", "ENDIF", LIN), [], "FOREIGN"),
        ((FIRST, "LOOP", LIN, "foreign()", "ENDLOOP"), [], DEPENDS_ON_PATH),
        ((FIRST, "sub()", LIN, "END", "DEF sub()", "foreign()"), [], "routine SUB"),
        ((FIRST, "keeps()", "d=ABS(1)", "WAIT FOR ($IN[1])", "IR_STOPM()", LIN), [0.1], None),
        ((FIRST, f"S{LIN} WITH $TOOL=STOOL2(F1)"), [], r"\$TOOL"),
        ((FIRST, "$TOOL.Z=200", LIN), [], r"\$TOOL"),
        ((FIRST, "BAS(#TOOL, number)", LIN), [], "TOOL_DATA.number."),
        ((FIRST, "FDAT_ACT=FP1", "BAS(#PTP_PARAMS, 100)", LIN), [], "FDAT_ACT"),
        ((FIRST, "$IPO_MODE=#TCP", LIN), [], FIXED_TOOL),
    ],
)
def test_krl(lines, tools, reason):
    found, reasons = kept(scan_krl, krl(*lines), FrameFile(routines=("Keeps",)))
    assert found == tools
    assert all(re.search(reason, why) for why in reasons)
    assert bool(reasons) == (reason is not None)


@pytest.mark.parametrize(
    ("lines", "tools", "reason"),
    [
        ((SET_FIRST, "while True:", MOVE, "end"), [0.1], None),
        ((SET_FIRST, MOVE, SET_SECOND, MOVE), [0.1, 0.2], None),
        ((SET_FIRST, "while True:", MOVE, SET_SECOND, "end"), [], DEPENDS_ON_PATH),
        ((SET_FIRST, "while True:", SET_SECOND, MOVE, SET_FIRST, MOVE, "end"), [0.2, 0.1], None),
        (
            (SET_FIRST, "if x:", SET_SECOND, MOVE, "elif y:", MOVE, "else:", SET_SECOND, "end"),
            [0.2, 0.1],
            None,
        ),
        ((SET_FIRST, "if x:", SET_SECOND, "end", MOVE), [], DEPENDS_ON_PATH),
        (("def sub():", SET_SECOND, "end", SET_FIRST, "sub()", MOVE), [], "routine sub"),
        (("def sub():", SET_SECOND, "end", SET_FIRST, MOVE), [0.1], None),
        (
            ("def sub():", SET_SECOND, "end", SET_FIRST, "if sub():", "else:", MOVE, "end"),
            [],
            DEPENDS_ON_PATH,
        ),
        ((SET_FIRST, "def sub():", MOVE, "end", "sub()", SET_SECOND, "sub()"), [], DEPENDS_ON_CALLER),
        (("def sub():", SET_SECOND, "end", MOVE), [], "not stated"),
        ((SET_FIRST, "foreign()", MOVE), [], "foreign"),
        ((SET_FIRST, "foreign()", SET_SECOND, MOVE), [0.2], None),
        ((SET_FIRST, "set_digital_out(1, True)", "sleep(0.1)", "keeps()", MOVE), [0.1], None),
        ((SET_FIRST, "tool = get_tcp_offset()", "set_tcp(tool)", MOVE), [], "computed"),
    ],
)
def test_urscript(lines, tools, reason):
    found, reasons = kept(
        scan_urscript, "\n".join(["def cell():", *lines, "end", ""]), FrameFile(routines=("keeps",))
    )
    assert found == tools
    assert [why for why in reasons if reason not in why] == []
    assert bool(reasons) == (reason is not None)


def test_displaced_poses_of_a_module_are_unchanged():
    target = "[[600, 0, 400], [0.5, 0.5, 0.5, 0.5], [0, 0, 0, 0], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]]"
    text = f"MODULE cell\nPROC main()\n{{}}MoveL {target}, v100, fine, tool0;\nENDPROC\nENDMODULE\n"
    assert len(scan_rapid(text.format(""), FrameFile()).targets) == 1
    displaced = scan_rapid(text.format("PDispSet shift;\n"), FrameFile())
    assert not displaced.targets
    ((line, reason),) = displaced.unchanged_lines
    assert line == 4
    assert reason.startswith("PDispSet ")


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
    assert understood or ("UFRAME 1" in dict(program.unchanged_lines)[4])


def test_values_outside_routines_apply_after_their_statement():
    frames = ActiveFrames([Step("set", "tool"), Step("loop"), Step("end"), Step("end")], {"tool": "unknown"})
    assert frames["tool"] == "unknown"
    frames.advance_past(0, IDENTITY)
    for number in (1, 2, 3):
        frames.advance_past(number)
        assert isinstance(frames["tool"], torch.Tensor)


def test_all_kinds_of_moves_are_found():
    """Moves of splines are included; straight process moves are straight."""
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


def test_arcs_without_waypoints_are_reported():
    text = fanuc("A P[1] 100mm/sec CNT50")
    assert 3 in dict(scan_fanuc(text, FRAMES).unchanged_lines)


RAPID_POSE = "[[600, 0, 400], {q}, [0, 0, 0, 0], [{eax}, 9E9, 9E9, 9E9, 9E9, 9E9]]"


def rapid(pose: str, named: bool, tool: str = "[1, 0, 0, 0]") -> str:
    return (
        f"MODULE cell\nPERS tooldata t := [TRUE, [[0, 0, 100], {tool}], [1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]];\n"
        f"CONST robtarget p := {pose};\nPROC main()\n"
        f"MoveL {'p' if named else pose}, v100, fine, t;\nENDPROC\nENDMODULE\n"
    )


@pytest.mark.parametrize("named", [True, False])
def test_external_axes_in_use_leave_the_pose_unchanged_and_are_reported(named):
    upright = "[0.5, 0.5, 0.5, 0.5]"
    for value, understood in (("9E+09", True), ("0", True), ("250.5", False)):
        found = scan_rapid(rapid(RAPID_POSE.format(q=upright, eax=value), named), FrameFile())
        assert bool(found.targets) == understood
        assert understood or "eax_a = 250.5" in dict(found.unchanged_lines)[5]
    for value, understood in (("0.0", True), ("-90", False)):
        pose = LIN.removeprefix("LIN ").replace("}", f", S 2, T 3, E1 {value}, E2 0}}")
        lines = (f"XP={pose}", "LIN XP") if named else (f"LIN {pose}",)
        found = scan_krl(krl(FIRST, *lines), FrameFile())
        assert bool(found.targets) == understood
        assert understood or "E1 = -90" in found.unchanged_lines[0][1]
        text = fanuc("L P[1] 100mm/sec FINE").replace("R = 0.0 deg", f"R = 0.0 deg,\n    E1= {value} mm")
        found = scan_fanuc(text, FRAMES)
        assert bool(found.targets) == understood
        assert understood or (
            "E1 = -90 " in found.unchanged_lines[0][1] and "(P[1], line 5)" in found.unchanged_lines[0][1]
        )
    frames = "DECL FDAT FP={TOOL_NO 0,BASE_NO 0,IPO_FRAME #BASE}\n"
    data = frames + "DECL E6POS XP={X 1,Y 2,Z 3,A 4,B 5,C 6,E1 7}\n"
    assert "E1 = 7" in dict(scan_krl_data(data, FrameFile()).unchanged_lines)[2]


@pytest.mark.parametrize(
    "before",
    ["PTP {E1 500}", "PTP {A1 0, A2 0, A3 0, A4 0, A5 0, A6 0, E1 -5}", "ASYPTP {E1 500}", "XQ.E1 = rail"],
)
def test_a_pose_without_an_external_axis_is_unchanged_if_the_program_moves_that_axis(before):
    stated = LIN.replace("}", ", E1 0}")
    found = scan_krl(krl(FIRST, before, LIN, stated), FrameFile())
    assert [target.line for target in found.targets] == [6]
    assert "E1 (in use in line 4)" in dict(found.unchanged_lines)[5]
    assert not scan_krl(krl(FIRST, LIN.replace("}", ", E1 rail}")), FrameFile()).targets


def test_rapid_and_fanuc_poses_without_an_external_axis_in_use_are_unchanged():
    pose = RAPID_POSE.format(q="[0.5, 0.5, 0.5, 0.5]", eax="9E9")
    text, moved = rapid(pose, False), "[[0, 0, 0, 0, 0, 0], [500, 9E9, 9E9, 9E9, 9E9, 9E9]]"
    for before, understood in (
        (f"MoveAbsJ {moved.replace('500', '0')}, v100, fine, t;", True),
        (f"MoveAbsJ {moved}, v100, fine, t;", False),
        ("EOffsSet [500, 0, 0, 0, 0, 0];", False),
    ):
        found = scan_rapid(text.replace("PROC main()\n", f"PROC main()\n{before}\n"), FrameFile())
        assert bool(found.targets) == understood
    text = fanuc("L P[1] 100mm/sec FINE")
    second = text[text.index("P[1]{") : text.index("/END")].replace("P[1]", "P[2]")
    for value in ("0.0", "12.5"):
        moved = second.replace("R = 0.0 deg", f"R = 0.0 deg,\n    E1= {value} mm")
        assert bool(scan_fanuc(text.replace("/END", f"{moved}/END"), FRAMES).targets) == (value == "0.0")
    assert not scan_fanuc(fanuc("L P[1] 100mm/sec FINE COORD"), FRAMES).targets
    assert not scan_fanuc(fanuc("$MNUFRAME[1,1]=PR[2]", "L P[1] 100mm/sec FINE"), FRAMES).targets


@pytest.mark.parametrize("quaternion", ["[0, 0, 0, 0]", "[0.7, 0, 0.7, 0.1]", "[1, 1, 0, 0]"])
def test_invalid_quaternions_are_reported_with_their_lines(quaternion):
    good = "[0.707107, 0, 0.707107, 0]"
    assert scan_rapid(rapid(RAPID_POSE.format(q=good, eax="9E9"), True), FrameFile()).targets
    for named in (True, False):
        found = scan_rapid(rapid(RAPID_POSE.format(q=quaternion, eax="9E9"), named), FrameFile())
        assert not found.targets
        assert "quaternion" in dict(found.unchanged_lines)[5]
    tool = scan_rapid(rapid(RAPID_POSE.format(q=good, eax="9E9"), True, quaternion), FrameFile())
    assert not tool.targets
    assert "(line 2)" in dict(tool.unchanged_lines)[5]


def test_the_tool_of_a_called_routine_is_uncertain():
    """The program, or a routine in another file, may set another tool before the call."""
    frames = FrameFile.model_validate({"tools": {"tcp": {"z_mm": 50}}})
    text = "def cell():\n{}{}\nend\n"
    sub = f"def sub():\n{MOVE}\nend\n"
    assert kept(scan_urscript, text.format(sub, "sub()"), frames)[0] == [0.05]
    for before in (SET_FIRST, "foreign()"):
        assert kept(scan_urscript, text.format(sub, f"{before}\nsub()"), frames)[0] == []
    assert kept(scan_urscript, text.format("", f"{MOVE}\nforeign()"), frames)[0] == [0.05]


MODULE = """MODULE cell
RECORD pair
  num a;
  robtarget p;
ENDRECORD
LOCAL PERS tooldata t := [TRUE, [[0, 0, 100], [1, 0, 0, 0]], [1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]];
PROC main()
  ConfL \\Off;
  own;
again:
  IF n > 3 THEN
    TPWrite "done; elsewhere;";
  ELSE
    own;
  ENDIF
  TEST n
  CASE 1, 2:
    Incr n;
  ENDTEST
  MoveL {pose},
    v100, fine,
    t
    \\WObj:=wobj0;
  n := n + 1;
  GOTO again;
ENDPROC
PROC own()
  Reset do1;
ENDPROC
TRAP stopped
  StopMove;
ENDTRAP
ENDMODULE
"""


BEFORE = ("own;\n  ENDIF", "Incr", "ConfL", "StopMove", "Reset")
CALLS = [(one, f"elsewhere \\Fast, 3;\n{one}") for one in BEFORE]


@pytest.mark.parametrize(
    ("line", "call"), [*CALLS, ("own;\nagain", "elsewhere;\nagain"), ("Incr n;", '%"go"%;')]
)
def test_a_call_of_another_module_leaves_all_poses_unchanged(line, call):
    """The called routine may change tools and work objects, or displace the following poses."""
    text = MODULE.format(pose=RAPID_POSE.format(q="[0.5, 0.5, 0.5, 0.5]", eax="9E9"))
    assert line in text
    assert len(scan_rapid(text, FrameFile()).targets) == 1
    called = text.replace(line, call)
    assert not scan_rapid(called, FrameFile()).targets
    if "elsewhere" in call:
        assert "elsewhere" in scan_rapid(called, FrameFile()).unchanged_lines[0][1]
        assert scan_rapid(called, FrameFile(routines=("ELSEWHERE",))).targets


@pytest.mark.parametrize(
    ("lines", "understood"),
    [
        (("CALL VISION", "{move}"), False),
        (("IF R[1]=1,CALL VISION(2)", "{move}"), False),
        (("{move}", "CALL VISION"), True),
        (("LBL[1]", "{move}", "RUN VISION", "JMP LBL[1]"), False),
        (("!CALL VISION", "CALL KEEPS", "{move}"), True),
    ],
)
def test_a_routine_that_a_fanuc_program_calls_may_set_frames(lines, understood):
    text = fanuc(*(line.format(move="L P[1] 100mm/sec FINE") for line in lines))
    found = scan_fanuc(text, FRAMES.model_copy(update={"routines": ("Keeps",)}))
    assert bool(found.targets) == understood
    assert understood or "VISION" in found.unchanged_lines[0][1]
    world = text.replace("UF : 1", "UF : 0")
    assert scan_fanuc(world, FRAMES).targets
