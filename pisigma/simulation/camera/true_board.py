"""A true board: larger or smaller than given, and bowed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.pattern import Pattern, board_pattern


@dataclass(frozen=True)
class TrueBoard:
    """A printed board that differs from the given one.

    Its surface is `z = bow · r² / R²` with r the distance from the centre of the corners and R that of the farthest.

    Attributes:
        stated: the given board.
        scale: true lengths relative to given ones.
        bow: height of the farthest corners above the plane at the centre [m], along z.
    """

    stated: Board
    scale: float = 1.0
    bow: float = 0.0

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """True positions of the corners in the board's frame [m]."""
        flat = self.scale * self.stated.corners[:, :2]
        return np.concatenate([flat, self.height(flat)[:, None]], 1)

    @property
    def pattern(self) -> Pattern:
        """The printed pattern, at its true size."""
        stated = board_pattern(self.stated)
        return Pattern(self.scale * stated.black, self.scale * stated.sheet)

    def height(self, xy: Float64[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch"]:
        """Return z of the surface [m] at points of the plane [m]."""
        corners = self.scale * self.stated.corners[:, :2]
        middle = corners.mean(0)
        farthest = np.square(corners - middle).sum(1).max()
        z: np.ndarray = self.bow * np.square(xy - middle).sum(-1) / farthest
        return z
