"""Products of inputs of different joints, and their conversion to product units."""

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import random_joints
from torch import Tensor

from pisigma.joint_correction.feature import product_unit_inputs
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def network_of(products: InputProducts, weights: Tensor) -> JointCorrection:
    """Make a correction of product units with the factors of these weights."""
    factors = products.factors(weights)
    made = JointCorrection(products.robot, (), (2,) * (factors.shape[1] // 2)).requires_grad_(False)
    made.weight.copy_(factors)
    return made


def weighted(products: InputProducts, weights: Tensor, q: Tensor) -> Tensor:
    """Return the weighted sum of the columns [rad or m]."""
    return (products.columns(JointState(q)) * weights.view(products.used.shape)).sum(-1)


@pytest.mark.parametrize("name", ["ur5", "kiro3"])
def test_columns_are_products_of_inputs_of_different_joints(name: str) -> None:
    """Computed joint by joint; kiro3 has a prismatic joint, whose input is its scaled value."""
    robot = Robot.load(name)
    products, q = InputProducts(robot), random_joints(robot, 5, 0)
    turning = [j for j, turns in enumerate(robot.revolute) if turns]
    owner = [*turning, *turning, *(j for j in range(robot.dof) if j not in turning)]
    phi = product_unit_inputs(robot, q)
    assert products.inputs == len(owner) == phi.shape[-1]
    wanted = [(a, b) for a in range(len(owner)) for b in range(a + 1, len(owner)) if owner[a] != owner[b]]
    assert products.pairs.t().tolist() == [list(pair) for pair in wanted]
    expected = torch.stack([phi[:, a] * phi[:, b] for a, b in wanted], -1)
    for joint in range(robot.dof):
        assert_close(products.columns(JointState(q))[:, joint], expected, atol=1e-15)


def test_every_joint_has_its_own_prior_size() -> None:
    products = InputProducts(Robot.load("kiro3"))
    assert bool(products.used.all())
    assert products.group.tolist() == [[joint] * products.column_count for joint in range(4)]
    names = [row.name for row in products.robot.joints]
    assert products.group_names == tuple(f"products, {name}" for name in names)
    assert products.label == "products"


def test_batches_of_any_shape_have_columns() -> None:
    products = InputProducts(Robot.load("kiro3"))
    q = random_joints(products.robot, 6, 0)
    flat = products.columns(JointState(q))
    assert_close(products.columns(JointState(q.view(2, 3, 4))), flat.view(2, 3, 4, -1))
    assert_close(products.columns(JointState(q[0])), flat[0])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["ur5", "panda", "kiro3"])
def test_product_units_are_equal_to_the_weighted_sum_of_the_columns(name: str, seed: int) -> None:
    robot = Robot.load(name)
    products, q = InputProducts(robot), random_joints(robot, 40, seed)
    weights = 1e-4 * normal(products.used.numel(), seed=seed)
    made = network_of(products, weights)
    assert len(made.orders) < products.inputs
    assert_close(made(q), weighted(products, weights, q), atol=1e-16 * products.column_count)


def test_one_unit_is_enough_for_one_product_of_two_sums() -> None:
    """For `(r · φ)(s · φ)` with r and s on different joints, which has one eigenvalue of each sign."""
    robot = Robot.load("ur5")
    products, q = InputProducts(robot), random_joints(robot, 30, 0)
    r, s = normal(6, 12, seed=1), normal(6, 12, seed=2)
    first, second = [0, 1, 2, 6, 7, 8], [3, 4, 5, 9, 10, 11]
    r[:, second], s[:, first] = 0.0, 0.0
    a, b = products.pairs
    weights = (r[:, a] * s[:, b] + r[:, b] * s[:, a]).flatten()
    phi = product_unit_inputs(robot, q)
    assert_close(weighted(products, weights, q), (phi @ r.t()) * (phi @ s.t()), atol=1e-12)
    assert_close(network_of(products, weights)(q), (phi @ r.t()) * (phi @ s.t()), atol=1e-12)
    largest = products.factors(weights).norm(dim=-1).view(6, -1, 2).prod(-1)
    assert float(largest[:, 1:].max()) < 1e-6


def test_joints_may_have_different_weights_and_none() -> None:
    robot = Robot.load("rb5")
    products, q = InputProducts(robot), random_joints(robot, 10, 3)
    weights = normal(robot.dof, products.column_count)
    weights[[0, 3]] = 0.0
    made = network_of(products, weights.flatten())
    found = made(q)
    assert_close(found[:, [0, 3]], torch.zeros(10, 2))
    assert_close(found, weighted(products, weights, q), atol=1e-11)


def test_zero_weights_result_in_no_units() -> None:
    products = InputProducts(Robot.load("ur5"))
    factors = products.factors(torch.zeros(products.used.numel(), dtype=torch.float64))
    assert factors.shape == (6, 0, 12)
    q = random_joints(products.robot, 4, 0)
    assert_close(network_of(products, torch.zeros(products.used.numel()).double())(q), torch.zeros(4, 6))


def test_weights_are_restored_from_the_factors():
    products = InputProducts(Robot.load("ur5"))
    weights = normal(int(products.used.sum()), seed=3)
    assert_close(products.weights(products.factors(weights)), weights, atol=1e-12)
    assert_close(products.weights(normal(6, 0, products.inputs)), torch.zeros_like(weights))
