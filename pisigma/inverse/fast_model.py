"""What many poses are solved with, and the one step that all ways share: from joint values to a finished solution."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.inverse.fast_arm import FastArm
from pisigma.inverse.fast_rows import FastRows
from pisigma.inverse.identified_arm import IdentifiedArm
from pisigma.inverse.nearest_turn import nearest_turn
from pisigma.kinematics.closed_form import AbstractClosedForm
from pisigma.kinematics.components import Frame
from pisigma.kinematics.joint_limits import wrap_into_limits
from pisigma.kinematics.status import Status
from pisigma.robot.description import Robot
from pisigma.se3 import wrap_to_pi


@dataclass(frozen=True, eq=False)
class FastModel:
    """What chunks of poses are solved with.

    Attributes:
        identified: the arm as drawn and as identified, with the closed form of the former.
        nominal: the former, and
        arm: the latter, prepared for many poses.
    """

    identified: IdentifiedArm
    nominal: FastArm
    arm: FastArm

    @staticmethod
    def of(identified: IdentifiedArm) -> "FastModel":
        """Prepare an arm; see `FastArm.suits`."""
        return FastModel(
            identified, FastArm(identified.nominal, None), FastArm(identified.calibrated, identified.hybrid)
        )

    @property
    def robot(self) -> Robot:
        """The arm as drawn."""
        return self.identified.nominal

    @property
    def solver(self) -> AbstractClosedForm:
        """Its closed form."""
        return self.identified.solver

    @cached_property
    def periodic(self) -> bool:
        """Whether the joint correction is the same on all turns."""
        hybrid = self.identified.hybrid
        return hybrid is None or hybrid.correction.is_periodic


def follow(
    model: FastModel,
    T_base_tool: Frame,
    start: Float64[Tensor, "poses dof"],
    branch: int | Tensor,
    near: Float64[Tensor, "poses dof"] | None,
    patient: bool = False,
) -> FastRows:
    """Solve for poses from joint values on, and put the solutions on the turns to command.

    Args:
        model: the arm.
        T_base_tool: the poses on components.
        start: joint values [rad], such as the nominal arm's, which the nominal ones of the solutions are.
        branch: index of their branch, or one for each.
        near: joint values [rad] to be near to, or None.
        patient: see `FastArm.follow`.
    """
    robot, columns = model.robot, start.T.contiguous()
    followed = model.arm.follow(T_base_tool, columns, patient)
    q = (columns + wrap_to_pi(followed.q - columns)).T
    commanded, inside = wrap_into_limits(robot, q)
    if near is not None:
        commanded = nearest_turn(robot, commanded, near, within_limits=True)
    done = followed.good if model.periodic else followed.good & (commanded == q).all(-1)
    status = torch.where(followed.share < 1, int(Status.OUTSIDE_DOMAIN), int(Status.REACHED))
    status = torch.where(followed.singular, int(Status.SINGULAR), status)
    learned = model.identified.hybrid is not None
    return FastRows(
        done=done,
        lost=followed.lost,
        q=commanded,
        q_nominal=nearest_turn(robot, start, commanded, within_limits=False),
        branch=torch.as_tensor(branch).expand(len(done)),
        status=torch.where(inside, status, int(Status.OUTSIDE_JOINT_LIMITS)),
        measure=2 - followed.share if learned else torch.full_like(followed.share, torch.nan),
    )


def entries_of(T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "12 poses"]:
    """The upper three rows of matrices, entry by entry, each contiguous over the poses."""
    return T.reshape(-1, 16).T[:12].contiguous()


def as_frame(entries: Float64[Tensor, "12 poses"]) -> Frame:
    """Entries of matrices, row by row, as components."""
    x, y, z, p = ((entries[j], entries[4 + j], entries[8 + j]) for j in range(4))
    return x, y, z, p
