"""A robot as a chain of pytorch-kinematics, for planners that are built on it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from pisigma.robot.row import Row
from pisigma.robot.urdf_frames import Frame, frame_of, row_frame, shift, turn

if TYPE_CHECKING:
    from pytorch_kinematics import SerialChain

BASE_FRAME, TOOL_FRAME = "base_link", "tool0"


def serial_chain(
    rows: Sequence[Row],
    dh: Float64[np.ndarray, "rows 5"],
    base: Float64[np.ndarray, " 6"],
    tool: Float64[np.ndarray, " 6"],
) -> "SerialChain":
    """Build the chain from the frame that poses are given in to the tool, in float64 on the CPU.

    A joint stands where its row has it after `RotZ(theta) · Trans(0, 0, d)` and moves about or along z, or against
    it where its direction is -1; `Trans(a, 0, 0) · RotX(alpha) · RotY(beta)` leads on to the next. Everything is made
    in float64: a chain that is made in float32 and converted is off by 2e-8 m.

    Args:
        rows: the frames of the chain, between `base_link` and `tool0`; joints are named like the rows and take the
            same joint values [rad or m].
        dh: theta, d, a, alpha and beta of every row [rad, m].
        base: x, y, z [m], roll, pitch, yaw [rad].
        tool: the same.
    """
    import torch
    from pytorch_kinematics import SerialChain, Transform3d
    from pytorch_kinematics import frame as frames
    from pytorch_kinematics.chain import Chain

    double = torch.float64

    def attach(parent: frames.Frame, name: str, origin: Frame, joint: str, **motion: object) -> frames.Frame:
        offset = Transform3d(matrix=torch.from_numpy(origin)[None], dtype=double)
        child = frames.Frame(name, frames.Link(name), frames.Joint(joint, offset, dtype=double, **motion))
        parent.add_child(child)
        return child

    root = frames.Frame(BASE_FRAME, frames.Link(BASE_FRAME), frames.Joint("root", dtype=double))
    last, behind = root, frame_of(base)
    for row, (theta, d, a, alpha, beta) in zip(rows, dh.tolist(), strict=True):
        last = attach(
            last,
            f"{row.name}_link",
            behind @ turn(2, theta) @ shift(0.0, 0.0, d),
            row.name,
            joint_type=row.type,
            axis=(0.0, 0.0, float(row.direction)),
            limits=(row.lower, row.upper) if np.isfinite([row.lower, row.upper]).all() else None,
        )
        behind = row_frame(0.0, 0.0, a, alpha, beta)
    attach(last, TOOL_FRAME, behind @ frame_of(tool), "tool")
    return SerialChain(Chain(root, dtype=double), TOOL_FRAME, dtype=double)
