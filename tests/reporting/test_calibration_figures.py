"""Figures of a geometric calibration for all kinds of measured and held-out rows."""

import numpy as np
import pytest

from pisigma.calibration.geometric.identifiability.pairwise import CorrelationTable
from pisigma.reporting.calibration_figures import draw_correlations, draw_held_out_errors, draw_residuals

PNG = b"\x89PNG\r\n\x1a\n"


def size(path) -> tuple[int, int]:
    """Width and height of a PNG."""
    content = path.read_bytes()
    assert content[:8] == PNG
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("scale", [0.0, 1e-16, 1e-4, 1.0])
def test_a_panel_for_every_sensor(tmp_path, rng, scale):
    position, rotation = (scale * rng.normal(size=(40, 3)) for _ in range(2))
    position[3] = np.nan
    heights = []
    for sensors in ({"position": position}, {"position": position, "rotation": rotation}):
        draw_residuals(sensors, tmp_path / "residuals.png")
        heights.append(size(tmp_path / "residuals.png")[1])
    assert 2 * heights[0] == pytest.approx(heights[1], abs=4)


@pytest.mark.parametrize("scale", [0.0, 1e-16, 1e-4, 1.0])
def test_errors_of_held_out_rows(tmp_path, rng, scale):
    lengths = np.append(scale * np.abs(rng.normal(size=20)), np.nan)
    draw_held_out_errors({"nominal": 10 * lengths, "geometric": lengths}, tmp_path / "held_out_errors.png")
    width, height = size(tmp_path / "held_out_errors.png")
    assert width > height > 300


@pytest.mark.parametrize("count", [1, 6, 40])
def test_correlations_grow_with_the_parameters_and_may_be_unknown(tmp_path, rng, count):
    values = np.corrcoef(rng.normal(size=(count, 60))).reshape(count, count)
    values[-1] = values[:, -1] = np.nan
    table = CorrelationTable(tuple(f"a_{index}" for index in range(count)), values)
    draw_correlations((table, table), tmp_path / "correlation.png")
    width, height = size(tmp_path / "correlation.png")
    assert width > height > 400
