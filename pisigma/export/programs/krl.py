"""Targets as KRL, for controllers of KUKA: degrees, millimetres, A about Z, then B about Y, then C about X."""

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.export.programs.language import FILES_OF_SYSTEMS, Language, Program, words
from pisigma.export.programs.text import comments, heading, labelled, millimetres_and_euler, place

SPEED = 5
"""[%] Of the largest speed and acceleration of every axis."""

AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
FRAME = ("X", "Y", "Z", "A", "B", "C")
FIRST = (
    "The first move is by axes and settles the status; the others keep it and take the nearest turn, as no S "
    "and T are given."
)


def krl(program: Program) -> str:
    """The targets as one module of point-to-point moves that stop at every target; poses lie on one branch."""
    targets, cartesian = program.targets, program.cartesian
    lines = [
        "&ACCESS RVP",
        "&REL 1",
        f"DEF {program.name}( )",
        *comments([*heading(targets, cartesian), *([FIRST] if cartesian else [])], "; "),
        "DECL INT SPEED",
        "DECL INT I",
        "; percent of the largest speeds and accelerations",
        f"SPEED = {SPEED}",
        "BAS(#INITMOV, 0)",
        "FOR I = 1 TO 6",
        "  $VEL_AXIS[I] = SPEED",
        "  $ACC_AXIS[I] = SPEED",
        "ENDFOR",
    ]
    axes = torch.rad2deg(targets.q).tolist()
    if cartesian:
        lines += [
            f"$BASE = {_frame(targets.T_root_poses)}",
            f"$TOOL = {_frame(targets.T_flange_tool)}",
            f"PTP {_axes(axes[0])}",
        ]
    for row, values in enumerate(axes):
        goal = _frame(targets.T[row]) if cartesian else _axes(values)
        lines += [f"; {place(targets, row)}", f"PTP {goal}"]
    return "\r\n".join([*lines, "END", ""])


def _axes(degrees: list[float]) -> str:
    return f"{{AXIS: {labelled(AXES, degrees)}}}"


def _frame(T: Float64[Tensor, "4 4"]) -> str:
    return f"{{FRAME: {labelled(FRAME, millimetres_and_euler(T).tolist())}}}"


KRL = Language(
    "KRL",
    24,
    words(
        "and anin anout b_and b_exor b_not b_or bool brake bas case ccomp channel char circ circ_rel confirm "
        "const continue ct_i decl def default defdat deffct digin do else end enddat endfct endfor endif "
        "endloop endspline endswitch endwhile enum exit exor ext extfct false for frame global goto halt if "
        "import int interrupt is lin lin_rel loop maximum minimum not or pos e6pos axis e6axis priority ptp "
        "ptp_rel public pulse real repeat resume return sec signal slin spl spline spo sptp step struc "
        "switch then to trigger true until wait when while speed i"
    )
    | FILES_OF_SYSTEMS,
    krl,
)
