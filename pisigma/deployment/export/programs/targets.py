"""Corrected targets: what to command for every wanted pose, and where the robot as drawn stands then."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma import __version__
from pisigma.deployment.export.geometry import condition_remarks, frame_remarks
from pisigma.files.errors import UnreachablePoseError
from pisigma.model.inverse.solution import Solution
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, transform_from_xyzrpy

WITH_TARGET = (Status.REACHED, Status.OUTSIDE_DOMAIN)
"""A pose of any other status gets no target."""

_LISTED = 10


@dataclass(frozen=True, eq=False)
class Targets:
    """One target for each wanted pose, in the order of its file.

    Attributes:
        model: name of the model that they were made with.
        robot: the nominal robot: as drawn, with the base and tool of the model.
        source: the file of poses.
        line: line of every pose in it.
        status: of every pose.
        branch: name of the branch of every target.
        q: corrected joint values [rad or m], NaN where there is no target.
        T: T_base_tool that the nominal robot takes at q, `FK_nominal(q)`, NaN where there is no target. A
            controller that computes with the nominal robot commands q when it is told to go there.
        deviation: predicted standard deviation of the position reached [m]; NaN where it is not known.
        remarks: sentences about the model's frames and conditions.
    """

    model: str
    robot: Robot
    source: str
    line: tuple[int, ...]
    status: tuple[Status, ...]
    branch: tuple[str, ...]
    q: Float64[Tensor, "poses dof"]
    T: Float64[Tensor, "poses 4 4"]
    deviation: Float64[Tensor, " poses"]
    remarks: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Whose targets they are."""
        return (
            f"Corrected targets for {len(self.line)} poses, model {self.model} (robot {self.robot.name}), "
            f"by pisigma {__version__}."
        )

    @property
    def T_root_poses(self) -> Float64[Tensor, "4 4"]:
        """The frame that T is given in, seen from the origin of the robot description."""
        return invert(transform_from_xyzrpy(torch.from_numpy(self.robot.base.copy())))

    @property
    def T_flange_tool(self) -> Float64[Tensor, "4 4"]:
        """The tool that T is of, seen from the last row of the robot description."""
        return transform_from_xyzrpy(torch.from_numpy(self.robot.tool.copy()))

    def lines_with(self, *statuses: Status) -> tuple[int, ...]:
        """The lines of the poses of some statuses."""
        return tuple(line for line, status in zip(self.line, self.status, strict=True) if status in statuses)

    @property
    def failure(self) -> str | None:
        """Which poses have no target, and why; None where all have one."""
        failed = [(n, s) for n, s in zip(self.line, self.status, strict=True) if s not in WITH_TARGET]
        if not failed:
            return None
        line, status = failed[0]
        others = [f"line {n} {s.name.lower()}" for n, s in failed[1:]]
        more = [f"and {len(others) - _LISTED} more"] if len(others) > _LISTED else []
        also = f" (Also: {'; '.join([*others[:_LISTED], *more])}.)" if others else ""
        return f"{self.source}, line {line}: {status.name.lower()}. {status.sentence}{also}"

    @property
    def doubt(self) -> str | None:
        """Which targets lie outside the domain; None where none does."""
        lines = self.lines_with(Status.OUTSIDE_DOMAIN)
        if not lines:
            return None
        named = ", ".join(map(str, lines[:_LISTED])) + (", ..." if len(lines) > _LISTED else "")
        return f"{len(lines)} of {len(self.line)} poses, line {named}: outside_domain. " + (
            Status.OUTSIDE_DOMAIN.sentence
        )

    def check_complete(self) -> None:
        """Refuse targets of which one is missing: a program without it would be another program.

        Raises:
            UnreachablePoseError: a pose has no target; the message names line and status.
        """
        if self.failure:
            raise UnreachablePoseError(f"{self.failure} No program is written while a pose has no target.")


def targets_of(solution: Solution, source: str, line: tuple[int, ...], accuracy: bool = True) -> Targets:
    """Take targets from the corrected inverse kinematics of a file of poses.

    Args:
        solution: of poses in a row, by a model, in torch.
        source: the file.
        line: line of every pose in it.
        accuracy: whether to predict how accurate the targets are, which is slow with a hybrid.
    """
    assert solution.owner is not None, "a solution as it is handed out knows its model"
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
        T=forward_kinematics(model.robot, model.robot.to_dh(q)).where(has_target[:, None, None], torch.nan),
        deviation=deviation.double().where(has_target, torch.nan),
        remarks=(*condition_remarks(model), *frame_remarks(model)),
    )
