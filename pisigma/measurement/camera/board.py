"""Printed boards: where their corners are."""

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
"""Of the markers in the white squares of a ChArUco board, as OpenCV numbers them."""
TagFamily = Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"]
TAG_CELLS = {"tag16h5": 6, "tag25h9": 7, "tag36h10": 8, "tag36h11": 8}
"""Cells along the side of a tag, with those of its border."""
Length = Annotated[float, Field(ge=0.2)]
"""[mm] A length of a board; what is shorter was meant in metres."""
_LENGTHS: dict[BoardKind, tuple[str, ...]] = {
    "checkerboard": ("square_mm",),
    "charuco": ("square_mm", "marker_mm"),
    "apriltag": ("tag_mm", "spacing_mm"),
}


class BoardDocument(Section):
    """A board as its file states it.

    Attributes:
        kind: of the board.
        name: of the board.
        rows: of corners inside, or of AprilTags.
        columns: of corners inside, or of AprilTags.
        square_mm: side of a square [mm], of a checkerboard or a ChArUco board.
        square_sigma_mm: its standard deviation, common to all squares [mm].
        flatness_mm: tolerance of the flatness [mm].
        marker_mm: side of the markers of a ChArUco board [mm].
        dictionary: of these markers.
        tag_mm: side of an AprilTag [mm].
        spacing_mm: between neighbouring AprilTags [mm].
        family: of these tags.
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

    @model_validator(mode="after")
    def _lengths_of_kind(self) -> "BoardDocument":
        wanted = _LENGTHS[self.kind]
        stated = [name for name in ("square_mm", "marker_mm", "tag_mm", "spacing_mm") if getattr(self, name)]
        if sorted(wanted) != sorted(stated):
            raise ValueError(
                f"a board of kind {self.kind} has {' and '.join(wanted)} [mm], got {', '.join(stated) or 'none'}"
            )
        if self.kind == "charuco" and (self.marker_mm or 0.0) >= (self.square_mm or 0.0):
            raise ValueError("marker_mm is less than square_mm, as a marker lies in a square")
        return self

    def board(self) -> "Board":
        """The board that it states."""
        marker = self.marker_mm or self.tag_mm or 0.0
        pitch = self.square_mm or marker + (self.spacing_mm or 0.0)
        names = {"checkerboard": "", "charuco": self.dictionary, "apriltag": self.family}
        lengths = pitch / 1e3, self.kind, marker / 1e3
        scale = None if self.square_sigma_mm is None else self.square_sigma_mm / pitch
        errors = scale, self.flatness_mm / 1e3
        return Board(self.name, self.rows, self.columns, *lengths, names[self.kind], *errors)


@dataclass(frozen=True)
class Board:
    """A flat board with numbered corners.

    Looked at from its printed side, x leads to the right, y down and z into the board, and rows are counted down. The
    corners of checkerboards and ChArUco boards are those inside, row by row from 0; corner 0 is the origin, and the
    square beyond it (where x and y are negative) is black. The corners of an AprilTag grid are those of its tags: of
    tag i, counted row by row from 0, 4 i is the upper left one, and the others follow to the right; corner 0 is the
    origin.

    Attributes:
        name: of the board.
        rows: number of rows of corners, of a grid of AprilTags of tags.
        columns: corners of a row, or tags.
        square: distance of two neighbouring corners [m], of AprilTags from tag to tag; every length of the calibration
            rests on it.
        kind: of the board.
        marker: side of the markers of a ChArUco board, or of AprilTags [m].
        dictionary: of its markers: a `Dictionary` or a `TagFamily`.
        scale_deviation: standard deviation of all its lengths together, as a share of them; None where none is stated.
        flatness: distance of two planes between which its surface lies [m]; 0 where it is taken as flat.
    """

    name: str
    rows: int
    columns: int
    square: float
    kind: BoardKind = "checkerboard"
    marker: float = 0.0
    dictionary: str = ""
    scale_deviation: float | None = None
    flatness: float = 0.0

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Board":
        """Read a board from a YAML file with `kind`, `rows`, `columns` and its lengths, such as `square_mm`.

        Raises:
            MeasurementError: the file cannot be read or describes no board; the message names file, line and key.
        """
        return read_yaml(path, BoardDocument, MeasurementError).board()

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """Where the corners are in the board's frame [m]."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        grid = self.square * np.stack([column, row, np.zeros(len(row))], -1)
        if self.kind != "apriltag":
            return grid
        tag = self.marker * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return (grid[:, None] + tag).reshape(-1, 3)

    @property
    def edges(self) -> Int64[np.ndarray, "edges 2"]:
        """Pairs of corners between which black meets white on a straight line."""
        if self.kind == "apriltag":
            first = np.arange(4 * self.rows * self.columns)
            return np.stack([first, first // 4 * 4 + (first + 1) % 4], -1)
        number = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        along = np.stack([number[:, :-1], number[:, 1:]], -1).reshape(-1, 2)
        across = np.stack([number[:-1], number[1:]], -1).reshape(-1, 2)
        return np.concatenate([along, across])

    @property
    def clearance(self) -> float:
        """Share of the length of an edge, to both of its sides, that is all black or white."""
        if self.kind == "apriltag":
            return 1.0 / TAG_CELLS[self.dictionary]
        return 0.4 if self.kind == "checkerboard" else (1 - self.marker / self.square) / 2

    @property
    def is_symmetric(self) -> bool:
        """Whether the board looks the same turned by 180 deg, so that its corners cannot be numbered by an image.

        A checkerboard of an even sum of rows and columns of corners has squares of one colour in opposite places.
        """
        return self.kind == "checkerboard" and (self.rows + self.columns) % 2 == 0
