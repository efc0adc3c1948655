"""Weight of a pose from an image before it is taken, compared with that of a taken one."""

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, NOISE, camera_cell
from testing.closeness import assert_close

from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.sensors.corner import WEIGHT_COLUMN, WEIGHTS
from pisigma.measurement.sensors.intrinsics import numbers_in
from pisigma.planning.board_sight import BoardSight
from pisigma.robot.kinematics.forward import forward_kinematics


@pytest.mark.parametrize("is_fixed", [False, True])
def test_the_weight_of_a_pose_is_that_of_its_image(is_fixed: bool):
    cell = camera_cell(6, is_fixed=is_fixed)
    rows = image_measurements(cell.images, CAMERA, BOARD, is_fixed, NOISE.repeatability)
    texts = rows.readings[WEIGHT_COLUMN]
    measured = torch.zeros(6, 6, 6, dtype=torch.float64)
    row, column = np.tril_indices(6)
    measured[:, row, column] = torch.tensor(
        [numbers_in(text, WEIGHTS) for text in texts], dtype=torch.float64
    )
    sight = BoardSight(CAMERA, BOARD, is_fixed, NOISE.corner, NOISE.repeatability)
    weight = sight.whitening_matrix(forward_kinematics(cell.true, cell.images.q))
    covariance, expected = (torch.linalg.inv(W.mT @ W) for W in (weight, measured))
    scale = expected.diagonal(dim1=1, dim2=2).sqrt()
    scale = scale[:, :, None] * scale[:, None]
    assert_close(covariance / scale, expected / scale, atol=0.15)
