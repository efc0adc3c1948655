"""The board that a camera sees: its sheet, and a dot for every corner."""

from typing import TYPE_CHECKING

import numpy as np

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.pattern import board_sheet

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import viser

SHEET, PRINT = (245, 245, 245), (20, 20, 20)
DOT = 0.25
"""Diameter of a dot as share of the distance of two corners."""


def draw_board(scene: "viser.SceneApi", name: str, board: Board) -> None:
    """Draw a board under a node that is its frame.

    Args:
        scene: where to.
        name: of the node.
        board: what is drawn.
    """
    left, top, right, bottom = board_sheet(board)
    ends = np.array([[left, top, 0.0], [right, top, 0.0], [right, bottom, 0.0], [left, bottom, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    scene.add_mesh_simple(f"{name}/sheet", ends, faces, color=SHEET, side="double", cast_shadow=False)
    size = DOT * board.square
    scene.add_point_cloud(f"{name}/corners", board.corners, PRINT, point_size=size, precision="float32")
