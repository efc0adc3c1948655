"""Poses of boards together with intrinsics: derivatives, and intrinsics under a prior or free."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, camera_cell
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board_pose import BoardPose, solve_board_pose
from pisigma.measurement.camera.camera import USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import Images, image_measurements
from pisigma.measurement.camera.solved_images import prior_sigmas, solve_images
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.sensors.intrinsics import intrinsics_information
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_vector

PRIOR = Prior(theta=5e-3, d=1e-3, a=1e-3, alpha=5e-3, beta=5e-3)


def poses_of(images: Images) -> Callable[[Camera], list[BoardPose]]:
    """Return a function that solves the poses of some images."""
    return lambda camera: [
        solve_board_pose(camera, BOARD.corners[corners], pixels, SquaredLoss())
        for corners, pixels in zip(images.corner_numbers, images.pixels, strict=True)
    ]


def test_the_derivative_of_a_pose_by_the_intrinsics() -> None:
    solve = poses_of(camera_cell(2).images)
    here = solve(CAMERA)
    for k, step in enumerate(1e-5 * np.eye(9)):
        less, more = (solve(CAMERA.with_intrinsics(CAMERA.intrinsics + change)) for change in (-step, step))
        for pose, before, after in zip(here, less, more, strict=True):
            turn = rotation_vector(torch.from_numpy(after.R @ before.R.T)).numpy()
            change = np.concatenate([after.t - before.t, turn]) / 2e-5
            size = np.abs(pose.intrinsics_jacobian).max()
            assert_close(pose.intrinsics_jacobian[:, k], change, atol=1e-2 * size, rtol=0.05)


def test_the_reduced_equations_are_those_of_the_complete_least_squares_problem() -> None:
    (pose,) = poses_of(camera_cell(1).images)(CAMERA)
    points = BOARD.corners @ pose.R.T + pose.t
    B = CAMERA.intrinsics_jacobian(points).reshape(-1, 9)
    turned, point_jacobian = BOARD.corners @ pose.R.T, CAMERA.project(points)[1]
    A = np.concatenate([point_jacobian, np.cross(turned[:, None], point_jacobian)], -1).reshape(-1, 6)
    left = B - A @ np.linalg.lstsq(A, B, rcond=None)[0]
    assert_close(pose.information_root.T @ pose.information_root, left.T @ left, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("choice", ["prior", "free"])
def test_images_correct_intrinsics(choice: str) -> None:
    deviations = np.array(USUAL_DEVIATIONS) * (1 if choice == "prior" else 20)
    wrong = CAMERA.with_intrinsics(CAMERA.intrinsics + deviations)
    sigma = prior_sigmas(wrong, choice)
    solved = solve_images(wrong, sigma, poses_of(camera_cell(30).images), SquaredLoss(), "images")
    root, mean = intrinsics_information(solved.intrinsics)
    assert np.linalg.norm(root @ (CAMERA.intrinsics - mean)) < 5.0  # of eight standard normal numbers
    assert_close(solved.noise, 0.3, rtol=0.05)
    assert np.abs(root @ (mean - solved.camera_of_poses.intrinsics)).max() < 0.1


def test_intrinsics_with_zero_deviation_are_fixed() -> None:
    assert not prior_sigmas(CAMERA, "fixed").any()
    assert_close(prior_sigmas(CAMERA, "prior"), np.array(USUAL_DEVIATIONS))
    stated = replace(CAMERA, sigma=(1.0, *[0.0] * 8))
    assert prior_sigmas(stated, "free").nonzero()[0].tolist() == [0]


def test_impossible_intrinsics_are_refused() -> None:
    (pose,) = poses_of(camera_cell(1).images)(CAMERA)
    pulled = replace(pose, information_root=np.eye(9), information_residual=np.full(9, -1e6))
    sigma = prior_sigmas(CAMERA, "free")
    with refused(MeasurementError, file="x", value="wrist"):
        solve_images(CAMERA, sigma, lambda camera: [pulled], SquaredLoss(), "x")


def test_a_calibration_identifies_the_intrinsics() -> None:
    cell = camera_cell(50, 1)
    wrong = CAMERA.with_intrinsics(CAMERA.intrinsics + np.array(USUAL_DEVIATIONS))
    data = image_measurements(cell.images, wrong, BOARD, False, Repeatability())
    result = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(data)
    names = [f"camera_wrist_{name}" for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")]
    posterior = result.posterior.select(names)
    off = posterior.mean.numpy() - CAMERA.intrinsics[:8]
    assert np.abs(off / posterior.standard_errors.numpy()).max() < 3.5
    assert (posterior.standard_errors.numpy() < 0.7 * np.array(USUAL_DEVIATIONS[:8])).all()
    estimate = result.parameter("camera_wrist_fx")
    assert (estimate.unit, estimate.free, estimate.nominal) == ("px", True, 1400.5)
    assert not result.parameter("camera_wrist_k3").free
    assert not result.parameter("board_board_scale").free
    held = result.errors_of(data)
    assert_close(held["position"].square().mean().sqrt(), torch.tensor(5e-4).double(), rtol=0.5)


def test_one_length_in_addition_to_images_corrects_the_scale_of_the_board() -> None:
    cell = camera_cell(50, 1)
    wrong = replace(BOARD, square=BOARD.square * 0.999)  # the true board is 0.1 % too large
    data = image_measurements(cell.images, CAMERA, wrong, False, Repeatability(), "fixed")
    q = camera_cell(50, 3).images.q[:12]
    true = cell.true.with_geometry(base=np.array([0.1, 0.2, 0.3, 0.5, 0.0, 0.0]))
    position = forward_kinematics(true, q)[:, :3, 3]
    tracker = Measurements(q=q, position=position, frame=("tracker",) * 12, target=("wrist",) * 12)
    result = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(join([data, tracker]))
    scale = result.parameter("board_board_scale")
    assert_close(scale.estimated, 1e-3, atol=2e-4)
    assert_close(scale.estimated, 1e-3, atol=4 * scale.standard_error)
