"""Printed boards, and the positions of their corners."""

import os
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import Field, model_validator

from pisigma.files.errors import MeasurementError
from pisigma.files.yaml_file import Section, read_yaml

BoardKind = Literal["checkerboard", "charuco", "apriltag"]
Dictionary = Literal[
    "4x4_50", "4x4_100", "4x4_250", "4x4_1000", "5x5_50", "5x5_100", "5x5_250", "5x5_1000",
    "6x6_50", "6x6_100", "6x6_250", "6x6_1000", "7x7_50", "7x7_100", "7x7_250", "7x7_1000",
]  # fmt: skip
"""Name of OpenCV's dictionary of the markers in the white squares of a ChArUco board."""
TagFamily = Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"]
_TAG_CELLS = {"tag16h5": 6, "tag25h9": 7, "tag36h10": 8, "tag36h11": 8}
"""Number of cells along the side of a tag, including its border."""
RULER = 100.0
"""Length of the line with which the scale of a printed board is checked [mm]."""
_SQUARE_PX = 25.0
"""Width of a square [px] at which the cells of a marker of 4 x 4 bits are 3 px wide, on boards with margins of 14 %."""
Length = Annotated[float, Field(ge=0.2)]
"""Length of a board [mm]; shorter lengths are probably in metres."""
_LENGTHS: dict[BoardKind, tuple[str, ...]] = {
    "checkerboard": ("square_mm",),
    "charuco": ("square_mm", "marker_mm"),
    "apriltag": ("tag_mm", "spacing_mm"),
}


class BoardDocument(Section):
    """Contents of a board file.

    Attributes:
        kind: kind of board.
        name: name of the board.
        rows: number of rows of inner corners, or of AprilTags.
        columns: number of columns of inner corners, or of AprilTags.
        square_mm: side of a square of a checkerboard or a ChArUco board [mm].
        square_sigma_mm: standard deviation of the side, common to all squares [mm].
        ruler_mm: measured length of the line of 100 mm that is printed below the board [mm]; all lengths of the board
            are scaled by it.
        flatness_mm: flatness tolerance [mm].
        marker_mm: side of the markers of a ChArUco board [mm].
        dictionary: dictionary of the markers of a ChArUco board.
        tag_mm: side of an AprilTag [mm].
        spacing_mm: gap between neighbouring AprilTags [mm].
        family: family of the AprilTags.
    """

    kind: BoardKind = "checkerboard"
    name: str = "board"
    rows: int = Field(ge=2, le=100)
    columns: int = Field(ge=2, le=100)
    square_mm: Length | None = None
    square_sigma_mm: float | None = Field(default=None, ge=0)
    marker_mm: Length | None = None
    dictionary: Dictionary = "5x5_1000"
    tag_mm: Length | None = None
    spacing_mm: Length | None = None
    family: TagFamily = "tag36h11"
    flatness_mm: float = Field(default=0.0, ge=0)
    ruler_mm: float = Field(default=RULER, ge=90.0, le=110.0)

    @model_validator(mode="after")
    def _lengths_of_kind(self) -> "BoardDocument":
        expected = _LENGTHS[self.kind]
        given = [name for name in ("square_mm", "marker_mm", "tag_mm", "spacing_mm") if getattr(self, name)]
        if sorted(expected) != sorted(given):
            raise ValueError(
                f"expected {' and '.join(expected)} for a board of kind {self.kind}, got {', '.join(given) or 'none'}"
            )
        if self.kind == "charuco" and (self.marker_mm or 0.0) >= (self.square_mm or 0.0):
            raise ValueError(f"expected marker_mm < square_mm, got {self.marker_mm} and {self.square_mm} mm")
        return self

    def board(self) -> "Board":
        """Return the board in SI units."""
        printed = self.ruler_mm / RULER
        marker = (self.marker_mm or self.tag_mm or 0.0) * printed
        pitch = self.square_mm * printed if self.square_mm else marker + (self.spacing_mm or 0.0) * printed
        names = {"checkerboard": "", "charuco": self.dictionary, "apriltag": self.family}
        lengths = pitch / 1e3, self.kind, marker / 1e3
        scale = None if self.square_sigma_mm is None else self.square_sigma_mm / pitch
        errors = scale, self.flatness_mm / 1e3, printed
        return Board(self.name, self.rows, self.columns, *lengths, names[self.kind], *errors)


@dataclass(frozen=True)
class Board:
    """A flat board with numbered corners.

    Seen from the printed side, x points right, y down and z into the board, and rows are counted downwards. The corners
    of checkerboards and ChArUco boards are the inner corners, numbered row by row from 0; corner 0 is the origin, and
    the square at negative x and y is black. The corners of an AprilTag grid are those of its tags: corner 4 i is the
    upper left corner of tag i, with tags counted row by row from 0, and the others follow clockwise; corner 0 is the
    origin.

    Attributes:
        name: name of the board.
        rows: number of rows of corners, or of AprilTags.
        columns: number of corners, or of AprilTags, in a row.
        square: distance between neighbouring corners, or from tag to tag [m]; it determines the scale of the
            calibration.
        kind: kind of board.
        marker: side of the markers of a ChArUco board, or of AprilTags [m].
        dictionary: dictionary of the markers: a `Dictionary` or a `TagFamily`.
        scale_sigma: relative standard deviation of the scale, common to all lengths of the board; None if not
            stated.
        flatness: distance between two parallel planes that enclose the surface [m]; 0 for a perfectly flat board.
        print_scale: ratio of the lengths as printed, which the other attributes state, to the intended lengths.
    """

    name: str
    rows: int
    columns: int
    square: float
    kind: BoardKind = "checkerboard"
    marker: float = 0.0
    dictionary: str = ""
    scale_sigma: float | None = None
    flatness: float = 0.0
    print_scale: float = 1.0

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Board":
        """Read a board from a YAML file with `kind`, `rows`, `columns` and its lengths, such as `square_mm`.

        Raises:
            MeasurementError: the file cannot be read or is not a valid board; `file`, `line` and `column` locate the
                fault.
        """
        return read_yaml(path, BoardDocument, MeasurementError).board()

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """Positions of the corners in the board's frame [m]."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        grid = self.square * np.stack([column, row, np.zeros(len(row))], -1)
        if self.kind != "apriltag":
            return grid
        tag = self.marker * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return (grid[:, None] + tag).reshape(-1, 3)

    @property
    def edges(self) -> Int64[np.ndarray, "edges 2"]:
        """Pairs of corners that are joined by a straight edge between black and white."""
        if self.kind == "apriltag":
            first = np.arange(4 * self.rows * self.columns)
            return np.stack([first, first // 4 * 4 + (first + 1) % 4], -1)
        number = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        along = np.stack([number[:, :-1], number[:, 1:]], -1).reshape(-1, 2)
        across = np.stack([number[:-1], number[1:]], -1).reshape(-1, 2)
        return np.concatenate([along, across])

    @property
    def relative_edge_clearance(self) -> float:
        """Width of the uniformly black or white areas on both sides of an edge, relative to the edge's length."""
        if self.kind == "apriltag":
            return 1.0 / _TAG_CELLS[self.dictionary]
        return 0.4 if self.kind == "checkerboard" else (1 - self.marker / self.square) / 2

    @property
    def is_symmetric(self) -> bool:
        """Whether the board looks the same after a rotation by 180 deg, so that its numbering is ambiguous.

        Checkerboards are symmetric if the sum of their rows and columns of corners is even.
        """
        return self.kind == "checkerboard" and (self.rows + self.columns) % 2 == 0


def smallest_square(reach: float, height_px: int) -> float:
    """Return the smallest side of a square that a fixed camera sees well all over the workspace of an arm [m].

    A lens that covers a sphere around the base with the reach as its radius shows `height / (2 reach)` pixels per
    metre at its middle, whatever its focal length and distance.

    Args:
        reach: reach of the arm [m].
        height_px: the smaller side of the image [px].
    """
    return _SQUARE_PX * 2 * reach / height_px
