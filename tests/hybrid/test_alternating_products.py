"""Columns of product units with one factor free, and factors from a symmetric bilinear form."""

import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import product_values
from testing.linearised import drawn_joints
from torch import Tensor

from pisigma.hybrid.alternating_products import (
    AlternatingProducts,
    InputPairs,
    normalised,
    with_bias,
)
from pisigma.joint_correction.feature import unit_inputs
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def written_out(robot: Robot, factors: Tensor, orders: tuple[int, ...], q: Tensor) -> Tensor:
    """Sums of products, one unit after the other."""
    phi = with_bias(robot, q)
    total, start = torch.zeros_like(q), 0
    for order in orders:
        unit = torch.ones_like(q)
        for s in range(start, start + order):
            unit = unit * (phi @ factors[:, s].t())
        total, start = total + unit, start + order
    return total


@pytest.mark.parametrize("orders", [(2,), (2, 2), (3, 2)])
@pytest.mark.parametrize("name", ["ur5", "kiro3"])
def test_columns_times_free_weights_are_the_products(name: str, orders: tuple[int, ...]) -> None:
    robot = Robot.load(name)
    q = drawn_joints(robot, 20, 0)
    inputs = with_bias(robot, q).shape[-1]
    factors = normal(robot.dof, sum(orders), inputs)
    expected = written_out(robot, factors, orders, q)
    assert_close(product_values(robot, factors, orders, q), expected, atol=1e-12)
    network = JointCorrection(robot, (), orders)
    with torch.no_grad():
        network.bias.copy_(factors[..., 0])
        network.weight.copy_(factors[..., 1:])
        assert_close(network(q), expected, atol=1e-12)
    for turn in range(max(orders) + 1):
        held = AlternatingProducts(robot, orders, factors, turn)
        assert all(0 <= free - sum(orders[:u]) < orders[u] for u, free in enumerate(held.free))
        weights = factors[:, list(held.free)].flatten()
        columns = held.columns(JointState(q))
        assert columns.shape == (20, robot.dof, held.count)
        assert_close((columns * weights.view(robot.dof, -1)).sum(-1), expected, atol=1e-12)
        assert_close(held.solved(weights), factors)
        changed = held.solved(weights + 1)
        still = [s for s in range(sum(orders)) if s not in held.free]
        assert_close(changed[:, still], factors[:, still])
        assert_close(changed[:, list(held.free)], factors[:, list(held.free)] + 1, atol=1e-14)


def test_every_factor_gets_its_turn() -> None:
    robot = Robot.load("ur5")
    free = [
        AlternatingProducts(robot, (2, 3), torch.zeros(6, 5, 13).double(), turn).free for turn in range(6)
    ]
    assert free == [(0, 2), (1, 3), (0, 4), (1, 2), (0, 3), (1, 4)]


def test_batches_of_any_shape_have_columns() -> None:
    robot = Robot.load("kiro3")
    pairs = InputPairs(robot)
    held = AlternatingProducts(robot, (2,), normal(4, 2, pairs.inputs + 1), 0)
    q = drawn_joints(robot, 6, 0)
    for features in (pairs, held):
        flat = features.columns(JointState(q))
        assert_close(features.columns(JointState(q.view(2, 3, 4))), flat.view(2, 3, 4, -1))
        assert_close(features.columns(JointState(q[0])), flat[0])


def test_pairs_are_products_of_inputs_of_different_joints() -> None:
    robot = Robot.load("kiro3")
    pairs, q = InputPairs(robot), drawn_joints(robot, 5, 0)
    assert pairs.inputs == 2 * 3 + 1  # sines and cosines of three joints, the travel of the fourth
    assert len(pairs.pairs) == 7 * 6 // 2 - 3
    phi = unit_inputs(robot, q)
    for column, (a, b) in enumerate(pairs.pairs):
        assert_close(pairs.columns(JointState(q))[:, 2, column], phi[:, a] * phi[:, b], atol=1e-15)
    turning = [0, 1, 3]
    same = {(k, 3 + k) for k in range(len(turning))}
    assert not same & set(pairs.pairs)


def bilinear(pairs: InputPairs, r: Tensor, s: Tensor) -> Tensor:
    """Weights of the pairs of `(r · φ)(s · φ)` per joint, for r and s without a pair of one joint."""
    return torch.stack([r[:, a] * s[:, b] + r[:, b] * s[:, a] for a, b in pairs.pairs], -1)


def parted(robot: Robot, seed: int, first: list[int], second: list[int]) -> tuple[Tensor, Tensor]:
    """Two factors that see different joints."""
    r, s = normal(robot.dof, 2 * robot.dof, seed=seed), normal(robot.dof, 2 * robot.dof, seed=seed + 1)
    r[:, second], s[:, first] = 0.0, 0.0
    return r, s


def test_a_product_is_rebuilt_from_its_bilinear_form() -> None:
    """One unit for a form of rank two, `(r · φ)(s · φ)`; further factors are 1."""
    robot = Robot.load("ur5")
    pairs, q = InputPairs(robot), drawn_joints(robot, 30, 0)
    first, second = [0, 1, 2, 6, 7, 8], [3, 4, 5, 9, 10, 11]
    r, s = parted(robot, 1, first, second)
    weights = bilinear(pairs, r, s)
    expected = (pairs.columns(JointState(q)) * weights).sum(-1)
    phi = unit_inputs(robot, q)
    assert_close(expected, (phi @ r.t()) * (phi @ s.t()), atol=1e-12)
    for orders in ((2,), (3,), (2, 2)):
        factors = pairs.factors(weights.flatten(), orders)
        assert_close(product_values(robot, factors, orders, q), expected, atol=1e-12)


def test_two_products_are_rebuilt_by_two_units_and_not_by_one() -> None:
    robot = Robot.load("ur5")
    pairs, q = InputPairs(robot), drawn_joints(robot, 30, 0)
    first = parted(robot, 1, [0, 1, 2, 6, 7, 8], [3, 4, 5, 9, 10, 11])
    second = parted(robot, 3, [0, 2, 4, 6, 8, 10], [1, 3, 5, 7, 9, 11])
    weights = bilinear(pairs, *first) + bilinear(pairs, *second)
    expected = (pairs.columns(JointState(q)) * weights).sum(-1)
    two = product_values(robot, pairs.factors(weights.flatten(), (2, 2)), (2, 2), q)
    assert_close(two, expected, atol=1e-11)
    one = product_values(robot, pairs.factors(weights.flatten(), (2,)), (2,), q)
    off = float((one - expected).square().mean() / expected.square().mean())
    assert 0.01 < off < 0.9


def test_nothing_gives_factors_that_are_nothing() -> None:
    robot = Robot.load("ur5")
    pairs = InputPairs(robot)
    factors = pairs.factors(torch.zeros(6 * len(pairs.pairs), dtype=torch.float64), (2, 3))
    assert_close(factors[:, :4], torch.zeros(6, 4, 13))
    assert_close(factors[:, 4, 0], torch.ones(6))


def test_normalised_factors_have_length_one() -> None:
    factors = 1e-4 * normal(4, 3, 7)
    factors[1, 2] = 0.0
    found = normalised(factors)
    assert_close(found.norm(dim=-1), torch.ones(4, 3), atol=1e-14)
    assert_close(found[0], factors[0] / factors[0].norm(dim=-1, keepdim=True), atol=1e-14)
    assert found[1, 2].tolist() == [1.0, *[0.0] * 6]
