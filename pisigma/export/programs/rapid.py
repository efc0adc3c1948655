"""Targets as RAPID, for controllers of ABB: degrees, millimetres, quaternions (w, x, y, z)."""

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.export.programs.language import Language, Program, words
from pisigma.export.programs.text import DIGITS, FINE_DIGITS, comments, heading, numbers, place
from pisigma.se3 import rotation_vector

SPEED = "[50, 10, 50, 10]"
"""speeddata: [mm/s] of the tool, [deg/s] of its turning, [mm/s] and [deg/s] of external axes."""

NO_EXTERNAL_AXES = "[9E9, 9E9, 9E9, 9E9, 9E9, 9E9]"
LOAD = "[-1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]"
"""loaddata of unknown mass, with which the controller does not move."""

TOOL_OF_JOINTS = "Put the tool that is mounted in the place of tool0, for the sake of its load."
FIRST = (
    "The load of the tool is not known here: give its mass instead of -1. The first move is by axes; the others "
    "take the configuration nearest to it (ConfJ Off), as their own is not known."
)


def rapid(program: Program) -> str:
    """The targets as one module with one procedure of joint moves that stop at every target.

    The procedure is called name_run, tool and work object name_tool and name_wobj. Poses (robtargets) lie on
    one branch.
    """
    targets, name, cartesian = program.targets, program.name, program.cartesian
    lines = [
        f"MODULE {name}",
        *comments([*heading(targets, cartesian), FIRST if cartesian else TOOL_OF_JOINTS], "  ! "),
        "  ! mm/s and deg/s of the tool, mm/s and deg/s of external axes",
        f"  LOCAL CONST speeddata slow := {SPEED};",
    ]
    axes = torch.rad2deg(targets.q).tolist()
    if cartesian:
        tool, frame = f"{name}_tool", f"{name}_wobj"
        nothing = _pose(torch.eye(4, dtype=torch.float64))
        lines += [
            f"  PERS tooldata {tool} := [TRUE, {_pose(targets.T_flange_tool)}, {LOAD}];",
            f'  PERS wobjdata {frame} := [FALSE, TRUE, "", {_pose(targets.T_root_poses)}, {nothing}];',
            f"  PROC {name}_run()",
            "    ConfJ \\Off;",
            f"    MoveAbsJ {_joints(axes[0])}, slow, fine, {tool};",
        ]
        moves = [f"MoveJ {_robtarget(T)}, slow, fine, {tool} \\WObj:={frame};" for T in targets.T.unbind()]
    else:
        lines.append(f"  PROC {name}_run()")
        moves = [f"MoveAbsJ {_joints(values)}, slow, fine, tool0;" for values in axes]
    for row, move in enumerate(moves):
        lines += [f"    ! {place(targets, row)}", f"    {move}"]
    if cartesian:
        lines.append("    ConfJ \\On;")
    return "\r\n".join([*lines, "  ENDPROC", "ENDMODULE", ""])


def _joints(degrees: list[float]) -> str:
    return f"[[{numbers(degrees, DIGITS)}], {NO_EXTERNAL_AXES}]"


def _robtarget(T: Float64[Tensor, "4 4"]) -> str:
    return f"[{_pose(T)[1:-1]}, [0, 0, 0, 0], {NO_EXTERNAL_AXES}]"


def _pose(T: Float64[Tensor, "4 4"]) -> str:
    """[[x, y, z] in mm, [w, x, y, z] of the quaternion]."""
    position = numbers((T[:3, 3] * 1e3).tolist(), DIGITS)
    return f"[[{position}], [{numbers(quaternion(T[:3, :3]).tolist(), FINE_DIGITS)}]]"


def quaternion(R: Float64[Tensor, "*batch 3 3"]) -> Float64[Tensor, "*batch 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0 of a rotation: `cos(t/2), n sin(t/2)` of axis n and angle t."""
    vector = rotation_vector(R)
    half = torch.linalg.vector_norm(vector, dim=-1, keepdim=True) / 2
    return torch.cat([torch.cos(half), vector / 2 * torch.sinc(half / torch.pi)], -1)


RAPID = Language(
    "RAPID",
    27,  # of 32, with _tool behind it
    words(
        "alias and backward bool case connect const default div do else elseif endfor endfunc endif endmodule "
        "endproc endrecord endtest endtrap endwhile error exit false for from func goto if inout local mod "
        "module nostepin not noview num or pers proc raise readonly record retry return step string "
        "sysmodule task test then to trap true trynext undo user var viewonly while with xor slow fine tool0 "
        "wobj0 movej moveabsj confj base"
    ),
    rapid,
)
