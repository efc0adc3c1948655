"""Two arms of one torso: one base, one set of parameters of the shared joints, and honest errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.torso import ARMS, NOISE, TORSO, measured_rows, nominal_arms, own_fit, true_arm

from pisigma.calibration.frames.arm_bases import fit_arm_bases
from pisigma.calibration.frames.shared_objects import ArmPosterior, uncertainty_of
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian


def fitted(folder, seed: int, joints: int, zeros: tuple[float, float] = (0.0, 0.0)):
    """Return the true arms, their rows, their own fits, and their bases."""
    nominal = nominal_arms(folder, joints)
    true = [true_arm(nominal, k, seed, joints, zeros[k]) for k in (0, 1)]
    rows = [measured_rows(robot, 10 * seed + k) for k, robot in enumerate(true)]
    fits = [own_fit(*one) for one in zip(nominal, rows, strict=True)]
    arms = [
        ArmPosterior(name, uncertainty_of(fit), torso_joints=TORSO[:joints])
        for name, fit in zip(ARMS, fits, strict=True)
    ]
    return true, rows, fits, fit_arm_bases(arms)


@pytest.mark.parametrize("joints", [1, 2])
def test_arms_have_one_base_and_equal_parameters_of_the_shared_joints(tmp_path, joints):
    true, rows, _, found = fitted(tmp_path, 0, joints)
    left, right = found.updated_arms
    assert [one.key for one in found.shared][:joints] == [("joint", name) for name in TORSO[:joints]]
    assert found.conditioned.degrees_of_freedom == 4 * joints
    assert found.disagreements == ()
    shared = 5 * (joints - 1)
    assert_close(left.values[:shared], right.values[:shared], atol=1e-12)
    assert_close(left.covariance_root[:shared], right.covariance_root[:shared], atol=1e-12)
    base = list(left.base_indices("hall"))
    assert_close(left.values[base], right.values[list(right.base_indices("hall"))], atol=1e-9)
    assert_close(
        left.covariance_root[base], right.covariance_root[list(right.base_indices("hall"))], atol=1e-9
    )
    T, covariance = found.relative(0, 1)
    assert_close(T, np.eye(4), atol=1e-12)
    assert_close(covariance, np.zeros((6, 6)), atol=1e-18)
    for arm, robot, measured in zip((left, right), true, rows, strict=True):
        q = measured.q[:20] * 0.5
        geometry = arm.uncertainty.geometry.robot
        error = forward_kinematics(geometry, q)[:, :3, 3] - forward_kinematics(robot, q)[:, :3, 3]
        deviation = arm.uncertainty.sigma(replace(measured.select(torch.arange(20)), q=q))
        assert 0.5 < float(error.norm() / deviation.norm()) < 1.6
        assert float(deviation.max()) < 3 * NOISE


def bound_of_tools(true, rows, fits, q, joints: int) -> np.ndarray:
    """Return the Cramér-Rao bound of the positions of both tools at joint values, with the noise of the arms' fits."""

    def columns(number: int, q: torch.Tensor) -> torch.Tensor:
        """Return derivatives by the shared rows and the base, and by the other parameters of both arms."""
        J = identification_jacobian(true[number], q)[1][:, :3]
        size = 5 * len(true[number].rows)
        common = [*range(5 * (joints - 1)), *range(size, size + 6)]
        own = [*range(5 * (joints - 1), size), *range(size + 6, size + 9)]
        blank = torch.zeros(*J.shape[:2], len(own)).to(J)
        return torch.cat([J[..., common], *(J[..., own] if k == number else blank for k in (0, 1))], -1)

    X = torch.cat(
        [columns(k, one.q) / fit.noise[0].sigma for k, (one, fit) in enumerate(zip(rows, fits, strict=True))]
    ).flatten(0, 1)
    half = torch.linalg.pinv(X, rtol=1e-10)
    return np.stack([(columns(k, one) @ half).square().sum(-1).sqrt().numpy() for k, one in enumerate(q)])


@pytest.mark.parametrize("joints", [1, 2])
def test_errors_of_both_tools_are_those_of_one_fit_of_all_rows(tmp_path, joints):
    true, rows, fits, found = fitted(tmp_path, 1, joints)
    few = [one.select(torch.arange(12)) for one in rows]
    bound = bound_of_tools(true, rows, fits, [one.q for one in few], joints)
    stated = [arm.uncertainty.sigma(one).numpy() for arm, one in zip(found.updated_arms, few, strict=True)]
    assert_close(np.array(stated) / bound, 1.0, atol=0.02)
    alone = [
        arm.uncertainty.sigma(one).numpy() for arm, one in zip(found.individual_posteriors, few, strict=True)
    ]
    assert float(np.mean(stated) / np.mean(alone)) < 0.98


def test_moved_axis_is_named(tmp_path):
    """The zero of the waist differs between the arms, so that they place the axis of the chest differently."""
    assert fitted(tmp_path, 2, 2)[3].disagreements == ()
    found = fitted(tmp_path, 2, 2, (0.0, 2e-3))[3].disagreements
    assert {("joint", "chest"), ("frame", "hall")} <= {one.shared.key for one in found}
