"""Programs of four controllers with one circular move."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from testing.rewritten_programs import (
    FRAME,
    LANGUAGES,
    TOLERANCE_MM,
    TOOL,
    desired_poses,
    place_of,
    position,
)

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.programs.text import millimetres_and_euler
from pisigma.model.folder.model_folder import load_model

POINTS = torch.tensor([[0.0, 0.0, 0.0], [0.05, 0.09, 0.02], [0.16, 0.1, 0.05]], dtype=torch.float64)
"""Points of the arc relative to its start [m]."""


@dataclass(frozen=True)
class ArcProgram:
    """A program with one arc, and a statement that changes the orientation along it."""

    text: str
    turning: tuple[str, str]


ARC_PROGRAMS = {
    ".script": ArcProgram(
        "def cell():\n  set_tcp({tool})\n  bench = {frame}\n  movel(pose_trans(bench, {P0}), a=1.2)\n"
        "  movec(pose_trans(bench, {P1}), pose_trans(bench, {P2}), a=1.2, v=0.1)  # round\nend\n",
        ("v=0.1)", "v=0.1, mode=1)"),
    ),
    ".src": ArcProgram(
        "DEF cell()\n$TOOL = {tool}\n$BASE = {frame}\nOVER = {P1}\nLIN {P0}\nCIRC OVER, {P2} ; round\nEND\n",
        ("DEF cell()", "DEF cell()\n$CIRC_TYPE = #PATH"),
    ),
    ".mod": ArcProgram(
        "MODULE cell\n  PERS tooldata torch := [TRUE, [[{tool}]], [1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]];\n"
        '  TASK PERS wobjdata bench := [FALSE, TRUE, "", [[{frame}]], [[0, 0, 0], [1, 0, 0, 0]]];\n'
        "  PROC run()\n    MoveL {P0}, v100, fine, torch \\WObj:=bench;\n"
        "    MoveC {P1}, {P2}, v100, fine, torch \\WObj:=bench;  ! round\n  ENDPROC\nENDMODULE\n",
        ("PROC run()", "PROC run()\n    CirPathMode \\Wrist45;"),
    ),
    ".ls": ArcProgram(
        "/PROG  CELL\n/ATTR\nLINE_COUNT = 2;\n/MN\n"
        "   1:L P[1] 100mm/sec FINE ;\n   2:C P[2]\n    :  P[3] 100mm/sec FINE ;\n"
        "/POS\n{P0}\n{P1}\n{P2}\n/END\n",
        ("C P[2]", "A P[2]"),
    ),
}


def arc_poses(arm: Path, points: torch.Tensor = POINTS) -> torch.Tensor:
    """Return poses of one orientation, in the frame."""
    first = desired_poses(load_model(arm).robot)[0]
    T = first.repeat(3, 1, 1)
    T[:, :3, 3] += points
    return T


def arc_request(suffix: str, text: str, T: torch.Tensor, arm: Path, tmp_path: Path) -> ExportRequest:
    """Write a program of three poses, and frames it does not state, and return the request to rewrite it."""
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
