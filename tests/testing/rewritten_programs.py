"""Programs of four controllers with rewritten targets, and the poses that the real tool reaches."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from testing.models import joints_around

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.programs.text import (
    format_labelled,
    format_numbers,
    metres_and_rotation_vector,
    millimetres_and_euler,
    position_in_mm,
    quaternion,
)
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.scan import Frame, ScannedProgram
from pisigma.deployment.export.targets import SCANNERS
from pisigma.model.folder.model_folder import load_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, transform_from_xyz_zyx

FRAME = transform_from_xyz_zyx(torch.tensor([0.4, -0.3, 0.1, 0.5, -0.2, 0.1], dtype=torch.float64))
TOOL = transform_from_xyz_zyx(torch.tensor([0.02, -0.01, 0.15, 0.3, 0.1, -0.4], dtype=torch.float64))
TOLERANCE_MM = 0.02


@dataclass(frozen=True)
class Language:
    """A language's program of two linear moves, a joint move, a computed move and one to a far pose."""

    suffix: str
    pose: Callable[[Frame], str]
    text: str
    kept: tuple[str, ...]
    """Text that the new program must also contain."""


def xyzabc_text(T: Frame) -> str:
    return format_labelled(millimetres_and_euler(T).tolist(), "XYZABC")


def place_of(T: Frame) -> str:
    return f"{format_numbers(position_in_mm(T))}], [{format_numbers(quaternion(T), 9)}"


def position(number: int) -> Callable[[Frame], str]:
    def written(T: Frame) -> str:
        x, y, z, r, p, w = (f"{value:.6f}" for value in millimetres_and_euler(T).tolist())
        return (
            f"P[{number}]{{\n   GP1:\n\tUF : 1, UT : 2,\t\tCONFIG : 'N U T, 0, 0, 0',\n"
            f"\tX = {x}  mm,\tY = {y}  mm,\tZ = {z}  mm,\n\tW = {w} deg,\tP = {p} deg,\tR = {r} deg\n}};"
        )

    return written


LANGUAGES = [
    Language(
        ".script",
        lambda T: f"p[{format_numbers(metres_and_rotation_vector(T), 9)}]",
        """def cell():
  # movel(p[1, 2, 3, 4, 5, 6]) "is a remark"
  set_tcp({tool})
  bench = {frame}
  over = {P1}
  movej([0.1, -1.0, 1.2, -0.4, -1.2, 0.3], a=1.2)
  movej(get_inverse_kin(pose_trans(bench, {P0}), [0, 0, 0, 0, 0, 0]), a=1.4, v=0.5)
  movel(pose_trans(bench, over), a=1.2, v=0.25, r=0.01)  # over the bench
  set_digital_out(1, True)
  movel(pose_trans(bench, {P2}), a=1.2, v=0.2)
  movel(pose_trans(bench, {far}))
  movel(pose_add(get_actual_tcp_pose(), p[0, 0, 0.1, 0, 0, 0]))
end
""",
        (
            "  movel(pose_trans(bench, over), a=1.2, v=0.25, r=0.01)  # over the bench",
            "set_digital_out(1, True)",
        ),
    ),
    Language(
        ".src",
        lambda T: "{X 1, Y 2}"[:0] + f"{{{xyzabc_text(T)}}}",
        """&ACCESS RVP
DEF cell()
; LIN {{X 1,Y 2,Z 3,A 4,B 5,C 6}}
$TOOL = {tool}
$BASE = {frame}
OVER = {P1}
PTP {{A1 0, A2 -90, A3 90, A4 0, A5 0, A6 0}}
PTP {{FRAME: {p0}}}
LIN OVER C_DIS ; over the bench
$OUT[1] = TRUE
LIN {{POS: {p2}, S 2, T 35}}
LIN {far}
LIN_REL {{Z 10}}
END
""",
        ("LIN OVER C_DIS ; over the bench", "$OUT[1] = TRUE", ", S 2, T 35}"),
    ),
    Language(
        ".mod",
        lambda T: f"[[{place_of(T)}], [0, -1, 0, 1], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]]",
        """MODULE cell
  PERS tooldata torch := [TRUE, [[{tool}]], [1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]];
  TASK PERS wobjdata bench := [FALSE, TRUE, "", [[{frame}]], [[0, 0, 0], [1, 0, 0, 0]]];
  CONST robtarget over := {P1};
  PROC run()
    MoveAbsJ [[0, 0, 0, 0, 0, 0], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]], v500, fine, torch;
    MoveJ {P0}, v1000, z10, torch \\WObj:=bench;
    MoveL over, v200, z5, torch \\WObj:=bench;  ! over the bench
    SetDO do1, 1;
    MoveL {P2}, v100, fine, torch
      \\WObj:=bench;
    MoveL {far}, v100, fine, torch \\WObj:=bench;
    MoveL Offs(home, 0, 0, 10), v100, fine, torch \\WObj:=bench_2;
  ENDPROC
ENDMODULE
""",
        ("MoveL over, v200, z5, torch \\WObj:=bench;  ! over the bench", "SetDO do1, 1;", "[0, -1, 0, 1]"),
    ),
    Language(
        ".ls",
        lambda T: "",
        """/PROG  CELL
/ATTR
LINE_COUNT = 9;
/MN
   1:  !L P[1] a remark ;
   2:J P[1] 20% FINE ;
   3:L P[2] 250mm/sec CNT50 ACC80 ;
   4:  DO[1]=ON ;
   5:L P[3] 100mm/sec FINE ;
   6:L P[4] 100mm/sec FINE ;
   7:L PR[1] 100mm/sec FINE ;
   8:J P[5] 20% FINE ;
   9:L P[3] 100mm/sec FINE Offset,PR[2] ;
/POS
{P0}
{P1}
{P2}
{far}
P[5]{{
   GP1:
	UF : 0, UT : 2,
	J1=     0.000 deg,	J2=     0.000 deg,	J3=     0.000 deg,
	J4=     0.000 deg,	J5=     0.000 deg,	J6=     0.000 deg
}};
/END
""",
        ("L P[2] 250mm/sec CNT50 ACC80 ;", "DO[1]=ON ;", "!L P[1] a remark ;"),
    ),
]
FANUC_FRAMES = """frames: {{"UFRAME 1": {{{frame}}}}}
tools: {{"UTOOL 2": {{{tool}}}}}
"""


def desired_poses(robot: Robot) -> torch.Tensor:
    """Return three poses of the tool in the frame within the domain, and one that is too far."""
    bare = robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
    T = invert(FRAME) @ forward_kinematics(bare, joints_around("ur10", 3, seed=2, spread=0.2)) @ TOOL
    far = T[:1].clone()
    far[:, :3, 3] += 9.0
    return torch.cat([T, far])


def program(language: Language, arm: Path, tmp_path: Path) -> ExportRequest:
    """Write the program and the frames it does not state as files, and return the request to rewrite it."""
    T = desired_poses(load_model(arm).robot)
    written = {
        f"P{i}": (position(i + 1) if language.suffix == ".ls" else language.pose)(T[i]) for i in range(3)
    }
    far = (position(4) if language.suffix == ".ls" else language.pose)(T[3])
    place = place_of if language.suffix == ".mod" else language.pose
    text = language.text.format(
        **written, far=far, tool=place(TOOL), frame=place(FRAME), p0=xyzabc_text(T[0]), p2=xyzabc_text(T[2])
    )
    path = tmp_path / f"cell{language.suffix}"
    path.write_text(text, newline="")
    columns = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
    stated = {
        name: ", ".join(
            f"{c}: {v!r}" for c, v in zip(columns, millimetres_and_euler(frame).tolist(), strict=True)
        )
        for name, frame in (("frame", FRAME), ("tool", TOOL))
    }
    (tmp_path / "frames.yaml").write_text(FANUC_FRAMES.format(**stated))
    frames = tmp_path / "frames.yaml" if language.suffix == ".ls" else None
    out = tmp_path / f"new{language.suffix}"
    return ExportRequest(arm, out, program=path, frames=frames, tolerance_mm=TOLERANCE_MM)


INLINE_POINTS = """DEFDAT CELL
DECL E6POS XP1={{{P0},S 2,T 35,E1 0.0,E2 0.0}}
DECL FDAT FP1={{TOOL_NO 4,BASE_NO 3,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}}
DECL E6POS XP2={{{P1},S 2,T 35,E1 0.0,E2 0.0}}
DECL FDAT FP2={{TOOL_NO 4,BASE_NO 3,IPO_FRAME #TCP,POINT2[] " ",TQ_STATE FALSE}}
DECL E6POS XP3={{{P2},S 2,T 35}}
DECL E6AXIS XP4={{A1 0,A2 0,A3 0,A4 0,A5 0,A6 0}}
ENDDAT
"""


def inline_points(arm: Path, tmp_path: Path) -> ExportRequest:
    """Write the points of KUKA's inline forms and their frames, and return the request to rewrite them."""
    T = desired_poses(load_model(arm).robot)
    path, frames = tmp_path / "cell.dat", tmp_path / "frames.yaml"
    path.write_text(INLINE_POINTS.format(**{f"P{i}": xyzabc_text(T[i]) for i in range(3)}))
    columns = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
    frame, tool = (dict(zip(columns, millimetres_and_euler(F).tolist(), strict=True)) for F in (FRAME, TOOL))
    frames.write_text(json.dumps({"frames": {"BASE_DATA[3]": frame}, "tools": {"TOOL_DATA[4]": tool}}))
    return ExportRequest(arm, tmp_path / "new.dat", program=path, frames=frames)


def scanned(path: Path, frames: Path | None) -> ScannedProgram:
    return SCANNERS[path.suffix](path.read_text(), FrameFile.read(frames))


def attained_poses(arm: Path, commanded: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Return the poses that the real tool reaches with a controller that uses the nominal robot."""
    model = load_model(arm)
    base, tool = (
        transform_from_xyz_zyx(torch.from_numpy(f.copy())) for f in (model.robot.base, model.robot.tool)
    )
    before, after = base @ FRAME, invert(TOOL) @ tool
    q = closed_form_solver(model.robot).solve(before @ commanded @ after).q
    T = invert(before) @ model.forward(q.flatten(0, 1)).unflatten(0, q.shape[:2]) @ invert(after)
    off = (T - wanted[:, None]).flatten(2).norm(dim=-1).nan_to_num(torch.inf)
    return T[range(len(T)), off.argmin(-1)]
