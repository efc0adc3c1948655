"""Levenberg-Marquardt finds exact solutions, agrees with scipy, and keeps the best start by validation error."""

import numpy as np
import pytest
import scipy.optimize
import torch
from testing.closeness import assert_close

from pisigma.network import levenberg_marquardt
from pisigma.network.levenberg_marquardt import LevenbergMarquardt, Patterns
from pisigma.network.pi_sigma import PiSigma


def patterns(network: PiSigma, generator: torch.Generator, noise: float = 0.0, rows: int = 120) -> Patterns:
    x = 2 * torch.rand(rows, network.inputs, generator=generator, dtype=torch.float64) - 1
    d = network.products(x).detach()
    d = d + noise * torch.randn(d.shape, generator=generator, dtype=torch.float64)
    return Patterns(x, d, torch.rand(rows, generator=generator) < 0.2)


def truth(orders: tuple[int, ...], generator: torch.Generator) -> PiSigma:
    network = PiSigma(3, 2, orders)
    network.initialise(0.5, generator)
    return network


def solve(network: PiSigma, data: Patterns, starts: int = 4, ridge: float = 0.0, seed: int = 1):
    solver = LevenbergMarquardt(network, starts, 0.3, ridge, torch.Generator().manual_seed(seed))
    for _ in range(400):
        solver.iterate(data)
        if solver.converged:
            break
    return solver


@pytest.mark.parametrize("orders", [(1,), (2,), (3,), (1, 2, 3)])
def test_a_representable_target_is_met_exactly_and_the_solver_stops(orders, generator):
    network = truth(orders, generator)
    data = patterns(network, generator)
    solver = solve(network, data)
    assert solver.converged
    assert int(solver.iterations) < 200
    assert_close(solver.cost.amin(0), torch.zeros(2, dtype=torch.float64), atol=1e-26)
    found = PiSigma(3, 2, orders)
    solver.write_best(found)
    assert_close(found.products(data.x), data.d, atol=1e-12)


@pytest.mark.parametrize("ridge", [0.0, 1e-3])
def test_the_cost_is_scipys_or_lower_from_the_same_start(ridge, generator, monkeypatch):
    for name in ("CONVERGED_SHARE", "CONVERGED_COST_DECREASE"):
        monkeypatch.setattr(levenberg_marquardt, name, 0.0)
    network = truth((1, 2), generator)
    data = patterns(network, generator, noise=0.1)
    solver = LevenbergMarquardt(network, 1, 0.3, ridge, torch.Generator().manual_seed(2))
    start = solver.parameters_now[0].clone()
    x, d = data.x[~data.validation].numpy(), data.d[~data.validation].numpy()
    for output in range(2):

        def residuals(flat: np.ndarray, output: int = output) -> np.ndarray:
            p = flat.reshape(3, 4)
            h = x @ p[:, :-1].T + p[:, -1]
            difference = h[:, 0] + h[:, 1] * h[:, 2] - d[:, output]
            return np.concatenate([difference, ridge**0.5 * p[:, :-1].flatten()])

        peer = scipy.optimize.least_squares(residuals, start[output].flatten().numpy(), method="lm")
        ours = solve_from(network, data, start, ridge)
        assert float(ours.cost[0, output]) <= peer.cost * (1 + 1e-6)


def solve_from(network: PiSigma, data: Patterns, start: torch.Tensor, ridge: float) -> LevenbergMarquardt:
    solver = LevenbergMarquardt(network, 1, 0.3, ridge, torch.Generator())
    solver.parameters_now = start[None].clone()
    for _ in range(150):
        solver.iterate(data)
    return solver


def test_validation_rows_are_held_out_and_select_the_start(generator):
    network = truth((2,), generator)
    data = patterns(network, generator, noise=0.05)
    spoilt = Patterns(data.x, torch.where(data.validation[:, None], 9.0, data.d), data.validation)
    clean, other = solve(network, data, seed=3), solve(network, spoilt, seed=3)
    assert_close(other.parameters_now, clean.parameters_now, atol=0)
    assert_close(other.cost, clean.cost, atol=0)
    assert float((other.best_error - clean.best_error).min()) > 0

    residual = data.d[:, None] - (clean.best[..., :-1] @ data.x.T + clean.best[..., -1:]).prod(-2).permute(
        2, 0, 1
    )
    error = (residual.square() * data.validation[:, None, None]).sum(0)
    assert_close(clean.best_error, error, rtol=1e-10)
    found = PiSigma(3, 2, (2,))
    clean.write_best(found)
    for output, start in enumerate(error.argmin(0).tolist()):
        assert_close(found.weight[output], clean.best[start, output, :, :-1], atol=0)


def test_without_validation_rows_the_fitted_rows_select_the_start(generator):
    network = truth((2,), generator)
    data = patterns(network, generator, noise=0.05)
    data = Patterns(data.x, data.d, torch.zeros_like(data.validation))
    solver = solve(network, data)
    assert_close(solver.best_error / 2, solver.cost, rtol=1e-9)


def test_problems_are_solved_independently(generator):
    network = truth((1, 2), generator)
    data = patterns(network, generator, noise=0.05)
    other = Patterns(data.x, torch.stack([data.d[:, 0], data.d[:, 1].flip(0)], 1), data.validation)
    first, second = solve_n(network, data), solve_n(network, other)
    assert_close(second.best[:, 0], first.best[:, 0], atol=0)
    assert float((second.best[:, 1] - first.best[:, 1]).abs().max()) > 1e-3


def solve_n(network: PiSigma, data: Patterns) -> LevenbergMarquardt:
    solver = LevenbergMarquardt(network, 3, 0.3, 1e-6, torch.Generator().manual_seed(1))
    for _ in range(20):
        solver.iterate(data)
    return solver


def test_the_normal_matrix_in_chunks_is_the_same(generator, monkeypatch):
    network = truth((1, 2), generator)
    data = patterns(network, generator, noise=0.05)
    whole = solve_n(network, data)
    monkeypatch.setattr(levenberg_marquardt, "_CHUNK", 7 * 6 * 12)
    assert_close(solve_n(network, data).cost, whole.cost, rtol=1e-6)


def test_a_constant_target_is_fitted(generator):
    x = 2 * torch.rand(50, 3, generator=generator, dtype=torch.float64) - 1
    data = Patterns(x, torch.zeros(50, 2, dtype=torch.float64), torch.zeros(50, dtype=torch.bool))
    solver = solve(PiSigma(3, 2, (3,)), data)
    assert torch.isfinite(solver.best).all()
    assert float(solver.cost.max()) < 1e-6


def test_fixed_weights_are_unchanged(generator):
    network = PiSigma(3, 2, (1, 2), fixed_product=0.2)
    before = network.fixed.clone()
    solver = solve(network, patterns(truth((1, 2), generator), generator, noise=0.1))
    solver.write_best(network)
    assert_close(network.fixed, before, atol=0)
    assert not list(solver.parameters())
