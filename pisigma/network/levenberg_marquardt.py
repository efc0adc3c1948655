"""Levenberg-Marquardt training of Pi-Sigma networks, in parallel for all outputs and starts."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pisigma.network.energy import energy, output_jacobian, pull_back
from pisigma.network.pi_sigma import PiSigma, draw_uniform, sum_of_products, weigh_sums

_DAMPING_START = 1e-2
_DAMPING_RANGE = (1e-14, 1e10)
_DAMPING_FALL, _DAMPING_RISE = 0.2, 3.0

_WINDOW = 5
"""Number of iterations between checks of convergence."""
CONVERGED_SHARE = 0.02
"""Relative decrease of the cost within a window below which a problem has converged."""
CONVERGED_COST_DECREASE = 1e-11
"""Decrease of the cost within a window below which a problem has converged: an RMS of 4e-6 of the range of the targets,
in the scaling of `build_network`."""

_PROBE = 0.1
"""Share of a step used for the finite difference of the curvature along the step."""
_BEND = 0.75
"""Largest ratio of twice the second-order correction to the step at which the correction is used (Transtrum and
Sethna 2012)."""
_CHUNK = 8_000_000
"""Largest number of entries of the Jacobian that are in memory at a time."""


@dataclass(frozen=True, eq=False)
class Patterns:
    """Scaled patterns of one network.

    Attributes:
        x: scaled inputs.
        d: scaled targets.
        validation: held-out patterns, which select among starts.
    """

    x: Float[Tensor, "patterns inputs"]
    d: Float[Tensor, "patterns outputs"]
    validation: Bool[Tensor, " patterns"]


class LevenbergMarquardt(nn.Module):
    """Damped Gauss-Newton on `1/2 Σ_μ (d - y)² + 1/2 ridge Σ w²`, for several starts and all outputs.

    Steps solve `(J^T J + λ diag(J^T J)) δ = J^T r` with the Jacobian in closed form (Marquardt 1963), with a
    second-order correction: `δ - 1/2 (J^T J + λ diag(J^T J))⁻¹ J^T y''`, where y'' is the second derivative along δ
    (geodesic acceleration, Transtrum and Sethna 2012). The second-order correction lengthens steps along curved
    valleys, which exist because factors of a product can be scaled against each other. λ decreases after a step that
    lowers the cost; any other step is rejected, and λ increases. The whole state is in buffers, so that a training
    resumes exactly.

    Attributes:
        parameters_now: `(starts, outputs, units, inputs + 1)`: weights and, last, the bias.
        damping: `(starts, outputs)`: damping λ.
        cost: `(starts, outputs)`: cost of the fitted patterns, including the ridge penalty.
        window_cost: `(starts, outputs)`: cost at the last check of convergence.
        moving: `(starts, outputs)`: mask of the problems that have not converged.
        iterations: number of steps.
        best: parameters of every start with the lowest validation error so far.
        best_error: `(starts, outputs)`: lowest validation error so far, the sum of squares over the validation
            patterns.
    """

    fixed: Tensor
    parameters_now: Tensor
    damping: Tensor
    cost: Tensor
    window_cost: Tensor
    moving: Tensor
    iterations: Tensor
    best: Tensor
    best_error: Tensor

    def __init__(
        self, network: PiSigma, starts: int, spread: float, ridge: float, generator: torch.Generator
    ) -> None:
        """Draw the initial weights and biases of all starts like `PiSigma.initialise`.

        Args:
            network: network with the structure and the fixed weights; it is not changed until `write_best`.
            starts: number of starts.
            spread: half width of the uniform distribution of initial weights and biases.
            ridge: ridge penalty of the weights (not the biases), in scaled units.
            generator: generator of the starts.
        """
        super().__init__()
        self.orders: Sequence[int] = network.orders
        self.ridge = ridge
        shape = (starts, network.outputs, sum(network.orders), network.inputs + 1)
        start = network.bias.new_zeros(shape)
        start[..., -1] = 1.0
        start = start + draw_uniform(start, spread, generator)
        self.register_buffer("fixed", network.fixed.expand(starts, -1, -1).clone())
        self.register_buffer("parameters_now", start)
        self.register_buffer("damping", start.new_full(shape[:2], _DAMPING_START))
        self.register_buffer("cost", start.new_full(shape[:2], torch.inf))
        self.register_buffer("window_cost", start.new_full(shape[:2], torch.inf))
        self.register_buffer("moving", torch.ones(shape[:2], dtype=torch.bool))
        self.register_buffer("iterations", torch.zeros((), dtype=torch.int64))
        self.register_buffer("best", start.clone())
        self.register_buffer("best_error", start.new_full(shape[:2], torch.inf))

    @torch.no_grad()
    def iterate(self, patterns: Patterns) -> Float[Tensor, " outputs"]:
        """Perform one step of every start and output.

        Returns:
            Energy (eq. 3, all patterns) of the best start of every output.
        """
        fitted = (~patterns.validation).to(patterns.x)
        if int(self.iterations) == 0:
            residual = self._residual(patterns, self.parameters_now)
            self.cost = self._cost(residual, self.parameters_now, fitted)
            self._remember(patterns, residual, torch.ones_like(self.moving))
        candidate = self.parameters_now + self._step(patterns, fitted)
        residual = self._residual(patterns, candidate)
        cost = self._cost(residual, candidate, fitted)
        accepted = (cost < self.cost) & self.moving
        self.parameters_now = torch.where(accepted[..., None, None], candidate, self.parameters_now)
        self.cost = torch.where(accepted, cost, self.cost)
        factor = torch.where(accepted, _DAMPING_FALL, _DAMPING_RISE).to(self.damping)
        self.damping = (self.damping * factor).clamp(*_DAMPING_RANGE)
        self._remember(patterns, residual, accepted)
        self._judge_progress()
        best = self._winner()
        weighted = weigh_sums(patterns.x, best[..., :-1], best[..., -1], self.fixed[0])
        return energy(sum_of_products(weighted, self.orders), patterns.d)

    @property
    def converged(self) -> bool:
        """Whether all problems have converged."""
        return not bool(self.moving.any())

    @torch.no_grad()
    def write_best(self, network: PiSigma) -> None:
        """Write the parameters with the lowest validation error of every output into the network."""
        chosen = self._winner()
        network.weight.copy_(chosen[..., :-1])
        network.bias.copy_(chosen[..., -1])

    def _winner(self) -> Tensor:
        """Return the best parameters of the best start for every output."""
        return self.best[self.best_error.argmin(0), torch.arange(self.best.shape[1], device=self.best.device)]

    def _weigh(self, x: Tensor, parameters: Tensor) -> Tensor:
        return weigh_sums(x, parameters[..., :-1], parameters[..., -1], self.fixed)

    def _residual(self, patterns: Patterns, parameters: Tensor) -> Tensor:
        """Return the residuals `d - y` as `(patterns, starts, outputs)`."""
        return patterns.d[:, None, :] - sum_of_products(self._weigh(patterns.x, parameters), self.orders)

    def _cost(self, residual: Tensor, parameters: Tensor, fitted: Tensor) -> Tensor:
        pull = parameters[..., :-1].square().sum((-1, -2)) * self.ridge
        return ((residual.square() * fitted[:, None, None]).sum(0) + pull) / 2

    def _step(self, patterns: Patterns, fitted: Tensor) -> Tensor:
        """Return the step of every problem, including the second-order correction if it is small."""
        weighted = self._weigh(patterns.x, self.parameters_now)
        pull = torch.full_like(self.parameters_now, self.ridge)
        pull[..., -1] = 0.0
        residual = self._residual(patterns, self.parameters_now)
        downhill = self._pull_back(residual, patterns.x, weighted, fitted) - pull * self.parameters_now
        factor = self._factorise(self._normal_matrix(patterns.x, weighted, fitted), pull)
        step = self._solve(factor, downhill)
        ahead, behind = (
            self._residual(patterns, self.parameters_now + sign * _PROBE * step) for sign in (1, -1)
        )
        curvature = (2 * residual - ahead - behind) / _PROBE**2
        bend = -self._solve(factor, self._pull_back(curvature, patterns.x, weighted, fitted)) / 2
        small = 2 * bend.flatten(-2).norm(dim=-1) <= _BEND * step.flatten(-2).norm(dim=-1)
        return torch.where(small[..., None, None], step + bend, step)

    def _pull_back(self, output_gradient: Tensor, x: Tensor, weighted: Tensor, fitted: Tensor) -> Tensor:
        output_gradient = output_gradient * fitted[:, None, None]
        weight_gradient, bias_gradient = pull_back(output_gradient, x, weighted, self.fixed, self.orders)
        return torch.cat([weight_gradient, bias_gradient[..., None]], -1)

    def _normal_matrix(self, x: Tensor, weighted: Tensor, fitted: Tensor) -> Tensor:
        """Return `J^T J` over the fitted patterns, computed in chunks of patterns that fit into memory."""
        size = self.parameters_now.shape[-2] * self.parameters_now.shape[-1]
        rows = max(1, _CHUNK // (self.cost.numel() * size))
        total = x.new_zeros(*self.cost.shape, size, size)
        chunks = (torch.split(values, rows) for values in (x, weighted, fitted))
        for inputs, sums, mask in zip(*chunks, strict=True):
            J = output_jacobian(inputs, sums, self.fixed, self.orders)
            total = total + (J * mask[:, None]).mT @ J
        return total

    def _factorise(self, A: Tensor, pull: Tensor) -> Tensor:
        """Return the Cholesky factor of the damped normal matrix."""
        A = A + torch.diag_embed(pull.flatten(-2))
        diagonal = A.diagonal(dim1=-2, dim2=-1)
        # Parameters without influence on the outputs have a zero diagonal, which the damping would not change.
        floor = diagonal.amax(-1, keepdim=True) * 1e-12 + torch.finfo(A.dtype).tiny
        damping = self.damping[..., None] * diagonal.clamp_min(floor) + floor * 1e-3
        factor, info = torch.linalg.cholesky_ex(A + torch.diag_embed(damping))
        # A matrix that is indefinite due to rounding results in no step; the candidate is not better, so λ increases.
        return torch.where((info == 0)[..., None, None], factor, torch.inf)

    def _solve(self, factor: Tensor, right: Tensor) -> Tensor:
        solved = torch.cholesky_solve(right.flatten(-2)[..., None], factor)[..., 0].reshape(right.shape)
        return torch.where(torch.isfinite(solved), solved, 0.0)

    def _judge_progress(self) -> None:
        self.iterations = self.iterations + 1
        if int(self.iterations) % _WINDOW == 0:
            gain = self.window_cost - self.cost
            self.moving = (
                self.moving & (gain > CONVERGED_SHARE * self.cost) & (gain > CONVERGED_COST_DECREASE)
            )
            self.window_cost = self.cost.clone()

    def _remember(self, patterns: Patterns, residual: Tensor, changed: Tensor) -> None:
        """Keep the parameters with the lowest error on the validation patterns (on all patterns if none)."""
        chosen = patterns.validation if patterns.validation.any() else torch.ones_like(patterns.validation)
        error = (residual.square() * chosen[:, None, None]).sum(0)
        better = changed & (error < self.best_error)
        self.best_error = torch.where(better, error, self.best_error)
        self.best = torch.where(better[..., None, None], self.parameters_now, self.best)
