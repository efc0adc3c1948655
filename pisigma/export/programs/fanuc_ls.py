"""Targets as FANUC TP programs in ASCII (.ls): degrees, millimetres, W about X, P about Y, R about Z.

The three turns are about fixed axes in that order, so the rotation is `RotZ(R) RotY(P) RotX(W)`.
"""

import re

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import OutputError
from pisigma.export.programs.language import FILES_OF_SYSTEMS, Language, Program
from pisigma.export.programs.targets import Targets
from pisigma.export.programs.text import (
    DIGITS,
    comments,
    heading,
    labelled,
    millimetres_and_euler,
    number,
    place,
)

SPEED = "5%"
"""Of the largest joint speeds."""

REMARK = 32
"""Characters in a remark."""

MOST_LINES = 9999
COUPLING = (
    "On FANUC pendants J3 counts from the horizontal, so it changes with J2. The values here count as the joint "
    "values of the model's measurements did; where those were angles between links, J3 has to be converted."
)
FRAME = ("X", "Y", "Z", "W", "P", "R")
"""R turns about Z and W about X, so the angles come in the other order than elsewhere."""

CONFIGURATION = re.compile(r"[NF] ([LR] )?[UD] [TB], -?\d, -?\d, -?\d")
WORLD = "UFRAME counts from the world frame, which on FANUC robots lies at the height of J2."

ATTRIBUTES = """\
/PROG  {name}
/ATTR
OWNER = MNEDITOR;
COMMENT = "pisigma targets";
PROG_SIZE = 0;
FILE_NAME = ;
VERSION = 0;
LINE_COUNT = {lines};
MEMORY_SIZE = 0;
PROTECT = READ_WRITE;
TCD:  STACK_SIZE = 0,
      TASK_PRIORITY = 50,
      TIME_SLICE = 0,
      BUSY_LAMP_OFF = 0,
      ABORT_REQUEST = 0,
      PAUSE_REQUEST = 0;
DEFAULT_GROUP = 1,*,*,*,*;
CONTROL_CODE = 00000000 00000000;"""
"""What stands before the moves."""


def fanuc_ls(program: Program) -> str:
    """The targets as one program of joint moves that stop at every target.

    Poses lie on one branch, and all have the same configuration, such as `N U T, 0, 0, 0`.

    Raises:
        OutputError: more lines than a program can have, or joints on turns that one `config` cannot name.
    """
    targets, name, cartesian = program.targets, program.name, program.cartesian
    number_of_frame = 1 if cartesian else 0
    said = [*heading(targets, cartesian), f"Speed: {SPEED} in every move.", COUPLING]
    if cartesian:
        _check_turns(targets)
        said += [
            *("UFRAME 1 has to be", *_frame_lines(targets.T_root_poses), WORLD),
            *("UTOOL 1 has to be", *_frame_lines(targets.T_flange_tool)),
        ]
    lines = [f"  {line}" for line in comments([s.replace(";", ",") for s in said], "!", REMARK)]
    lines += [f"  UFRAME_NUM={number_of_frame}", "  UTOOL_NUM=1"]
    for row in range(len(targets.line)):
        lines += [f"  !{place(targets, row)}", f"J P[{row + 1}] {SPEED} FINE"]
    if len(lines) > MOST_LINES:
        raise OutputError(
            f"the program {name} would have {len(lines)} lines, of which a FANUC controller takes {MOST_LINES}; "
            "split the file of poses."
        )
    numbered = [f"{index:4d}:{line} ;" for index, line in enumerate(lines, 1)]
    attributes = ATTRIBUTES.format(name=name, lines=len(lines)).splitlines()
    return "\r\n".join((*attributes, "/MN", *numbered, "/POS", *_positions(program), "/END", ""))


def _positions(program: Program) -> list[str]:
    targets = program.targets
    if program.cartesian:
        head, units = f"\tUF : 1, UT : 1,\tCONFIG : '{program.config}',", ("mm",) * 3 + ("deg",) * 3
        labels = tuple(f"{label} =" for label in FRAME)
        rows = _xyzwpr(targets.T).tolist()
    else:
        head, units = "\tUF : 0, UT : 1,", ("deg",) * 6
        labels = tuple(f"J{joint}=" for joint in range(1, 7))
        rows = torch.rad2deg(targets.q).tolist()
    lines = []
    for row, values in enumerate(rows, 1):
        parts = [
            f"{label} {number(value, DIGITS)} {unit}"
            for label, value, unit in zip(labels, values, units, strict=True)
        ]
        halves = (f"\t{', '.join(parts[:3])},", f"\t{', '.join(parts[3:])}")
        lines += [f"P[{row}]{{", "   GP1:", head, *halves, "};"]
    return lines


def _xyzwpr(T: Float64[Tensor, "*batch 4 4"]) -> Float64[Tensor, "*batch 6"]:
    return millimetres_and_euler(T)[..., [0, 1, 2, 5, 4, 3]]


def _frame_lines(T: Float64[Tensor, "4 4"]) -> list[str]:
    """Two values a line, which no line break can part from their labels."""
    values = _xyzwpr(T).tolist()
    return [labelled(FRAME[i : i + 2], values[i : i + 2]) for i in (0, 2, 4)]


def _check_turns(targets: Targets) -> None:
    """Refuse joint values that lie on several turns, as one configuration names one turn for all."""
    turns = torch.floor(targets.q / (2 * torch.pi) + 0.5)
    if len(turns) and bool((turns != turns[0]).any()):
        row = int((turns != turns[0]).any(-1).nonzero()[0, 0])
        raise OutputError(
            f"{targets.source}, line {targets.line[row]}: a joint stands on another turn than in line "
            f"{targets.line[0]}, so one --config does not fit both; take --targets joints or write two programs."
        )


FANUC = Language(
    "FANUC",
    36,
    FILES_OF_SYSTEMS,
    fanuc_ls,
    capitals=True,
    configuration=CONFIGURATION,
    cautions=(COUPLING,),
    cartesian_cautions=(WORLD,),
)
