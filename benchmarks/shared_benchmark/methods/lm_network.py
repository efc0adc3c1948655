"""A published hybrid: geometry, then a small network of the joint values trained by Levenberg-Marquardt, with numpy."""

import numpy as np

from shared_benchmark.methods._residual import Correct, fit_residuals, names_of, with_targets
from shared_benchmark.rows import Array, Method, Predict, Rows, Task

SIZES = (10, 20, 40)
"""Numbers of hidden units, of which the one with the smallest validation error is used."""
EPOCHS, PATIENCE = 300, 6
DAMPING, DECREASE, INCREASE, LARGEST = 1e-3, 0.1, 10.0, 1e10
"""Damping and its factors after a good and a bad step, as in Hagan and Menhaj 1994."""
VALIDATION = 0.15
"""Share of the training rows whose error stops the training when it has risen `PATIENCE` times."""


class _Network:
    """One layer of hyperbolic tangents and a linear layer, `y = W2 [tanh(W1 [x, 1]), 1]`."""

    def __init__(self, inputs: int, hidden: int, outputs: int, generator: np.random.Generator) -> None:
        self.shapes = (hidden, inputs + 1), (outputs, hidden + 1)
        self.weights = np.concatenate(
            [generator.standard_normal(shape).ravel() / np.sqrt(shape[1]) for shape in self.shapes]
        )

    def layers(self, weights: Array) -> tuple[Array, Array]:
        """Return the matrices of both layers."""
        count = self.shapes[0][0] * self.shapes[0][1]
        return weights[:count].reshape(self.shapes[0]), weights[count:].reshape(self.shapes[1])

    def outputs(self, weights: Array, x: Array) -> Array:
        """Return the outputs (rows, outputs) of inputs with a last column of ones."""
        first, second = self.layers(weights)
        hidden = np.tanh(x @ first.T)
        return hidden @ second[:, :-1].T + second[:, -1]

    def jacobian(self, weights: Array, x: Array) -> Array:
        """Return the derivatives of all outputs (rows * outputs, weights)."""
        first, second = self.layers(weights)
        hidden, count = np.tanh(x @ first.T), len(second)
        slope = second[None, :, :-1] * (1 - hidden**2)[:, None, :]
        by_first = np.einsum("noh,ni->nohi", slope, x).reshape(len(x) * count, -1)
        with_one = np.concatenate([hidden, np.ones((len(x), 1))], 1)
        by_second = np.einsum("op,nh->noph", np.eye(count), with_one).reshape(len(x) * count, -1)
        return np.concatenate([by_first, by_second], 1)

    def train(self, x: Array, y: Array, held_out: Array) -> float:
        """Minimise the squared errors of the other rows; keep the weights with the smallest validation error."""

        def error(weights: Array, rows: Array) -> float:
            return float(np.square(self.outputs(weights, x[rows]) - y[rows]).mean())

        weights, damping, risen = self.weights, DAMPING, 0
        cost, best = error(weights, ~held_out), error(weights, held_out)
        for _ in range(EPOCHS):
            J = self.jacobian(weights, x[~held_out])
            gradient = J.T @ (y[~held_out] - self.outputs(weights, x[~held_out])).ravel()
            squares = J.T @ J
            while damping <= LARGEST:
                step = np.linalg.solve(squares + damping * np.eye(len(squares)), gradient)
                tried = error(weights + step, ~held_out)
                if tried < cost:
                    break
                damping *= INCREASE
            else:
                break
            weights, cost, damping = weights + step, tried, max(damping * DECREASE, 1e-20)
            now = error(weights, held_out)
            risen = 0 if now < best else risen + 1
            if now < best:
                self.weights, best = weights, now
            if risen == PATIENCE:
                break
        return best


def _regression(train: Rows, residual: Array, seed: int) -> Correct:
    generator = np.random.default_rng(seed)
    names, middle = names_of(train), (train.q.max(0) + train.q.min(0)) / 2
    half = np.maximum((train.q.max(0) - train.q.min(0)) / 2, 1e-9)

    def inputs(rows: Rows) -> Array:
        scaled = with_targets((rows.q - middle) / half, rows, names)
        return np.concatenate([scaled, np.ones((len(scaled), 1))], 1)

    x, scale = inputs(train), residual.std()
    groups = np.unique(train.q, axis=0, return_inverse=True)[1].ravel()
    order = generator.permutation(int(groups.max()) + 1)
    held_out = np.isin(groups, order[: max(1, round(VALIDATION * len(order)))])
    networks = [_Network(x.shape[1] - 1, size, 3, generator) for size in SIZES]
    errors = [network.train(x, residual / scale, held_out) for network in networks]
    best = networks[int(np.argmin(errors))]
    return lambda rows: (best.outputs(best.weights, inputs(rows)) * scale, None)


def fit(task: Task) -> Predict:
    """Fit the geometry, and a network from joint values to its position errors.

    Nguyen, Zhou and Kang 2015 identify the geometry by a Kalman filter, whose result for constant parameters is that of
    the least squares here. The sizes of the network and the rule that stops the training are ours.
    """
    return fit_residuals(task, _regression)


METHOD = Method(
    name="lm_network",
    title="geometry, then a network of 10, 20 or 40 hidden units by Levenberg-Marquardt",
    source="Nguyen, Zhou and Kang 2015, Neurocomputing 151, re-implemented from its formulas",
    packages=("numpy", "scipy"),
    measured=("position", "pose"),
    fit=fit,
)
