"""A hypothesis of what is wrong with a setup, and the poses that it predicts."""

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.robot.se3 import rotation_vector
from pisigma.validation.held_out.frames.frame_fits import MeasuredPoses
from pisigma.validation.setup_faults.cause import Cause

COLLAPSED = 0.25
"""Share of the errors that is left, at most, where a setup fault explains them."""
FEWEST_SPARE = 6
"""Measured numbers that must be left over beyond what is fitted."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Predicted poses where something is taken to be wrong.

    Attributes:
        q: the joint values that the robot then had [rad or m].
        T: the poses.
        measured: measured poses, in the units that they then have.
        causes: what is wrong.
        fitted: numbers that were fitted.
    """

    q: Float64[Tensor, "rows dof"]
    T: Float64[Tensor, "rows 4 4"]
    measured: MeasuredPoses
    causes: tuple[Cause, ...] = ()
    fitted: int = 0

    @property
    def size(self) -> float:
        """How much is assumed; a frame and a tool together less than both alone, as a new set-up has both."""
        kinds = {cause.kind for cause in self.causes}
        return sum(cause.size for cause in self.causes) - (1 if {"frame", "tool"} <= kinds else 0)

    @property
    def error(self) -> float:
        """Root mean square of the errors [m], as if nothing had been fitted."""
        spare = self.measured.values - self.fitted
        if spare < FEWEST_SPARE:
            return float("inf")
        mean = float(self.measured.squares(self.T).mean()) * self.measured.values / spare
        return float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")

    def rms(self) -> tuple[float, float]:
        """Root mean squares of positions [m] and, NaN where none was measured, of rotations [rad]."""
        position = float((self.measured.position - self.T[:, :3, 3]).square().sum(-1).mean().sqrt())
        R = (self.measured.rotation @ self.T[:, :3, :3].mT)[self.measured.has_rotation]
        return position, float(rotation_vector(R).square().sum(-1).mean().sqrt())

    def without(self, kinds: Set[str]) -> "Hypothesis":
        """Leave causes of some kinds unsaid."""
        return replace(self, causes=tuple(cause for cause in self.causes if cause.kind not in kinds))

    def with_cause(self, cause: Cause, T: Float64[Tensor, "rows 4 4"], fitted: int) -> "Hypothesis":
        """Add a cause, under which the predicted poses are others."""
        return replace(self, T=T, causes=(*self.causes, cause), fitted=self.fitted + fitted)
