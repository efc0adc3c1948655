"""Board of a camera on the page of a session."""

import numpy as np
import pytest
from testing.camera_cell import BOARD
from testing.closeness import assert_close

pytest.importorskip("viser", reason="the extra view is not installed")

from pisigma.workbench.viewing.scene import draw_board


class Scene:
    """What was drawn, by name."""

    def __init__(self) -> None:
        self.drawn: dict[str, np.ndarray] = {}

    def add_mesh_simple(self, name: str, vertices: np.ndarray, faces: np.ndarray, **_: object) -> None:
        self.drawn[name] = vertices[faces]

    def add_point_cloud(self, name: str, points: np.ndarray, colors: object, **_: object) -> None:
        self.drawn[name] = points


def test_the_sheet_contains_every_corner() -> None:
    scene = Scene()
    draw_board(scene, "/sensor", BOARD)
    assert_close(scene.drawn["/sensor/corners"], BOARD.corners, atol=0.0)
    sheet = scene.drawn["/sensor/sheet"].reshape(-1, 3)
    assert (sheet.min(0) <= BOARD.corners.min(0)).all()
    assert (sheet.max(0) >= BOARD.corners.max(0)).all()
