"""Path criteria of ISO 9283: measured paths at the points of the command, and examples worked out by hand."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.validation.iso9283 import path as path_module
from pisigma.validation.iso9283.path import (
    path_accuracy,
    path_orientation_accuracy,
    path_orientation_repeatability,
    path_repeatability,
    path_tangents,
    resample_paths,
)

EXACT = 1e-12
COMMAND = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
"""Along x."""


def beside(*offsets: tuple[float, float], samples: int = 7) -> torch.Tensor:
    """Straight paths parallel to the command, so far off in y and z [m], from before it to behind it."""
    x = torch.linspace(-0.02, 0.33, samples, dtype=torch.float64)
    return torch.stack([torch.stack([x, 0 * x + y, 0 * x + z], -1) for y, z in offsets])


def test_path_accuracy_and_repeatability_by_hand():
    # barycentre at y = 1, z = 2 mm from the command; distances from it 5, 5, 13, 13 mm
    paths = beside((0.004, 0.006), (-0.002, -0.002), (0.006, 0.014), (-0.004, -0.010))
    attained = resample_paths(paths, COMMAND).position
    assert attained.shape == (4, 4, 3)
    assert_close(attained[..., 0], COMMAND[:, 0].expand(4, 4), atol=EXACT)
    assert_close(path_accuracy(attained, COMMAND), math.sqrt(5) * 1e-3, atol=EXACT)
    assert_close(path_repeatability(attained), 9e-3 + 3e-3 * math.sqrt(64 / 3), atol=EXACT)


def test_the_worst_point_counts():
    attained = COMMAND.repeat(3, 1, 1)
    attained[:, 2] += torch.tensor([0.0, 0.003, 0.004], dtype=torch.float64)
    attained[:, 1, 2] += torch.tensor([-0.001, 0.0, 0.001], dtype=torch.float64)
    assert_close(path_accuracy(attained, COMMAND), 0.005, atol=EXACT)
    # distances 1, 0, 1 mm: mean 2/3, S = √((2 (1/3)² + (2/3)²) / 2) = 1/√3
    assert_close(path_repeatability(attained), 2e-3 / 3 + 3e-3 / math.sqrt(3), atol=EXACT)


def test_angles_by_hand():
    x = torch.linspace(-0.1, 0.4, 6, dtype=torch.float64)
    paths = torch.stack([x, 0 * x, 0 * x], -1).expand(2, 6, 3)
    slope = torch.stack([3.0 + x, 0 * x + 0.1, 0 * x], -1)  # goes over the half turn at 3.14
    angles = torch.stack([slope, slope + torch.tensor([0.0, 0.02, 0.0])])
    angles = torch.remainder(angles + math.pi, 2 * math.pi) - math.pi
    found = resample_paths(paths, COMMAND, angles).angles
    command = torch.stack([3.0 + COMMAND[:, 0], torch.full((4,), 0.1).double(), torch.zeros(4).double()], -1)
    assert_close(path_orientation_accuracy(found, command), [0.0, 0.01, 0.0], atol=1e-7)
    assert_close(path_orientation_repeatability(found), [0.0, 3 * math.sqrt(2 * 0.01**2), 0.0], atol=1e-7)


def circle(angle: torch.Tensor, radius: float) -> torch.Tensor:
    return radius * torch.stack([torch.cos(angle), torch.sin(angle), 0 * angle], -1)


def test_a_circle_is_crossed_where_it_is_near():
    """Every plane across a circle is crossed twice; the command goes through one of them."""
    command = circle(torch.linspace(0.2, 6.1, 60, dtype=torch.float64), 0.1)
    measured = circle(torch.linspace(0.0, 6.28, 20_001, dtype=torch.float64), 0.103)[None]
    found = resample_paths(measured, command).position
    assert_close(torch.linalg.vector_norm(found, dim=-1), 0.103, atol=1e-8)
    inner = found[:, 1:-1]
    assert_close(torch.linalg.vector_norm(inner - command[1:-1], dim=-1), 0.003, atol=1e-8)


def test_in_parts_it_is_the_same(monkeypatch):
    paths, angles = beside((0.001, 0.0), (0.0, 0.002), samples=40), beside((1.0, 2.0), (0.5, 0.1), samples=40)
    whole = resample_paths(paths, COMMAND, angles)
    monkeypatch.setattr(path_module, "_CROSSINGS", 1)
    parts = resample_paths(paths, COMMAND, angles)
    assert_close(parts.position, whole.position)
    assert_close(parts.angles, whole.angles)


def test_paths_of_different_length_end_with_nan():
    paths = beside((0.001, 0.0), (0.002, 0.0), samples=9)
    longer = torch.cat([paths, torch.full((2, 5, 3), torch.nan, dtype=torch.float64)], 1)
    assert_close(resample_paths(longer, COMMAND).position, resample_paths(paths, COMMAND).position)


def test_tangents_of_a_corner_may_be_given():
    corner = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]], dtype=torch.float64)
    tangents = path_tangents(corner)
    assert_close(tangents[1], [math.sqrt(0.5), math.sqrt(0.5), 0.0], atol=1e-15)
    measured = torch.tensor([[[-0.1, 0.01, 0], [1.2, 0.01, 0], [1.2, 1.2, 0]]], dtype=torch.float64)
    given = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    found = resample_paths(measured, corner, tangents=given).position
    assert_close(found[0], [[0, 0.01, 0], [1, 0.01, 0], [1.2, 1, 0]], atol=1e-15)


@pytest.mark.parametrize(("first", "last", "point"), [(0.01, 0.33, 0), (-0.02, 0.29, 3)])
def test_a_path_that_misses_an_end_is_refused(first: float, last: float, point: int):
    x = torch.linspace(first, last, 9, dtype=torch.float64)
    short = torch.stack([x, 0 * x, 0 * x], -1)
    paths = torch.cat([beside((0.0, 0.0), samples=9), short[None]])
    with refused(MeasurementError, option="measured", value=(1, point)):
        resample_paths(paths, COMMAND)


def test_a_command_without_direction_is_refused():
    with refused(MeasurementError, expected="2 or more command points", value=1):
        path_tangents(COMMAND[:1])
    with refused(MeasurementError, option="command", expected="", value=1):
        path_tangents(COMMAND[[0, 1, 0]])


def test_one_path_does_not_determine_repeatability():
    for function in (path_repeatability, path_orientation_repeatability):
        with refused(MeasurementError, option="attained", value=1):
            function(COMMAND[None])
