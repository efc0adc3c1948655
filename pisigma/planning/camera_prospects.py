"""What will limit a calibration with planned images, and what they cannot say."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.planning.board_views import BoardViews
from pisigma.planning.candidates import Candidates
from pisigma.planning.choice import choose
from pisigma.planning.expected_accuracy import rms_of
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.surroundings.arm_in_cell import ArmInCell

MORE = 10
"""Images more."""
EXACT_CORNERS, EXACT_ROBOT = 1e-4, Repeatability(1e-9, 1e-9)
"""[px] Corners, and a robot, that leave nothing."""


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
