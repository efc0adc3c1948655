"""A board as it really is: larger or smaller than stated, and bowed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.pattern import Pattern, board_pattern


@dataclass(frozen=True)
class TrueBoard:
    """A printed board that differs from what is stated of it.

    Its surface is `z = bow · r² / R²` with r the distance from the middle of the corners and R that of the farthest.

    Attributes:
        stated: the board as its file states it.
        scale: true over stated lengths.
        bow: by how much the farthest corners stand out of the plane at the middle [m], along z.
    """

    stated: Board
    scale: float = 1.0
    bow: float = 0.0

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """Where the corners really are in the board's frame [m]."""
        flat = self.scale * self.stated.corners[:, :2]
        return np.concatenate([flat, self.height(flat)[:, None]], 1)

    @property
    def pattern(self) -> Pattern:
        """What is printed on it, at its true size."""
        stated = board_pattern(self.stated)
        return Pattern(self.scale * stated.black, self.scale * stated.sheet)

    def height(self, xy: Float64[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch"]:
        """Return z of the surface [m] over points of the plane [m]."""
        corners = self.scale * self.stated.corners[:, :2]
        middle = corners.mean(0)
        farthest = np.square(corners - middle).sum(1).max()
        z: np.ndarray = self.bow * np.square(xy - middle).sum(-1) / farthest
        return z
