"""Interface of the checks of rows against a model, and the rows as they see them."""

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import deviation_of_rows
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fit_frames, with_names_of
from pisigma.validation.setup_faults.setup_fault import SetupFault
from pisigma.validation.setup_faults.setup_faults import find_setup_faults, judged_values

Move = Literal["frame", "tool", "joint_zero"]
"""What may have moved since a model was made; see the kinds of `Cause`."""
MOVES: Final[frozenset[Move]] = frozenset({"frame", "tool", "joint_zero"})
LARGE_SHARE = 2e-3
"""Errors as a share of the reach above which a mistake or a motion is their cause, and not wear."""
STEP = 1e-6
"""[rad or m] Step of the finite differences by joint values."""
FITTED = 9
"""Number of parameters of a base and of the position of a tool."""
MIN_ROWS = 5
"""Rows with positions that a check needs."""


@dataclass(frozen=True, eq=False)
class RowsUnderModel:
    """Rows with positions, and the predictions of a model for them.

    Attributes:
        model: the model.
        rows: the rows.
        fitted: what is known to have moved and is therefore fitted to the rows.
        may_move: what else may have moved without being a fault.
        nominal: the nominal robot with base and tool fitted; only used to report its errors after a correction.
    """

    model: CalibratedModel
    rows: Measurements
    fitted: tuple[FrameKind, ...]
    may_move: frozenset[Move]
    nominal: CalibratedModel | None = None

    @staticmethod
    def from_rows(
        model: CalibratedModel,
        rows: Measurements,
        fitted: Collection[FrameKind],
        may_move: Collection[Move],
        nominal: CalibratedModel | None = None,
    ) -> "RowsUnderModel | None":
        """Select the rows that have a measured and a predicted position; None if there are too few.

        Frames and targets that the model does not have are fitted.
        """
        if rows.position is None:
            return None
        kinds = kinds_to_fit(model, rows, fitted)
        some = judged_values(model, rows)
        T = poses_of_rows(model, with_names_of(model, some, kinds))
        there = torch.isfinite(rows.position).all(-1) & torch.isfinite(T).flatten(1).all(-1)
        if int(there.sum()) < MIN_ROWS:
            return None
        some = replace(some.select(there), pair=None, distance=None)
        return RowsUnderModel(model, some, kinds, frozenset(may_move), nominal)

    @cached_property
    def known(self) -> Measurements:
        """The rows, with fitted frames and targets named as in the model."""
        return with_names_of(self.model, self.rows, self.fitted)

    @cached_property
    def unfitted(self) -> Float64[Tensor, "rows 4 4"]:
        """Predicted poses before anything is fitted."""
        return poses_of_rows(self.model, self.known)

    @cached_property
    def predicted(self) -> Float64[Tensor, "rows 4 4"]:
        """Predicted poses, after fitting."""
        return (
            fit_frames(self.unfitted, self.measured, self.rows, self.fitted)[0]
            if self.fitted
            else self.unfitted
        )

    @cached_property
    def measured(self) -> MeasuredPoses:
        """The measured poses."""
        return MeasuredPoses.from_tensors(
            self.rows.position, self.rows.rotation, LEVER_SHARE * self.model.robot.reach
        )

    @cached_property
    def errors(self) -> Float64[Tensor, " rows"]:
        """Lengths of the position errors [m]."""
        return self.lengths(self.predicted)

    def lengths(self, T: Float64[Tensor, "rows 4 4"]) -> Float64[Tensor, " rows"]:
        """Compute the lengths of the position errors of predicted poses [m]."""
        result: Tensor = (self.measured.position - T[:, :3, 3]).norm(dim=-1)
        return result

    @cached_property
    def usual(self) -> Float64[Tensor, " rows"]:
        """Standard deviation of every row's error by the model's posterior and noise [m]; NaN if it has none."""
        deviation = deviation_of_rows(self.model, self.known).square().sum(-1)
        known = self.model.uncertainty
        noise = torch.as_tensor(math.nan if known is None else _position_noise(known.noise))
        if known is not None and self.rows.sigma_position is not None:
            factor = known.noise.value.get("position", 1.0) if known.noise.is_factor("position") else 1.0
            noise = torch.where(self.rows.sigma_position.isnan(), noise, factor * self.rows.sigma_position)
        result: Tensor = (deviation + 3 * noise.square()).sqrt()
        return result

    @cached_property
    def large(self) -> bool:
        """Whether the errors of positions and orientations are too large for wear."""
        error = float(self.measured.squares(self.predicted).mean().sqrt())
        return error > LARGE_SHARE * self.model.robot.reach

    @cached_property
    def setup_faults(self) -> tuple[SetupFault, ...]:
        """Setup faults that explain the errors of all rows, of any size."""
        return find_setup_faults(self.model, self.nominal, self.rows, self.fitted)

    @cached_property
    def moved_frames(self) -> tuple[SetupFault, ...]:
        """Motions of frames and tools of any size that explain the errors."""
        return find_setup_faults(self.model, self.nominal, self.rows, self.fitted, frames_only=True)

    def is_move(self, fault: SetupFault) -> bool:
        """Say whether a fault is an allowed motion: of frames, tools, or the zero of a single joint."""
        return self.may_move.issuperset(fault.kinds) and len(set(fault.joints)) <= 1


class AbstractRowCheck(ABC):
    """A check of rows for one kind of fault, by the predictions of a model."""

    @abstractmethod
    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """Report faults; yield nothing if none is found."""


def kinds_to_fit(
    model: CalibratedModel, rows: Measurements, fitted: Collection[FrameKind]
) -> tuple[FrameKind, ...]:
    """Add frames and tools to what is fitted, if rows have some that a model does not have."""
    new: tuple[FrameKind, ...] = (
        *(("base",) if _unknown(rows.frame, model.bases) else ()),
        *(("tool",) if _unknown(rows.target, model.tools) else ()),
    )
    return tuple(dict.fromkeys((*fitted, *new)))


def _unknown(names: tuple[str, ...], known: Collection[str]) -> bool:
    """Say whether a frame or target is unknown to a model, see `pisigma.model.calibrated_model.known_names`."""
    if not set(known) - {""}:
        return len(set(names)) > 1
    return not set(names) <= set(known) and not (len(known) == 1 and not any(names))


def _position_noise(noise: CalibrationNoise) -> float:
    """Return the noise of a coordinate [m]; 0 where the calibration had no positions, NaN where it is not known."""
    return noise.absolute("position") if "position" in noise.value else 0.0
