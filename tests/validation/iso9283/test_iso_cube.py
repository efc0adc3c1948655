"""The cube of ISO 9283: its corners, its five poses, and the largest one in a workspace."""

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.validation.iso9283.cube import PLANES, IsoCube, largest_cube

CUBE = IsoCube(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 2.0)


def test_corners_by_hand():
    assert_close(CUBE.corners[[0, 2, 6]], [[2, 3, 4], [0, 1, 4], [0, 1, 2]])
    assert_close(CUBE.corners[:4] - CUBE.corners[4:], torch.tensor([0.0, 0.0, 2.0]).expand(4, 3))


def test_five_poses_by_hand():
    # a tenth of the diagonal from C1 (2, 3, 4), C2 (0, 3, 4), C7 (0, 1, 2), C8 (2, 1, 2)
    wanted = [[1, 2, 3], [1.8, 2.8, 3.8], [0.2, 2.8, 3.8], [0.2, 1.2, 2.2], [1.8, 1.2, 2.2]]
    assert_close(CUBE.test_positions(), wanted, atol=1e-12)


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("share", [0.08, 0.1, 0.12])
def test_poses_lie_on_diagonals_of_a_plane_through_the_centre(plane: str, share: float):
    poses, diagonal = CUBE.test_positions(plane, share), 2 * 3**0.5
    assert_close(poses[0], CUBE.centre)
    off = poses[1:] - CUBE.centre
    assert_close(off.norm(dim=-1), (0.5 - share) * diagonal, atol=1e-12)
    assert_close(off[:2], -off[2:], atol=1e-12)
    assert int(torch.linalg.matrix_rank(off)) == 2
    corners = CUBE.corners[list(PLANES[plane])]
    assert_close((poses[1:] - corners).norm(dim=-1), share * diagonal, atol=1e-12)


def test_what_the_standard_does_not_allow_is_refused():
    with refused(MeasurementError, option="diagonal_fraction", value=0.2):
        CUBE.test_positions(diagonal_fraction=0.2)
    with refused(MeasurementError, option="plane", value="C1-C2-C7"):
        CUBE.test_positions("C1-C2-C7")


REGION = torch.full((3,), -1.0).double(), torch.full((3,), 1.0).double()


def test_the_largest_cube_of_a_ball():
    """Its corners lie on the ball: the edge is 2 r / √3."""
    found = largest_cube(lambda p: p.norm(dim=-1) <= 0.9, *REGION, spacing=0.02)
    assert 0 <= 1.8 / 3**0.5 - found.edge <= 0.04
    assert_close(found.centre, torch.zeros(3), atol=0.011)
    assert bool((found.corners.norm(dim=-1) <= 0.9).all())


def test_the_largest_cube_of_a_box_with_a_hole():
    def reaches(p: torch.Tensor) -> torch.Tensor:
        box = (p >= torch.tensor([-1, -0.5, -0.5])).all(-1) & (p <= torch.tensor([1, 0.5, 0.5])).all(-1)
        return box & ~((p[:, 0] > -0.3) & (p[:, 0] < 0.1))

    found = largest_cube(reaches, *REGION, spacing=0.05)
    assert_close(found.edge, 0.9, atol=1e-12)
    assert_close(found.centre[0], 0.55, atol=1e-12)


def test_the_whole_region_and_nothing():
    whole = largest_cube(lambda p: torch.ones(len(p), dtype=torch.bool), *REGION, spacing=0.1)
    assert_close(whole.edge, 2.0, atol=1e-12)
    assert_close(whole.centre, torch.zeros(3), atol=1e-12)
    with refused(MeasurementError, option="spacing", value=0.1):
        largest_cube(lambda p: p.norm(dim=-1) < 0.05, *REGION, spacing=0.1)
