"""Printed boards: where their corners are."""

import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from pisigma.errors import MeasurementError
from pisigma.yaml_file import Section, read_yaml


class BoardDocument(Section):
    """A board as its file states it; see `Board`."""

    name: str = "board"
    rows: int = Field(ge=2)
    columns: int = Field(ge=2)
    square_mm: float = Field(gt=0)


@dataclass(frozen=True)
class Board:
    """A flat board with a grid of corners, counted row by row from 0.

    Corner 0 is the origin of the board's frame, x leads along a row and y from row to row.

    Attributes:
        name: of the board.
        rows: number of rows of corners.
        columns: corners of a row.
        square: distance of two neighbouring corners [m]; every length of the calibration rests on it.
    """

    name: str
    rows: int
    columns: int
    square: float

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Board":
        """Read a board from a YAML file with `rows`, `columns` and `square_mm`.

        Raises:
            MeasurementError: the file cannot be read or describes no board; the message names file, line and key.
        """
        document = read_yaml(path, BoardDocument, MeasurementError)
        return Board(document.name, document.rows, document.columns, document.square_mm / 1e3)

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """Where the corners are in the board's frame [m]."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return self.square * np.stack([column, row, np.zeros(len(row))], -1)
