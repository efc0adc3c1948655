"""Corrected targets: joint values for every requested pose, and the nominal robot's poses at these joint values."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma import __version__
from pisigma.deployment.export.geometry import pose_remarks
from pisigma.files.errors import UnreachablePoseError
from pisigma.model.inverse.solution import Solution
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, transform_from_xyz_zyx

WITH_TARGET = (Status.REACHED, Status.OUTSIDE_DOMAIN)
"""Statuses of poses that have a target."""

_LISTED = 10


@dataclass(frozen=True, eq=False)
class Targets:
    """One target for each requested pose, in the order of its file.

    Attributes:
        model: name of the model.
        robot: nominal robot with the base and tool of the model.
        source: file of the poses.
        line: line of every pose in this file.
        status: status of every pose.
        branch: name of the branch of every target.
        q: corrected joint values [rad or m], NaN without a target.
        T_nominal: pose T_base_tool of the nominal robot at q, `FK_nominal(q)`, NaN without a target. A controller that
            computes with the nominal robot commands q for this pose.
        sigma: predicted standard deviation of the reached position [m]; NaN if it is not known.
        remarks: sentences about the model's frames and conditions.
    """

    model: str
    robot: Robot
    source: str
    line: tuple[int, ...]
    status: tuple[Status, ...]
    branch: tuple[str, ...]
    q: Float64[Tensor, "poses dof"]
    T_nominal: Float64[Tensor, "poses 4 4"]
    sigma: Float64[Tensor, " poses"]
    remarks: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Title of files with the targets."""
        return (
            f"Corrected targets for {len(self.line)} poses, model {self.model} (robot {self.robot.name}), "
            f"by pisigma {__version__}."
        )

    @property
    def T_root_poses(self) -> Float64[Tensor, "4 4"]:
        """Pose of the frame of T relative to the origin of the robot description."""
        return invert(transform_from_xyz_zyx(torch.from_numpy(self.robot.base.copy())))

    @property
    def T_flange_tool(self) -> Float64[Tensor, "4 4"]:
        """Pose of the tool of T relative to the last row of the robot description."""
        return transform_from_xyz_zyx(torch.from_numpy(self.robot.tool.copy()))

    def lines_with_status(self, *statuses: Status) -> tuple[int, ...]:
        """Return the lines of the poses with the given statuses."""
        return tuple(line for line, status in zip(self.line, self.status, strict=True) if status in statuses)

    @property
    def failure_sentence(self) -> str | None:
        """Return a sentence on poses without a target, with the reasons; None if all poses have targets."""
        failed = [(n, s) for n, s in zip(self.line, self.status, strict=True) if s not in WITH_TARGET]
        if not failed:
            return None
        line, status = failed[0]
        others = [f"line {n} {s.name.lower()}" for n, s in failed[1:]]
        more = [f"and {len(others) - _LISTED} more"] if len(others) > _LISTED else []
        also = f" (Also: {'; '.join([*others[:_LISTED], *more])}.)" if others else ""
        return f"{self.source}, line {line}: {status.name.lower()}. {status.sentence}{also}"

    @property
    def domain_warning(self) -> str | None:
        """Sentence on targets outside the domain; None if there are no such targets."""
        lines = self.lines_with_status(Status.OUTSIDE_DOMAIN)
        if not lines:
            return None
        named = ", ".join(map(str, lines[:_LISTED])) + (", ..." if len(lines) > _LISTED else "")
        return f"{len(lines)} of {len(self.line)} poses, line {named}: outside_domain. " + (
            Status.OUTSIDE_DOMAIN.sentence
        )

    def check_complete(self) -> None:
        """Check that no target is missing, because a program must not skip targets.

        Raises:
            UnreachablePoseError: a pose has no target; the message states line and status.
        """
        if self.failure_sentence:
            raise UnreachablePoseError(f"{self.failure_sentence} A program requires targets for all poses.")


def targets_of(solution: Solution, source: str, line: tuple[int, ...], accuracy: bool = True) -> Targets:
    """Return the targets of solutions of the corrected inverse kinematics for a file of poses.

    Args:
        solution: solutions of a model for poses with one batch axis, as tensors.
        source: file of the poses.
        line: line of every pose in this file.
        accuracy: whether to predict the accuracy of the targets, which is slow for a hybrid.
    """
    assert solution.owner is not None, "a public solution has an owner"
    model = solution.owner.model
    status = tuple(Status(value) for value in solution.status.tolist())
    has_target = torch.tensor([s in WITH_TARGET for s in status])
    deviation = torch.as_tensor(solution.accuracy) if accuracy else torch.full(has_target.shape, torch.nan)
    q = solution.q.detach().to("cpu", torch.float64).where(has_target[:, None], torch.nan)
    return Targets(
        model=model.name,
        robot=model.robot,
        source=source,
        line=line,
        status=status,
        branch=tuple(solution.branches[index] for index in solution.branch.tolist()),
        q=q,
        T_nominal=forward_kinematics(model.robot, model.robot.to_dh(q)).where(
            has_target[:, None, None], torch.nan
        ),
        sigma=deviation.double().where(has_target, torch.nan),
        remarks=pose_remarks(model),
    )
