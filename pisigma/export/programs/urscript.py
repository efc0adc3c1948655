"""Targets as URScript, for controllers of Universal Robots: radians, metres, rotation vectors."""

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.export.programs.language import Language, Program, words
from pisigma.export.programs.text import FINE_DIGITS, comments, heading, numbers, place
from pisigma.se3 import rotation_vector

SPEED = 0.1
"""[rad/s] Of the leading joint."""

ACCELERATION = 0.2
"""[rad/s²] Of the leading joint."""

START = "Send it to the controller's script port, or call the function behind it where it is included."
OWN_LENGTHS = (
    "The controller computes poses with the lengths of its factory calibration where it has one, not with the "
    "robot as drawn; joint targets do not depend on that."
)


def urscript(program: Program) -> str:
    """The targets as one function of joint moves that stop at every target.

    Poses are turned by the controller into the joint values nearest to the corrected ones.
    """
    targets, cartesian = program.targets, program.cartesian
    said = [*heading(targets, cartesian), *([OWN_LENGTHS] if cartesian else []), START]
    lines = [
        *comments(said, "# "),
        f"def {program.name}():",
        "  # rad/s and rad/s^2 of the leading joint",
        f"  speed = {SPEED}",
        f"  acceleration = {ACCELERATION}",
    ]
    if cartesian:
        lines += [
            f"  set_tcp({_pose(targets.T_flange_tool)})",
            f"  frame = {_pose(targets.T_root_poses)}",
        ]
    for row, q in enumerate(targets.q.tolist()):
        goal = f"[{numbers(q, FINE_DIGITS)}]"
        if cartesian:
            goal = f"get_inverse_kin(pose_trans(frame, {_pose(targets.T[row])}), {goal})"
        lines += [f"  # {place(targets, row)}", f"  movej({goal}, a=acceleration, v=speed)"]
    return "\n".join([*lines, "end", ""])


def _pose(T: Float64[Tensor, "4 4"]) -> str:
    """x, y, z [m] and rotation vector [rad]."""
    values = torch.cat([T[:3, 3], rotation_vector(T[:3, :3])])
    return f"p[{numbers(values.tolist(), FINE_DIGITS)}]"


URSCRIPT = Language(
    "URScript",
    64,
    words(
        "and break continue def elif else end enum false for global halt if local not or pass return run sec "
        "struct then thread true while xor movej get_inverse_kin pose_trans set_tcp p speed acceleration frame"
    ),
    urscript,
    keeps_branch=True,
    cartesian_cautions=(OWN_LENGTHS,),
)
