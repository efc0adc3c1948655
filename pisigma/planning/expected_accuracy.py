"""How accurate a robot will be after so many poses, what will remain uncertain, and what limits planned images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.estimation.covariance_root import after_values
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.planning.board_views import BoardViews
from pisigma.planning.candidates import Candidates
from pisigma.planning.choice import choose
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.surroundings.arm_in_cell import ArmInCell

RANDOM_CHOICES = 5
"""Poses are drawn at random so often to compare with."""
DRAWS = 100
"""Robots that are drawn from the distribution, for its quantiles."""
MORE = 10
"""Images more."""
EXACT_CORNERS, EXACT_ROBOT = 1e-4, Repeatability(1e-9, 1e-9)
"""[px] Corners, and a robot, that leave nothing."""


@dataclass(frozen=True)
class ExpectedAccuracy:
    """Errors of the tool's position over the task that are expected after so many poses.

    Attributes:
        poses: how many were measured.
        rms: root mean square [m].
        p95: 95 % of the errors are smaller [m].
        random_rms: root mean square after as many poses that are drawn from the candidates at random [m].
    """

    poses: int
    rms: float
    p95: float
    random_rms: float


@dataclass(frozen=True)
class RemainingError:
    """What a group of unknowns does to the error that remains.

    Attributes:
        name: such as "correction of joint 2" or "tool".
        rms: by so much the error over the task would be smaller if the group were certain, `sqrt(rms² - rms'²)` [m].
        share: of the variance.
    """

    name: str
    rms: float
    share: float


def curve(
    B: Float64[Tensor, "candidates values directions"],
    D: Float64[Tensor, "tasks 3 directions"],
    chosen: Int64[Tensor, " chosen"],
    counts: Sequence[int],
    seed: int = 0,
) -> tuple[ExpectedAccuracy, ...]:
    """Predict the accuracy against the number of poses.

    Args:
        B: of the candidates, before the first of them is measured; see `Knowledge.measured`.
        D: of the poses where the robot shall be accurate; see `Knowledge.tool`.
        chosen: numbers of candidates, in their order.
        counts: numbers of poses.
        seed: of the random choices.
    """
    generator = torch.Generator().manual_seed(seed)
    orders = [torch.randperm(len(B), generator=generator) for _ in range(RANDOM_CHOICES)]
    points = []
    for count in counts:
        after = after_values(D, B[chosen[:count]].flatten(0, 1))
        random = torch.stack(
            [after_values(D, B[order[:count]].flatten(0, 1)).square().sum() for order in orders]
        )
        points.append(
            ExpectedAccuracy(
                count, rms_of(after), p95_of(after, seed), float((random.mean() / len(D)).sqrt())
            )
        )
    return tuple(points)


def rms_of(D: Float64[Tensor, "tasks 3 directions"]) -> float:
    """Root mean square of the position's error over the task [m]; for D see `Knowledge.tool`."""
    return float((D.square().sum() / len(D)).sqrt())


def p95_of(D: Float64[Tensor, "tasks 3 directions"], seed: int = 0) -> float:
    """95 % of the position errors over the task are smaller [m], by `DRAWS` robots of the distribution."""
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randn(D.shape[2], DRAWS, generator=generator, dtype=D.dtype)
    return float(torch.quantile((D @ numbers).norm(dim=1).flatten(), 0.95))


def remaining_errors(knowledge: Knowledge, task: Float64[Tensor, "tasks dof"]) -> tuple[RemainingError, ...]:
    """Say what the error that remains comes from, the largest first.

    With D as in `Knowledge.tool` and R_g the rows of the root that belong to a group, the group's certainty would take
    the projection of D on the directions of R_g away (conditioning of a normal distribution).
    """
    known = knowledge.uncertainty
    D, root, total = knowledge.tool(task), known.root, rms_of(knowledge.tool(task)) ** 2
    errors = []
    for name, rows in _groups(knowledge).items():
        # Directions in which the group hardly varies are rounding.
        _, sizes, vectors = torch.linalg.svd(root[rows], full_matrices=False)
        taken = D @ vectors[sizes > 1e-9 * sizes.max().clamp(min=1e-300)].t()
        square = float(taken.square().sum() / len(D))
        errors.append(RemainingError(name, square**0.5, square / max(total, 1e-300)))
    return tuple(sorted(errors, key=lambda error: -error.rms))


def _groups(knowledge: Knowledge) -> dict[str, list[int]]:
    """Numbers of the unknowns by name of their group."""
    known = knowledge.uncertainty
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
    """Errors that are expected of planned images, and would be expected if one thing were better.

    Attributes:
        rms: root mean square of the position's error over the task [m].
        more_images: the same with `MORE` images more [m].
        exact_corners: with corners without noise [m].
        exact_robot: with a robot that repeats exactly [m].
        room: by how much the board may stand aside of where the cell has it before it leaves an image [m].
        unidentifiable: parameters of the arm that only a further sensor identifies, a sentence each.
    """

    rms: float
    more_images: float
    exact_corners: float
    exact_robot: float
    room: float
    unidentifiable: tuple[str, ...]

    @staticmethod
    def of(
        knowledge: Knowledge,
        candidates: Candidates,
        chosen: Int64[Tensor, " chosen"],
        task: Float64[Tensor, "tasks dof"],
        views: BoardViews,
        arm: ArmInCell,
    ) -> "CameraProspects":
        """Predict them.

        Args:
            knowledge: before the first image.
            candidates: views of the board.
            chosen: numbers of the planned ones.
            task: joint values [rad or m] where the robot shall be accurate.
            views: that the candidates are of.
            arm: the robot in its cell.
        """
        q, sight = candidates.q[chosen], views.sight

        def rms(better: Knowledge) -> float:
            return rms_of(better.informed(q).tool(task))

        def seen_by(corner_noise: float, repeatability: Repeatability) -> Knowledge:
            better = replace(sight, corner_noise=corner_noise, repeatability=repeatability)
            return replace(knowledge, instrument=replace(knowledge.instrument, sight=better))

        after = knowledge.informed(q)
        others = torch.ones(len(candidates.q), dtype=torch.bool)
        others[chosen] = False
        left = candidates.q[others]
        more = (
            left[choose(after.measured(left), after.tool(task), min(MORE, len(left)))] if len(left) else left
        )
        return CameraProspects(
            rms_of(after.tool(task)),
            rms_of(after.informed(more).tool(task)) if len(more) else rms_of(after.tool(task)),
            rms(seen_by(EXACT_CORNERS, sight.repeatability)),
            rms(seen_by(sight.corner_noise, EXACT_ROBOT)),
            float(views.room(arm, q).min()),
            _unidentifiable(arm, sight.is_fixed),
        )

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values."""
        names = ("more_images", "exact_corners", "exact_robot")
        figures = {f"{name}_rms_mm": getattr(self, name) * 1e3 for name in names}
        return {**figures, "room_mm": self.room * 1e3, "sentences": list(self.sentences)}

    @property
    def sentences(self) -> tuple[str, ...]:
        """What limits the result, what is not identifiable, and how exactly the board has to stand."""
        better = {
            f"{MORE} more images": self.more_images,
            "corners without noise": self.exact_corners,
            "a robot that repeats exactly": self.exact_robot,
        }
        limits = dict(zip(better, ("the number of images", "the camera", "the repeatability"), strict=True))
        what = limits[min(better, key=lambda name: better[name])]
        changes = ", ".join(f"{name} to {rms * 1e3:.3f} mm" for name, rms in better.items())
        return (
            f"The RMS of {self.rms * 1e3:.3f} mm would come down by {changes}: {what} limits it most.",
            *self.unidentifiable,
            "All lengths rest on the board: squares 0.1 % too large make the robot 0.1 % too large, which only a known "
            "distance shows.",
            f"The board leaves the first image where it or the camera is {self.room * 1e3:.0f} mm off what the cell "
            "says; a larger margin_px leaves more room.",
        )


def _unidentifiable(arm: ArmInCell, is_fixed: bool) -> tuple[str, ...]:
    """A pose of the target behind the last joint takes up all errors of its row, and the frame those along axis 1."""
    frame, target = ("camera", "board") if is_fixed else ("board", "camera")
    first, last = arm.robot.joint_rows[0] + 1, arm.robot.joint_rows[-1] + 1
    return (
        f"Images do not tell theta_{last}, d_{last}, a_{last} and alpha_{last} from where the {target} is on the "
        f"flange, nor theta_{first} and d_{first} from where the {frame} stands; only a further constraint does.",
    )
