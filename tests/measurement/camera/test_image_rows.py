"""Images as rows of measurements, and calibrations with them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, aligned_error, camera_cell
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements, join
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.simulation.camera.simulated_images import ImageNoise
from pisigma.validation.setup_faults.row_order import find_motion

EXACT = ImageNoise(0.0, Repeatability(0.0, 0.0))
PRIOR = Prior(theta=5e-3, d=1e-3, a=1e-3, alpha=5e-3, beta=5e-3)


def beyond(true: Robot, estimated: Robot) -> float:
    """Return the RMS position error at other views of the board [m]."""
    q = camera_cell(50, 2).images.q
    return aligned_error(*(forward_kinematics(robot, q)[:, :3, 3] for robot in (true, estimated)))


@pytest.mark.parametrize("is_fixed", [False, True], ids=["flange", "fixed"])
def test_a_calibration_with_images_is_accurate_at_other_views(is_fixed: bool) -> None:
    cell = camera_cell(50, 1, is_fixed=is_fixed)
    data = image_measurements(cell.images, CAMERA, BOARD, is_fixed, Repeatability())
    result = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(data)
    assert beyond(cell.true, result.robot) < 1e-4
    (noise,) = result.noise
    assert_close(noise.sigma, 0.3 / 1400 * 0.5, rtol=0.15)  # 0.3 px at 0.5 m


def test_wrong_corners_and_swapped_joints_are_found() -> None:
    cell = camera_cell(50, 1)
    pixels, q = [one.copy() for one in cell.images.pixels], cell.images.q.clone()
    for one in pixels:
        one[::20, 0] += 5.0
    swapped = {3: (5, 1), 17: (2, 3), 30: (3, 1)}
    for image, joints in swapped.items():
        q[image, joints] = q[image, joints[::-1]]
    errors = []
    for images in (cell.images, replace(cell.images, pixels=tuple(pixels), q=q)):
        data = image_measurements(images, CAMERA, BOARD, False, Repeatability())
        result = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(data)
        errors.append(beyond(cell.true, result.robot))
    assert {outlier.row for outlier in result.outliers} == set(swapped)
    assert errors[1] < 1.15 * errors[0]


def test_a_tracker_adds_information_to_a_camera() -> None:
    cell = camera_cell(20, 1)
    data = image_measurements(cell.images, CAMERA, BOARD, False, Repeatability())
    q = camera_cell(50, 3).images.q[:15]
    true = cell.true.with_geometry(base=np.array([0.1, 0.2, 0.3, 0.5, 0.0, 0.0]))
    position = forward_kinematics(true, q)[:, :3, 3]
    tracker = Measurements(q=q, position=position, frame=("tracker",) * 15, target=("wrist",) * 15)
    alone, both = (
        GeometricCalibrator(cell.nominal, prior=PRIOR).fit(rows) for rows in (data, join([data, tracker]))
    )
    assert beyond(cell.true, both.robot) < 0.7 * beyond(cell.true, alone.robot)
    motion = find_motion(both)  # of the rows of the tracker, as those of images are no positions
    assert motion is None or set(motion.row_indices) <= set(range(20, 35))


def test_two_cameras_calibrate_one_arm() -> None:
    wrist, fixed = camera_cell(30, 1), camera_cell(30, 1, is_fixed=True)
    both = join(
        [
            image_measurements(wrist.images, CAMERA, BOARD, False, Repeatability()),
            image_measurements(
                fixed.images,
                replace(CAMERA, name="beside"),
                replace(BOARD, name="hand"),
                True,
                Repeatability(),
            ),
        ]
    )
    result = GeometricCalibrator(wrist.nominal, prior=PRIOR).fit(both)
    assert (set(result.bases), set(result.tools)) == ({"board", "beside"}, {"wrist", "hand"})
    assert beyond(wrist.true, result.robot) < 1e-4


def test_the_result_warns_that_the_board_sets_the_scale() -> None:
    cell = camera_cell(50, 1)
    data = image_measurements(cell.images, CAMERA, BOARD, False, Repeatability())
    result = GeometricCalibrator(cell.nominal).fit(data)
    assert "scale_of_boards" in [warning.kind for warning in result.warning_details]
    assert {"theta_6", "d_6", "a_6", "alpha_6"} <= set(result.redundancy.removed)  # they go with the tool


def test_corners_of_another_board_are_refused() -> None:
    images = camera_cell(8, 0, EXACT).images
    shuffled = [
        torch.randperm(len(one), generator=torch.Generator().manual_seed(0)) for one in images.corner_numbers
    ]
    mixed = type(images)(
        images.source,
        images.names,
        images.q,
        images.lines,
        tuple(one[order.numpy()] for one, order in zip(images.corner_numbers, shuffled, strict=True)),
        images.pixels,
    )
    with refused(MeasurementError, file=images.source, line=images.lines[0]) as caught:
        image_measurements(mixed, CAMERA, BOARD, False, Repeatability())
    assert "'0000'" in caught.value.expected


def test_mirrored_images_are_refused() -> None:
    images = camera_cell(8, 0, EXACT).images
    pixels = list(images.pixels)
    for number in (3, 6):
        pixels[number] = np.array([CAMERA.width, 0.0]) + pixels[number] * [-1.0, 1.0]
    with refused(MeasurementError, line=images.lines[3], value="0003"):
        image_measurements(replace(images, pixels=tuple(pixels)), CAMERA, BOARD, False, Repeatability())


@pytest.mark.parametrize("length", [-1e-5, 0.02, float("nan")])
def test_repeatability_is_that_of_a_robot(length: float) -> None:
    with refused(IdentificationError, option="repeatability"):
        Repeatability(length, 0.0)
