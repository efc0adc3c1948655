"""The derivatives in closed form agree with autograd, eq. (4) and torch.func."""

import pytest
import torch
from testing.closeness import assert_close

from pisigma.network.energy import energy, energy_gradient, output_jacobian, pull_back
from pisigma.network.pi_sigma import PiSigma, sum_of_products, weigh_sums

ORDERS = [(1,), (2,), (3,), (1, 2, 3)]


@pytest.fixture(params=ORDERS, ids=str)
def problem(request, generator):
    net = PiSigma(3, 2, request.param, fixed_product=0.3)
    net.initialise(0.4, generator)
    x = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    d = torch.randn(7, 2, generator=generator, dtype=torch.float64)
    return net, x, d


def test_energy_is_half_the_sum_of_squares():
    outputs = torch.tensor([[1.0, 2.0], [3.0, 5.0]], dtype=torch.float64)
    targets = torch.tensor([[0.0, 2.0], [1.0, 1.0]], dtype=torch.float64)
    assert_close(energy(outputs, targets), torch.tensor([2.5, 8.0], dtype=torch.float64), atol=0)


def test_the_gradient_agrees_with_autograd(problem):
    net, x, d = problem
    E, weight_gradient, bias_gradient = energy_gradient(net, x, d)
    expected = energy(net.products(x), d)
    weight, bias = torch.autograd.grad(expected.sum(), [net.weight, net.bias])
    assert_close(E, expected, rtol=1e-13)
    assert_close(weight_gradient, weight, rtol=1e-11, atol=1e-13)
    assert_close(bias_gradient, bias, rtol=1e-11, atol=1e-13)


def test_the_gradient_agrees_with_equation_4(generator):
    net = PiSigma(2, 1, (3,), fixed_product=0.5)
    net.initialise(0.4, generator)
    x = torch.randn(4, 2, generator=generator, dtype=torch.float64)
    d = torch.randn(4, 1, generator=generator, dtype=torch.float64)
    w, b, W = net.weight[0].tolist(), net.bias[0].tolist(), net.fixed[0].tolist()
    expected_w, expected_b = [[0.0, 0.0] for _ in range(3)], [0.0] * 3
    for row, (target,) in zip(x.tolist(), d.tolist(), strict=True):
        h = [b[j] + w[j][0] * row[0] + w[j][1] * row[1] for j in range(3)]
        y = W[0] * h[0] * W[1] * h[1] * W[2] * h[2]
        for j in range(3):
            others = 1.0
            for i in range(3):
                others *= W[i] * h[i] if i != j else 1.0
            step = -(target - y) * others * W[j]
            expected_b[j] += step
            for i in range(2):
                expected_w[j][i] += step * row[i]
    _, weight_gradient, bias_gradient = energy_gradient(net, x, d)
    assert_close(weight_gradient[0], torch.tensor(expected_w, dtype=torch.float64), rtol=1e-12)
    assert_close(bias_gradient[0], torch.tensor(expected_b, dtype=torch.float64), rtol=1e-12)


def test_the_output_jacobian_agrees_with_torch_func(problem):
    net, x, _ = problem
    fixed, orders = net.fixed, net.orders
    packed = torch.cat([net.weight, net.bias[..., None]], -1).detach()

    def outputs(parameters: torch.Tensor) -> torch.Tensor:
        weighted = weigh_sums(x, parameters[..., :-1], parameters[..., -1], fixed)
        return sum_of_products(weighted, orders)

    weighted = weigh_sums(x, packed[..., :-1], packed[..., -1], fixed)
    J = output_jacobian(x, weighted, fixed, orders)
    full = torch.func.jacrev(outputs)(packed)  # patterns outputs | outputs units inputs + 1
    for k in range(2):
        assert_close(J[k], full[:, k, k].flatten(1), rtol=1e-11, atol=1e-13)
        assert_close(full[:, k, 1 - k], torch.zeros_like(full[:, k, 1 - k]), atol=0)


def test_pull_back_multiplies_by_the_transposed_jacobian(problem):
    net, x, d = problem
    weighted = weigh_sums(x, net.weight, net.bias, net.fixed).detach()
    weight_gradient, bias_gradient = pull_back(d, x, weighted, net.fixed, net.orders)
    J = output_jacobian(x, weighted, net.fixed, net.orders)
    expected = (J.mT @ d.T[..., None])[..., 0].reshape(2, -1, 4)
    assert_close(torch.cat([weight_gradient, bias_gradient[..., None]], -1), expected, rtol=1e-11, atol=1e-13)


def test_the_gradient_is_finite_if_all_sums_are_zero():
    net = PiSigma(2, 1, (3,))
    with torch.no_grad():
        net.bias.zero_()
    x, d = torch.ones(3, 2, dtype=torch.float64), torch.ones(3, 1, dtype=torch.float64)
    for part in energy_gradient(net, x, d):
        assert torch.isfinite(part).all()
