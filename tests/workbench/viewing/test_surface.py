"""Surfaces of revolution."""

import numpy as np
import pytest
from testing.closeness import assert_close

from pisigma.workbench.viewing.surface import capsule, join_surfaces, revolve, rotation_to


def volume(surface) -> float:
    a, b, c = (surface.points[surface.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def distance_to_segment(points, start, end):
    along = end - start
    share = ((points - start) @ along / max(along @ along, 1e-30)).clip(0.0, 1.0)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


@pytest.mark.parametrize("end", [(0.1, -0.2, 0.9), (0.4, 0.2, -0.3), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
def test_points_of_a_capsule_are_its_radius_from_the_segment(end):
    start, end = np.array([0.0, 0.0, 0.0]), np.array(end)
    surface = capsule(start, end, 0.1)
    assert_close(distance_to_segment(surface.points, start, end), 0.1, atol=1e-12)
    whole = np.pi * 0.1**2 * np.linalg.norm(end) + 4 / 3 * np.pi * 0.1**3
    assert_close(volume(surface), whole, rtol=0.03)  # positive: triangles look outwards


def test_surfaces_are_joined_with_their_triangles():
    first, second = (capsule(np.zeros(3), np.array([0.0, 0.0, z]), 0.1) for z in (0.5, 1.0))
    assert_close(volume(join_surfaces([first, second])), volume(first) + volume(second), rtol=1e-12)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 2.0), (0.0, 0.0, -2.0), (1.0, -2.0, 0.5)])
def test_rotations_take_z_to_a_direction(direction):
    direction = np.array(direction)
    R = rotation_to(direction)
    assert_close(R @ R.T, np.eye(3), atol=1e-14)
    assert_close(np.linalg.det(R), 1.0, atol=1e-14)
    assert_close(R[:, 2], direction / np.linalg.norm(direction), atol=1e-14)


def test_a_cone_has_its_rim_where_it_is_stated():
    cone = revolve(np.array([0.0, 0.3]), np.array([0.0, 0.4]))
    assert_close(cone.points[0], np.zeros(3))
    assert_close(np.linalg.norm(cone.points[-1]), 0.5, rtol=1e-12)
