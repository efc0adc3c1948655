"""If no data determine the position of a frame, the hybrid arm is at the position of the geometric one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import joints_in, true_robot

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.refinement import fit_rigid_motion, refine, with_aligned_frames
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.robot import Robot
from pisigma.robot.se3 import rotation_from_vector, transform, transform_from_xyz_zyx
from pisigma.simulation import TrueRobot


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [0.02, -0.01, 0.03], [1.0, 2.0, -0.5], [3.1, 0.0, 0.0]])
def test_a_motion_is_found_again(turn, generator):
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    T = transform(
        rotation_from_vector(torch.tensor(turn, dtype=torch.float64)),
        torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64),
    )
    onto = points @ T[:3, :3].mT + T[:3, 3]
    assert_close(fit_rigid_motion(points, onto), T, atol=1e-12)


def test_a_mirrored_point_cloud_still_yields_a_rotation(generator):
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    T = fit_rigid_motion(points, points * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert_close(torch.linalg.det(T[:3, :3]), 1.0, atol=1e-12)


def distances(rows: int) -> tuple[TrueRobot, Measurements]:
    """Distances of the true arm's tool from three anchors at unknown places."""
    true = true_robot(Robot.load("rb5"))
    q = joints_in(true.nominal, rows, seed=0)
    position = true.forward(q)[:, :3, 3]
    places = torch.tensor([[1.5, 0.2, 0.1], [-0.4, 1.6, 0.3], [0.1, -0.5, 1.9]], dtype=torch.float64)
    number = torch.arange(rows) % 3
    noise = 2e-5 * torch.from_numpy(np.random.default_rng(3).normal(size=rows))
    distance = (position - places[number]).norm(dim=-1) + noise
    names = tuple(("a", "b", "c")[k] for k in number.tolist())
    return true, Measurements(q=q, distance=distance, anchor=names)


def test_frames_that_no_distance_determines_are_those_of_the_geometric_calibration():
    _, data = distances(360)
    calibrator = HybridCalibrator(GeometricCalibrator(Robot.load("rb5")), harmonics=(4,), products=False)
    result = calibrator.fit(data)
    learned = result.learned
    assert learned is not None
    geometric = result.geometric
    T = predicted_poses(geometric.robot, geometric.bases, geometric.tools, data)
    off = result.predicted_poses(data)[:, :3, 3] - T[:, :3, 3]
    assert float(off.mean(0).norm()) < 1e-4
    assert 1e-5 < float(off.square().sum(-1).mean().sqrt()) < 1e-3  # what was learned, no motion of them all
    before, after = (found.errors_of(data)["distance"] for found in (geometric, result))
    assert float(after.square().mean()) < 0.5 * float(before.square().mean())
    assert_close(learned.geometry.robot.base, learned.geometry.bases[""], atol=0.0)


def test_a_moved_frame_moves_what_stands_in_it_with_its_uncertainty():
    _, data = distances(60)
    solved = GeometricCalibrator(Robot.load("rb5")).solve(data)
    with_series = HybridCalibrator(GeometricCalibrator(Robot.load("rb5")), harmonics=(4,), products=False)
    choice = with_series._chosen(solved, held_out_groups(solved.setup.measurements), lambda what: None)
    refined = refine(solved.problem, held_out_groups(solved.setup.measurements), choice)
    turned = refined.point.clone()
    turned[solved.problem.space.index("base_roll")] += 0.3
    turned[solved.problem.space.index("base_x")] += 0.1
    moved = with_aligned_frames(solved, replace(refined, point=turned))
    like = with_aligned_frames(solved, refined)
    assert_close(moved.bases[""], like.bases[""], atol=1e-9)
    assert moved.point is not None
    base = moved.setup.reference_frames.bases[0] @ transform_from_xyz_zyx(
        turned[solved.problem.space.indices_of("base")]
    )
    assert_close(transform_from_xyz_zyx(torch.from_numpy(moved.bases[""])), base, atol=1e-12)
    anchor = solved.problem.space.indices_of("anchor").start
    place = moved.coordinate_jacobian[anchor : anchor + 3, anchor : anchor + 3]
    assert_close(place, moved.setup.reference_frames.bases[0, :3, :3], atol=1e-12)
