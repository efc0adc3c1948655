"""Random poses in a region with the inverse kinematics solutions of a calibrated model, to distil the model."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import singularity_measure
from pisigma.robot.kinematics.joint_limits import wrapped_difference
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE
from pisigma.robot.se3 import wrap_to_pi

SINGULAR_BELOW = 0.05
"""Nominal `singularity_measure` below which poses are refused, because corrections are steep near singularities."""

_POSES_PER_CHUNK = 2_000
"""Number of poses that are solved between two reports of progress."""

_MAX_TRIES = 20
"""Number of random poses per reachable pose above which a region is refused."""

_SAME_BRANCH = 0.05
"""Largest distance of a nominal solution from the drawn joint values [rad or m]; a solution farther away is on
another branch."""

Box = tuple[float, float, float, float, float, float]
"""x_min, x_max, y_min, y_max, z_min, z_max [m] in the frame of the measurements."""


@dataclass(frozen=True, eq=False)
class Region:
    """Region in which random poses are drawn.

    Attributes:
        joint_values: joint values [rad or m]; poses are drawn between a row and its neighbours.
        box: bounds of the tool's position, with orientations from nearby joint values; None for no bounds.
    """

    joint_values: Float64[Tensor, "rows dof"]
    box: Box | None = None


@dataclass(frozen=True, eq=False)
class SolvedPoses:
    """Poses with the full inverse kinematics solution of a model.

    Attributes:
        T: poses T_base_tool.
        q_nominal: joint values of the nominal robot [rad or m].
        correction: correction of these joint values by the full solution [rad or m].
        branch: index of the branch of every pose.
        status: status of the full solution: REACHED, or OUTSIDE_DOMAIN beyond the measured joint values.
        drawn_count: number of poses that were drawn.
        refused: number of poses that were refused, by reason.
    """

    T: Float64[Tensor, "poses 4 4"]
    q_nominal: Float64[Tensor, "poses dof"]
    correction: Float64[Tensor, "poses dof"]
    branch: Int64[Tensor, " poses"]
    status: Int64[Tensor, " poses"]
    drawn_count: int
    refused: dict[str, int]

    def select(self, rows: slice) -> "SolvedPoses":
        """Return some of the poses; `drawn` and `refused` still count all poses."""
        T, q_nominal, correction = self.T[rows], self.q_nominal[rows], self.correction[rows]
        return SolvedPoses(
            T, q_nominal, correction, self.branch[rows], self.status[rows], self.drawn_count, self.refused
        )


def draw_solved_poses(
    ik: CorrectedIK,
    region: Region,
    count: int,
    generator: torch.Generator,
    progress: Progress = lambda what: None,
) -> SolvedPoses:
    """Draw poses until enough of them are solved.

    Args:
        ik: corrected inverse kinematics of the model.
        region: region of the poses.
        count: number of solved poses.
        generator: random generator.
        progress: called with the number of solved poses.

    Raises:
        IdentificationError: the robot reaches too few poses of the region; the message states the reasons.
    """
    kept: list[tuple[Tensor, ...]] = []
    refused: dict[str, int] = {}
    drawn = have = 0
    while have < count:
        some = min(_POSES_PER_CHUNK, 2 * count)
        parts, reasons = _solve(ik, region, some, generator)
        kept.append(parts)
        drawn, have = drawn + some, have + len(parts[0])
        refused = {name: refused.get(name, 0) + number for name, number in reasons.items()}
        if _MAX_TRIES * have < drawn:
            raise _too_few(ik, region, have, drawn, refused)
        progress(f"{min(have, count)} of {count} poses solved")
    T, q_nominal, correction, branch, status = (torch.cat(part)[:count] for part in zip(*kept, strict=True))
    return SolvedPoses(T, q_nominal, correction, branch, status, drawn, refused)


def draw_between(
    robot: Robot, q: Float64[Tensor, "rows dof"], count: int, generator: torch.Generator
) -> Float64[Tensor, "drawn dof"]:
    """Draw joint values between a row of q and its neighbours, as means with random weights.

    The neighbours are `dof` rows, drawn from the 2 `dof` nearest rows. Revolute joints are compared and interpolated
    along the shorter arc.
    """
    first = torch.randint(len(q), (count,), generator=generator)
    nearby = min(2 * robot.dof, len(q) - 1)
    if not nearby:
        return q[first]
    turning = torch.tensor(robot.revolute)
    neighbours = []
    for part in torch.split(q, 256):
        way = q - part[:, None]
        way = torch.where(turning, wrap_to_pi(way), way / (robot.reach or 1.0))
        neighbours.append(way.norm(dim=-1).topk(nearby + 1, largest=False).indices[:, 1:])
    order = torch.rand(count, nearby, generator=generator).argsort(-1)[:, : robot.dof]
    others = torch.cat(neighbours)[first].gather(1, order)
    way = wrapped_difference(robot, q[others], q[first][:, None])
    # normalised exponential variables are uniform over the simplex; their squares concentrate at the corners (rows)
    weight = torch.rand(count, way.shape[1] + 1, generator=generator, dtype=torch.float64).log().square()
    weight = weight / weight.sum(-1, keepdim=True)
    return q[first] + (weight[:, 1:, None] * way).sum(1)


def _solve(
    ik: CorrectedIK, region: Region, count: int, generator: torch.Generator
) -> tuple[tuple[Tensor, ...], dict[str, int]]:
    """Draw `count` poses; return the solved poses and the number of refused poses by reason."""
    robot = ik.model.robot
    q = draw_between(robot, region.joint_values, count, generator)
    T = forward_kinematics(robot, q)
    if region.box is None:
        solution = ik(T, near=q)
    else:
        low, high = T.new_tensor(region.box[::2]), T.new_tensor(region.box[1::2])
        T[:, :3, 3] = low + (high - low) * torch.rand(count, 3, generator=generator, dtype=T.dtype)
        solution = ik(T)
    nominal = solution.q_nominal
    lost = (solution.status == Status.UNREACHABLE) | ~torch.isfinite(nominal).all(-1)
    safe = torch.where(lost[:, None], q, nominal)
    limits = torch.from_numpy(robot.limits)
    outside = (safe < limits[:, 0] - LIMIT_TOLERANCE) | (safe > limits[:, 1] + LIMIT_TOLERANCE)
    away = (safe - q).abs().amax(-1) > _SAME_BRANCH if region.box is None else torch.zeros_like(lost)
    reasons = {
        "unreachable": lost,
        "outside the joint limits": outside.any(-1) | (solution.status == Status.OUTSIDE_JOINT_LIMITS),
        "singular": (singularity_measure(robot, safe) < SINGULAR_BELOW)
        | (solution.status == Status.SINGULAR),
        "on another branch": away,
    }
    counts, good = {}, torch.ones_like(lost)
    for name, bad in reasons.items():
        counts[name] = int((good & bad).sum())
        good = good & ~bad
    parts = (T, nominal, solution.q - nominal, solution.branch, solution.status)
    return tuple(part[good] for part in parts), counts


def _too_few(
    ik: CorrectedIK, region: Region, have: int, drawn: int, refused: dict[str, int]
) -> IdentificationError:
    """Return the error that the robot reaches too few poses of the region."""
    reasons = ", ".join(f"{number} {name}" for name, number in refused.items() if number)
    where = "around the stated joint values"
    if region.box is not None:
        low, high = (", ".join(f"{value * 1e3:g}" for value in region.box[i::2]) for i in (0, 1))
        where = f"between ({low}) and ({high}) mm"
    return IdentificationError(
        f"robot '{ik.model.robot.name}' reaches only {have} of {drawn} random poses {where} ({reasons})",
        value={name: number for name, number in refused.items() if number},
        remedy="choose a region that it reaches, in the frame of the measurements, with the orientations of the "
        "measured poses",
    )
