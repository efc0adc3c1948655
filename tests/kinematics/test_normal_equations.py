"""Systems written out on components against LAPACK, and motion by matrices against that on components."""

import pytest
import torch
from testing.closeness import assert_close

from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.jacobian import joint_jacobian
from pisigma.kinematics.matrix_chain import FEW, matrix_chain
from pisigma.kinematics.normal_equations import solve_normal


def systems(n: int, rows: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(n)
    A = torch.randn(rows, n, n, generator=generator, dtype=torch.float64)
    return A, torch.randn(rows, n, generator=generator, dtype=torch.float64)


def solved(A, e, damping=None):
    return solve_normal([list(row.unbind()) for row in A.movedim(0, -1)], list(e.unbind(1)), damping)


@pytest.mark.parametrize("n", [2, 3, 6])
def test_a_regular_system(n):
    A, e = systems(n)
    found = solved(A, e)
    assert_close((A @ torch.stack(found.step, -1)[..., None])[..., 0], e, atol=1e-8)
    assert_close(found.determinant, torch.linalg.det(A).abs(), rtol=1e-7, atol=1e-10)
    assert_close(found.trace, A.square().sum((-1, -2)), rtol=1e-13)
    least = torch.linalg.svdvals(A)[:, -1]
    assert bool((found.least_singular_value() <= least * (1 + 1e-6)).all())
    assert bool((found.least_singular_value() > 0).all())


def test_a_damped_system():
    A, e = systems(6)
    damping = torch.linspace(0.1, 2.0, len(A), dtype=torch.float64)
    eye = torch.eye(6, dtype=torch.float64)
    expected = A.mT @ torch.linalg.solve(A @ A.mT + damping[:, None, None] * eye, e[..., None])
    assert_close(torch.stack(solved(A, e, damping).step, -1), expected[..., 0], atol=1e-12)


def test_a_singular_system_is_known_by_its_bound():
    A, e = systems(6)
    A[:, 5] = A[:, 4]
    assert float(solved(A, e).least_singular_value().nan_to_num().max()) < 1e-6


def test_few_poses_move_as_many_do(robot, robots):
    for arm in (robot, robots.dress(robot)):
        q = robots.random_joints(arm, torch.Generator().manual_seed(0), FEW + 5)
        T, J = joint_jacobian(arm, q)
        T_few, J_few = matrix_chain(arm).motion(q)
        assert_close(T_few, T, atol=1e-14)
        assert_close(J_few, J, atol=1e-14)
        T_two, J_two = joint_jacobian(arm, q[:2].float())
        assert T_two.dtype == J_two.dtype == torch.float32
        assert_close(T_two, forward_kinematics(arm, q[:2]), atol=1e-5)
        assert_close(J_two, J[:2], atol=1e-5)
