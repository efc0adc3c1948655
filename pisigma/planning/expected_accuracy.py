"""Expected accuracy after measuring poses, sources of the remaining error, and limits of planned images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.estimation.covariance_root import multiply_updated_root
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.planning.board_views import ViewConditions
from pisigma.planning.candidates import Candidates
from pisigma.planning.pose_selection import select_poses
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings

_RANDOM_SELECTIONS = 5
"""Number of random selections of poses with which a plan is compared."""
DRAWS = 100
"""Number of robots that are drawn from the posterior to compute quantiles."""
DRAWS_AT_POSE = 1_000
"""Number of robots that are drawn for the quantile at a single pose, which then scatters by 2 %."""
_MORE_IMAGES = 10
"""Number of additional images whose benefit is predicted."""
_EXACT_CORNERS, _EXACT_ROBOT = 1e-4, Repeatability(1e-9, 1e-9)
"""Noise of corners [px] and repeatability of a robot that are too small to contribute to the error."""


@dataclass(frozen=True)
class ExpectedAccuracy:
    """Expected errors of the tool's position over the task after measuring a number of poses.

    Attributes:
        poses: number of measured poses.
        rms: root mean square [m].
        p95: 95 % quantile [m].
        random_rms: root mean square after the same number of random usable candidates [m].
    """

    poses: int
    rms: float
    p95: float
    random_rms: float


@dataclass(frozen=True)
class RemainingError:
    """Contribution of a group of unknowns to the remaining error.

    Attributes:
        name: name of the group, such as "correction of joint 2" or "tool".
        rms: contribution to the RMS error over the task, `sqrt(rms² - rms'²)` with the error rms' if the group were
            known exactly [m].
        variance_share: share of the variance.
    """

    name: str
    rms: float
    variance_share: float


def accuracy_curve(
    candidate_derivatives: Float64[Tensor, "candidates values directions"],
    task_derivatives: Float64[Tensor, "tasks 3 directions"],
    chosen: Int64[Tensor, " chosen"],
    counts: Sequence[int],
    seed: int = 0,
    usable: Int64[Tensor, " usable"] | None = None,
) -> tuple[ExpectedAccuracy, ...]:
    """Predict the accuracy as a function of the number of poses.

    Args:
        candidate_derivatives: derivatives B of the measured values of the candidates under the prior; see
            `RobotPosterior.sensitivities`.
        task_derivatives: derivatives D of the tool's position over the task; see `RobotPosterior.tool_derivatives`.
        chosen: indices of the selected candidates, in their order.
        counts: numbers of poses.
        seed: random seed of the random selections.
        usable: indices of the candidates from which random poses are selected; None for all.
    """
    generator = torch.Generator().manual_seed(seed)
    usable = torch.arange(len(candidate_derivatives)) if usable is None else usable
    orders = [usable[torch.randperm(len(usable), generator=generator)] for _ in range(_RANDOM_SELECTIONS)]
    points = []
    for count in counts:
        after = multiply_updated_root(task_derivatives, candidate_derivatives[chosen[:count]].flatten(0, 1))
        random = torch.stack(
            [
                multiply_updated_root(task_derivatives, candidate_derivatives[order[:count]].flatten(0, 1))
                .square()
                .sum()
                for order in orders
            ]
        )
        points.append(
            ExpectedAccuracy(
                count,
                rms_of(after),
                p95_of(after, seed),
                float((random.mean() / len(task_derivatives)).sqrt()),
            )
        )
    return tuple(points)


def rms_of(task_derivatives: Float64[Tensor, "tasks 3 directions"]) -> float:
    """Compute the RMS position error over the task [m] from the derivatives D of `RobotPosterior.tool_derivatives`."""
    return float((task_derivatives.square().sum() / len(task_derivatives)).sqrt())


def p95_of(task_derivatives: Float64[Tensor, "tasks 3 directions"], seed: int = 0) -> float:
    """Compute the 95 % quantile of the position errors over the task [m] from `DRAWS` robots of the posterior."""
    return float(torch.quantile(_drawn_errors(task_derivatives, DRAWS, seed).flatten(), 0.95))


def p95_by_pose(
    task_derivatives: Float64[Tensor, "tasks 3 directions"], seed: int = 0
) -> Float64[Tensor, " tasks"]:
    """Compute the 95 % quantile of the position error at each pose [m] from `DRAWS_AT_POSE` robots of the posterior."""
    return _drawn_errors(task_derivatives, DRAWS_AT_POSE, seed).quantile(0.95, dim=1)


def _drawn_errors(
    D: Float64[Tensor, "tasks 3 directions"], draws: int, seed: int
) -> Float64[Tensor, "tasks draws"]:
    """Return the position errors of robots that are drawn from the posterior [m]."""
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randn(D.shape[2], draws, generator=generator, dtype=D.dtype)
    errors: Tensor = (D @ numbers).norm(dim=1)
    return errors


def remaining_errors(
    posterior: RobotPosterior, task: Float64[Tensor, "tasks dof"]
) -> tuple[RemainingError, ...]:
    """Compute the contributions of groups of unknowns to the remaining error, largest first.

    With D as in `RobotPosterior.tool_derivatives` and R_g the rows of the root that belong to a group, knowing the
    group exactly would remove the projection of D on the directions of R_g (conditioning of a normal distribution).
    """
    known = posterior.uncertainty
    D, root = posterior.tool_derivatives(task), known.dense_root
    total = rms_of(D) ** 2
    errors = []
    for name, rows in _groups(posterior).items():
        # directions in which the group hardly varies are rounding errors
        _, sizes, vectors = torch.linalg.svd(root[rows], full_matrices=False)
        taken = D @ vectors[sizes > 1e-9 * sizes.max().clamp(min=1e-300)].t()
        square = float(taken.square().sum() / len(D))
        errors.append(RemainingError(name, square**0.5, square / max(total, 1e-300)))
    return tuple(sorted(errors, key=lambda error: -error.rms))


def _groups(posterior: RobotPosterior) -> dict[str, list[int]]:
    """Return the indices of the unknowns of every group, by the name of the group."""
    known = posterior.uncertainty
    names = {"theta": "joint offsets", "d": "link lengths", "a": "link lengths"}
    names |= {"alpha": "angles between axes", "beta": "angles between axes"}
    groups: dict[str, list[int]] = {}
    for index, parameter in enumerate(known.space.parameters):
        groups.setdefault(names.get(parameter.group, parameter.group), []).append(index)
    index = len(known.space.parameters)
    for feature in known.features:
        for joint in feature.used.nonzero()[:, 0].tolist():
            groups.setdefault(f"correction of joint {joint + 1}", []).append(index)
            index += 1
    return groups


@dataclass(frozen=True)
class CameraProspects:
    """Expected error with the planned images, and the errors expected if one condition were better.

    Attributes:
        rms: RMS position error over the task [m].
        rms_with_more_images: RMS error with `_MORE_IMAGES` more images [m].
        rms_with_exact_corners: RMS error with corners without noise [m].
        rms_with_exact_robot: RMS error with a robot that repeats exactly [m].
        allowed_board_displacement: largest distance of the board from its stated place at which it does not leave an
            image [m].
        unidentifiable: parameters of the arm that images cannot identify, one sentence each.
    """

    rms: float
    rms_with_more_images: float
    rms_with_exact_corners: float
    rms_with_exact_robot: float
    allowed_board_displacement: float
    unidentifiable: tuple[str, ...]

    @staticmethod
    def from_candidates(
        posterior: RobotPosterior,
        candidates: Candidates,
        chosen: Int64[Tensor, " chosen"],
        task: Float64[Tensor, "tasks dof"],
        views: ViewConditions,
        arm: ArmInSurroundings,
    ) -> "CameraProspects":
        """Return the predicted errors of the planned images.

        Args:
            posterior: unknowns of the robot before the first image.
            candidates: views of the board.
            chosen: indices of the planned views.
            task: joint values where the robot must be accurate [rad or m].
            views: conditions under which the camera sees the board.
            arm: the robot in its surroundings.
        """
        q, sight = candidates.q[chosen], views.sight

        def rms(better: RobotPosterior) -> float:
            return rms_of(better.after_measuring(q).tool_derivatives(task))

        def posterior_with(corner_noise: float, repeatability: Repeatability) -> RobotPosterior:
            better = replace(sight, corner_noise=corner_noise, repeatability=repeatability)
            return replace(posterior, instrument=replace(posterior.instrument, sight=better))

        after = posterior.after_measuring(q)
        others = torch.ones(len(candidates.q), dtype=torch.bool)
        others[chosen] = False
        left = candidates.q[others]
        more = (
            left[
                select_poses(
                    after.sensitivities(left), after.tool_derivatives(task), min(_MORE_IMAGES, len(left))
                )
            ]
            if len(left)
            else left
        )
        return CameraProspects(
            rms_of(after.tool_derivatives(task)),
            rms_of(after.after_measuring(more).tool_derivatives(task))
            if len(more)
            else rms_of(after.tool_derivatives(task)),
            rms(posterior_with(_EXACT_CORNERS, sight.repeatability)),
            rms(posterior_with(sight.corner_noise, _EXACT_ROBOT)),
            float(views.board_shift_margin(arm, q).min()),
            _unidentifiable(arm, sight.is_fixed),
        )

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values."""
        names = ("more_images", "exact_corners", "exact_robot")
        figures = {f"{name}_rms_mm": getattr(self, f"rms_with_{name}") * 1e3 for name in names}
        return {
            **figures,
            "room_mm": self.allowed_board_displacement * 1e3,
            "sentences": list(self.sentences),
        }

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about the limits of the accuracy, unidentifiable parameters, and how exactly to place the board."""
        better = {
            f"{_MORE_IMAGES} more images": self.rms_with_more_images,
            "corners without noise": self.rms_with_exact_corners,
            "a robot that repeats exactly": self.rms_with_exact_robot,
        }
        limits = dict(zip(better, ("the number of images", "the camera", "the repeatability"), strict=True))
        what = limits[min(better, key=lambda name: better[name])]
        changes = ", ".join(f"{name} to {rms * 1e3:.3f} mm" for name, rms in better.items())
        return (
            f"The RMS position error of {self.rms * 1e3:.3f} mm would fall with {changes}; {what} limits it most.",
            *self.unidentifiable,
            "The scale comes from the board alone: squares 0.1 % too large make the robot 0.1 % too large, which only "
            "a known distance reveals.",
            f"The board leaves the first image if it or the camera is {self.allowed_board_displacement * 1e3:.0f} mm "
            "from its place in the surroundings; a larger margin_px allows more.",
        )


def _unidentifiable(arm: ArmInSurroundings, is_fixed: bool) -> tuple[str, ...]:
    """Return sentences about the parameters that the unknown target and frame absorb."""
    frame, target = ("camera", "board") if is_fixed else ("board", "camera")
    first, last = arm.robot.joint_rows[0] + 1, arm.robot.joint_rows[-1] + 1
    return (
        f"In images, theta_{last}, d_{last}, a_{last} and alpha_{last} cannot be distinguished from the pose of the "
        f"{target} on the flange, nor theta_{first} and d_{first} from the pose of the {frame}; only a further "
        "constraint identifies them.",
    )
