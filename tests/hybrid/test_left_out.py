"""Left-out errors in closed form against solving again without the rows."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, drawn_joints, linearised, tracker_data
from testing.sensors import mixed_data, true_robot

from pisigma.hybrid.design import sum_up
from pisigma.hybrid.evidence import solve_posterior
from pisigma.hybrid.left_out import folds_left_out, left_out
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot


def poses_with_repeats() -> tuple[LinearisedArm, tuple[AbstractFeature, ...]]:
    """Positions and rotations; some joint values are measured twice, some three times."""
    robot = Robot.load("rb5")
    q = drawn_joints(robot, 30, 0)
    q = torch.cat([q, q[:10], q[:5]])
    data = tracker_data(robot, q, 2e-4 * torch.sin(q), 3e-5, turn_noise=1e-4, several=True)
    return linearised(robot, data), (FourierSeries(robot, 2),)


def positions_beside_poses() -> tuple[LinearisedArm, tuple[AbstractFeature, ...]]:
    """Rows of different kinds: some without a rotation, some without a position."""
    robot = Robot.load("rb5")
    data = tracker_data(robot, drawn_joints(robot, 45, 1), noise=3e-5, turn_noise=1e-4, several=False)
    position, rotation = data.position, data.rotation
    assert position is not None
    assert rotation is not None
    position[::5], rotation[1::5] = torch.nan, torch.nan
    return linearised(robot, Measurements(q=data.q, position=position, rotation=rotation)), (
        GravityTorques(robot),
    )


def all_kinds() -> tuple[LinearisedArm, tuple[AbstractFeature, ...]]:
    """All kinds of sensors, and a distance of sockets that is known for certain."""
    robot, data = true_robot().nominal, mixed_data()
    generator = torch.Generator().manual_seed(2)

    def noisy(values: torch.Tensor | None) -> torch.Tensor:
        assert values is not None
        return values + 5e-5 * torch.randn(values.shape, generator=generator, dtype=torch.float64)

    assert data.distance is not None
    assert data.pair is not None
    distance = torch.where(torch.tensor([not p for p in data.pair]), noisy(data.distance), data.distance)
    data = replace(
        data, q=noisy(data.q), position=noisy(data.position), touch=noisy(data.touch), distance=distance
    )
    known = {("plate/0", "plate/1"): 0.05}
    arm = linearised(robot, data, socket_distances=known)
    return arm, (FourierSeries(robot, 1),)


CASES = {"repeats": poses_with_repeats, "gaps": positions_beside_poses, "all kinds": all_kinds}


@pytest.mark.parametrize("name", sorted(CASES))
def test_closed_form_equals_solving_without_each_configuration(name: str) -> None:
    arm, features = CASES[name]()
    fitted = arm.fitted(features, 10)
    rows, design, posterior = arm.rows, fitted.design, fitted.posterior
    found = left_out(rows, design, posterior)
    measured = [sensor for sensor in rows.values if not sensor.certain]
    assert len(found.error) == sum(sensor.residual.numel() for sensor in measured)
    scale = float(found.error.square().mean().sqrt())
    for number in range(0, rows.configurations, max(rows.configurations // 25, 1)):
        mask = torch.zeros(rows.configurations, dtype=torch.bool)
        mask[number] = True
        test = rows.of(mask)  # what is certain is not left out
        measured_only = tuple(
            sensor.select(torch.tensor([], dtype=torch.int64)) if sensor.certain else sensor
            for sensor in test.values
        )
        test = replace(test, values=measured_only)
        rest = fitted.sums.minus(sum_up(design, test.values, test.start(design)))
        without = solve_posterior(rest, posterior.prior, posterior.noise)
        for k, sensor in enumerate(test.values):
            own = (found.configuration == number) & (found.sensor == k)
            if sensor.certain or not len(sensor.row):
                assert not bool(own.any())
                continue
            X = design.columns(sensor, slice(None))
            root = sensor.root[:, None] / posterior.noise[k]
            error = (sensor.residual + X @ (test.start(design) - without.x)) * root
            whitened = X * root[..., None]
            spread = (1 + ((whitened @ without.covariance) * whitened).sum(-1)).sqrt()
            assert_close(found.error[own], error.flatten(), atol=1e-6 * scale, rtol=1e-6)
            assert_close(found.spread[own], spread.flatten(), rtol=1e-6)


def test_errors_are_larger_than_the_residuals_and_as_large_as_predicted() -> None:
    arm, features = poses_with_repeats()
    fitted = arm.fitted(features)
    found = left_out(arm.rows, fitted.design, fitted.posterior)
    residual = arm.rows.left(fitted.design, fitted.posterior, fitted.posterior.noise).sum()
    assert float(found.error.square().sum()) > float(residual)
    assert float(found.spread.min()) >= 1.0
    assert 0.8 < float((found.error / found.spread).square().mean()) < 1.25


def test_folds_agree_roughly_with_single_configurations() -> None:
    arm, features = positions_beside_poses()
    fitted = arm.fitted(features)
    one = left_out(arm.rows, fitted.design, fitted.posterior)
    folds = folds_left_out(arm.rows, fitted.design, fitted.posterior, fitted.sums)
    assert sorted(folds.configuration.tolist()) == sorted(one.configuration.tolist())
    assert float(folds.spread.min()) >= 1.0
    ratio = float((folds.error.square().mean() / one.error.square().mean()).sqrt())
    assert 0.8 < ratio < 1.4
    again = folds_left_out(arm.rows, fitted.design, fitted.posterior, fitted.sums)
    assert_close(again.error, folds.error)
