"""Circular moves of rewritten programs: arcs that are split, and those that are left unchanged."""

import json
import math
from dataclasses import dataclass

import pytest
import torch
from testing.closeness import assert_close
from testing.rewritten_programs import (
    FRAME,
    LANGUAGES,
    TOLERANCE_MM,
    TOOL,
    attained_poses,
    desired_poses,
    place_of,
    position,
    scanned,
)

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.programs.text import millimetres_and_euler
from pisigma.deployment.export.registry import export_model
from pisigma.deployment.export.rewriting.correction import (
    COLLINEAR,
    OTHER_ORIENTATION,
    CircularArcs,
    is_straight,
)
from pisigma.deployment.export.rewriting.krl import STATED_ARC
from pisigma.model.folder.model_folder import load_model

POINTS = torch.tensor([[0.0, 0.0, 0.0], [0.05, 0.09, 0.02], [0.16, 0.1, 0.05]], dtype=torch.float64)
"""Points of the arc relative to its start [m]."""


@dataclass(frozen=True)
class Program:
    """A program with one arc, and a statement that changes the orientation along it."""

    text: str
    turning: tuple[str, str]


PROGRAMS = {
    ".script": Program(
        "def cell():\n  set_tcp({tool})\n  bench = {frame}\n  movel(pose_trans(bench, {P0}), a=1.2)\n"
        "  movec(pose_trans(bench, {P1}), pose_trans(bench, {P2}), a=1.2, v=0.1)  # round\nend\n",
        ("v=0.1)", "v=0.1, mode=1)"),
    ),
    ".src": Program(
        "DEF cell()\n$TOOL = {tool}\n$BASE = {frame}\nOVER = {P1}\nLIN {P0}\nCIRC OVER, {P2} ; round\nEND\n",
        ("DEF cell()", "DEF cell()\n$CIRC_TYPE = #PATH"),
    ),
    ".mod": Program(
        "MODULE cell\n  PERS tooldata torch := [TRUE, [[{tool}]], [1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]];\n"
        '  TASK PERS wobjdata bench := [FALSE, TRUE, "", [[{frame}]], [[0, 0, 0], [1, 0, 0, 0]]];\n'
        "  PROC run()\n    MoveL {P0}, v100, fine, torch \\WObj:=bench;\n"
        "    MoveC {P1}, {P2}, v100, fine, torch \\WObj:=bench;  ! round\n  ENDPROC\nENDMODULE\n",
        ("PROC run()", "PROC run()\n    CirPathMode \\Wrist45;"),
    ),
    ".ls": Program(
        "/PROG  CELL\n/ATTR\nLINE_COUNT = 2;\n/MN\n"
        "   1:L P[1] 100mm/sec FINE ;\n   2:C P[2]\n    :  P[3] 100mm/sec FINE ;\n"
        "/POS\n{P0}\n{P1}\n{P2}\n/END\n",
        ("C P[2]", "A P[2]"),
    ),
}


def _poses(arm, points=POINTS):
    """Of one orientation, in the frame."""
    first = desired_poses(load_model(arm).robot)[0]
    T = first.repeat(3, 1, 1)
    T[:, :3, 3] += points
    return T


def _request(suffix, text, T, arm, tmp_path):
    """A program of the three poses, and the frames that it does not state."""
    language = next(language for language in LANGUAGES if language.suffix == suffix)
    place = place_of if suffix == ".mod" else language.pose
    poses = {
        f"P{i}": (position(i + 1) if suffix == ".ls" else language.pose)(pose) for i, pose in enumerate(T)
    }
    path, frames = tmp_path / f"cell{suffix}", tmp_path / "frames.yaml"
    path.write_text(text.format(**poses, tool=place(TOOL), frame=place(FRAME)))
    columns = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
    frame, tool = (dict(zip(columns, millimetres_and_euler(F).tolist(), strict=True)) for F in (FRAME, TOOL))
    frames.write_text(json.dumps({"frames": {"UFRAME 1": frame}, "tools": {"UTOOL 2": tool}}))
    stated = frames if suffix == ".ls" else None
    out = tmp_path / f"new{suffix}"
    return ExportRequest(arm, out, program=path, frames=stated, tolerance_mm=TOLERANCE_MM)


def _reasons(exported):
    return [entry["reason"] for entry in exported.facts["left_alone"]]


@pytest.mark.parametrize("suffix", PROGRAMS)
def test_the_real_tool_remains_on_the_arc(suffix, arm, tmp_path):
    """A controller moves on arcs through the commanded poses, and the real tool on the intended arc."""
    T = _poses(arm)
    request = _request(suffix, PROGRAMS[suffix].text, T, arm, tmp_path)
    exported = export_model("targets", request)
    moves = [move for move in scanned(request.out, request.frames).moves if move.circular]
    assert len(moves) > 1
    assert exported.facts["way_points"] == 2 * len(moves) - 1
    assert _reasons(exported)[1:] == []
    meant, worst = CircularArcs.through_points(*T[:, None, :3, 3]), 0.0
    for move in moves:
        ends = (target.pose.T[None, :3, 3] for target in (move.start, move.via, move.end))
        commanded = move.start.pose.T.repeat(9, 1, 1)
        commanded[:, :3, 3] = CircularArcs.through_points(*ends).sample(8)[0]
        real = attained_poses(arm, commanded, commanded)[:, :3, 3] - meant.centre
        height = (real * meant.axis).sum(-1)
        off = torch.hypot(height, (real - height[:, None] * meant.axis).norm(dim=-1) - meant.radius.norm())
        worst = max(worst, float(off.max()) * 1e3)
    assert worst < 1.5 * TOLERANCE_MM
    last = attained_poses(arm, moves[-1].end.pose.T[None], T[2:])
    assert_close(last[0, :3, 3], T[2, :3, 3], atol=1e-8)


@pytest.mark.parametrize("suffix", PROGRAMS)
def test_an_arc_with_another_orientation_is_not_split(suffix, arm, tmp_path):
    text = PROGRAMS[suffix].text.replace(*PROGRAMS[suffix].turning)
    exported = export_model("targets", _request(suffix, text, _poses(arm), arm, tmp_path))
    assert exported.facts["way_points"] == 0
    assert exported.facts["statuses"] == {"reached": 3}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda T: T[1, :3, :3].copy_(T[1, :3, :3] @ TOOL[:3, :3]), OTHER_ORIENTATION),
        (lambda T: T[1, :3, 3].copy_((T[0, :3, 3] + T[2, :3, 3]) / 2), COLLINEAR),
    ],
)
def test_ambiguous_arcs_are_reported(change, reason, arm, tmp_path):
    T = _poses(arm)
    change(T)
    exported = export_model("targets", _request(".src", PROGRAMS[".src"].text, T, arm, tmp_path))
    assert reason in _reasons(exported)
    assert exported.facts["way_points"] == 0


def test_an_arc_after_a_move_to_joint_values_is_reported(arm, tmp_path):
    text = PROGRAMS[".src"].text.replace("CIRC", "PTP {{A1 0, A2 -90, A3 90, A4 0, A5 0, A6 0}}\nCIRC")
    exported = export_model("targets", _request(".src", text, _poses(arm), arm, tmp_path))
    assert any(why.startswith("the start or via point of the arc") for why in _reasons(exported))


def test_an_arc_beyond_its_end_point_is_reported(arm, tmp_path):
    text = PROGRAMS[".src"].text.replace("{P2} ;", "{P2}, CA 200 ;")
    exported = export_model("targets", _request(".src", text, _poses(arm), arm, tmp_path))
    assert STATED_ARC in _reasons(exported)
    assert exported.facts["way_points"] == 0


def test_arcs_pass_through_their_points():
    angles = torch.tensor([[0.3, 1.0, 2.0], [0.3, 5.0, 6.0]], dtype=torch.float64)
    circle = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1) * 0.2
    arcs = CircularArcs.through_points(*circle.unbind(1))
    assert_close(arcs.angle, angles[:, 2] - angles[:, 0], atol=1e-12)
    assert_close(arcs.passing, angles[:, 1] - angles[:, 0], atol=1e-12)
    assert_close(arcs.sample(4)[:, [0, -1]], circle[:, [0, 2]], atol=1e-12)
    assert_close(arcs.sample(4).norm(dim=-1), 0.2, atol=1e-12)
    back = CircularArcs.through_points(*circle.flip(1).unbind(1))
    assert_close(back.angle, arcs.angle, atol=1e-12)
    assert float(arcs.angle[1]) > math.pi
    assert not is_straight(*circle.unbind(1))
    assert is_straight(circle[:, 0], circle[:, 0], circle[:, 2])
