"""Levenberg-Marquardt training of Pi-Sigma networks: every output a small problem of its own, many at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pisigma.network.energy import output_jacobian
from pisigma.network.pi_sigma import PiSigma, draw_uniform, sum_of_products, weigh_sums

DAMPING_START = 1e-2
DAMPING_RANGE = (1e-14, 1e10)
CONVERGED = 1e-12
"""A problem has converged when an accepted step lowers its cost by less than this share."""


@dataclass(frozen=True, eq=False)
class Patterns:
    """Scaled patterns of one network.

    Attributes:
        x: scaled inputs.
        d: scaled targets.
        weight: weight of every pattern, 0 to leave it out.
        validation: patterns that choose between starts and are not fitted.
    """

    x: Float[Tensor, "patterns inputs"]
    d: Float[Tensor, "patterns outputs"]
    weight: Float[Tensor, " patterns"]
    validation: Bool[Tensor, " patterns"]


class LevenbergMarquardt(nn.Module):
    """Damped Gauss-Newton on `1/2 Σ_μ weight (d - y)² + 1/2 ridge Σ w²`, for several starts and all outputs.

    Steps solve `(J^T J + λ diag(J^T J)) δ = J^T r` with the Jacobian in closed form (Marquardt 1963); λ falls by 10
    after a step that lowers the cost and rises by 10 after one that does not, which is then taken back. Everything is
    a buffer, so that an interrupted training resumes exactly.

    Attributes:
        parameters_now: `(starts, outputs, units, inputs + 1)`: weights and, last, the bias.
        damping: `(starts, outputs)`: λ.
        cost: `(starts, outputs)`: of the fitted patterns, with the ridge.
        best: the parameters of every start with the lowest validation error so far.
        best_error: `(starts, outputs)`: that error, the mean square over the validation patterns.
    """

    parameters_now: Tensor
    damping: Tensor
    cost: Tensor
    best: Tensor
    best_error: Tensor
    moving: Tensor

    def __init__(self, network: PiSigma, starts: int, spread: float, ridge: float, generator: torch.Generator) -> None:
        """Draw the starts as `PiSigma.initialise` does.

        Args:
            network: gives the structure and the fixed weights; it is not changed before `write_best`.
            starts: number of starts.
            spread: half width of the uniform start of weights and biases.
            ridge: strength of the pull of the weights (not the biases) towards 0, in scaled units.
            generator: source of the starts.
        """
        super().__init__()
        self.orders: Sequence[int] = network.orders
        self.ridge = ridge
        shape = (starts, network.outputs, sum(network.orders), network.inputs + 1)
        start = network.bias.new_zeros(shape)
        start[..., -1] = 1.0
        start = start + draw_uniform(start, spread, generator)
        self.register_buffer("fixed", network.fixed.clone())
        self.register_buffer("parameters_now", start)
        self.register_buffer("damping", start.new_full(shape[:2], DAMPING_START))
        self.register_buffer("cost", start.new_full(shape[:2], torch.inf))
        self.register_buffer("best", start.clone())
        self.register_buffer("best_error", start.new_full(shape[:2], torch.inf))
        self.register_buffer("moving", torch.ones(shape[:2], dtype=torch.bool))

    @torch.no_grad()
    def iterate(self, patterns: Patterns) -> Float[Tensor, " outputs"]:
        """Take one step with every start and output.

        Returns:
            Energy (eq. 3, all weighted patterns) of the best start of every output.
        """
        fitted = torch.where(patterns.validation, 0.0, 1.0).to(patterns.weight) * patterns.weight
        weighted = self._weigh(patterns.x, self.parameters_now)
        residual = (patterns.d[:, None, :] - sum_of_products(weighted, self.orders)).movedim(0, -1)
        if not torch.isfinite(self.cost).any():
            self.cost = self._cost(residual, self.parameters_now, fitted)
            self._remember(patterns, residual, torch.ones_like(self.moving))
        J = output_jacobian(patterns.x, weighted, self.fixed, self.orders)
        step = self._solve(J, residual, fitted)
        self._try(step, patterns, fitted)
        return self._energy(patterns)

    @property
    def converged(self) -> bool:
        """Whether no problem moves any more."""
        return not bool(self.moving.any())

    @torch.no_grad()
    def write_best(self, network: PiSigma) -> None:
        """Give the network, for every output, the parameters of the start with the lowest validation error."""
        winner = self.best_error.argmin(0)
        chosen = self.best[winner, torch.arange(self.best.shape[1])]
        network.weight.copy_(chosen[..., :-1])
        network.bias.copy_(chosen[..., -1])

    def _weigh(self, x: Tensor, parameters: Tensor) -> Tensor:
        return weigh_sums(x, parameters[..., :-1], parameters[..., -1], self.fixed)

    def _residual(self, patterns: Patterns, parameters: Tensor) -> Tensor:
        products = sum_of_products(self._weigh(patterns.x, parameters), self.orders)
        return (patterns.d[:, None, :] - products).movedim(0, -1)

    def _cost(self, residual: Tensor, parameters: Tensor, fitted: Tensor) -> Tensor:
        pull = parameters[..., :-1].square().sum((-1, -2)) * self.ridge
        return ((residual.square() * fitted).sum(-1) + pull) / 2

    def _solve(self, J: Tensor, residual: Tensor, fitted: Tensor) -> Tensor:
        size = J.shape[-1]
        weighted_J = J * fitted[:, None]
        A = weighted_J.mT @ J
        g = (weighted_J.mT @ residual[..., None])[..., 0]
        pull = torch.full_like(self.parameters_now, self.ridge)
        pull[..., -1] = 0.0
        A = A + torch.diag_embed(pull.flatten(-2))
        g = g - (pull * self.parameters_now).flatten(-2)
        diagonal = A.diagonal(dim1=-2, dim2=-1)
        floor = diagonal.amax(-1, keepdim=True) * 1e-12 + torch.finfo(A.dtype).tiny
        damped = A + torch.diag_embed(self.damping[..., None] * diagonal.clamp_min(floor) + floor * 1e-3)
        factor, info = torch.linalg.cholesky_ex(damped)
        eye = torch.eye(size, dtype=A.dtype, device=A.device)
        factor = torch.where((info == 0)[..., None, None], factor, eye)
        step = torch.cholesky_solve(g[..., None], factor)[..., 0]
        step = torch.where((info == 0)[..., None], step, torch.zeros_like(step))
        return step.reshape(self.parameters_now.shape)

    def _try(self, step: Tensor, patterns: Patterns, fitted: Tensor) -> None:
        candidate = self.parameters_now + step
        residual = self._residual(patterns, candidate)
        cost = self._cost(residual, candidate, fitted)
        accepted = (cost < self.cost) & self.moving
        gain = torch.where(accepted, self.cost - cost, torch.zeros_like(cost))
        tiny = accepted & (gain <= CONVERGED * self.cost)
        self.parameters_now = torch.where(accepted[..., None, None], candidate, self.parameters_now)
        self.cost = torch.where(accepted, cost, self.cost)
        lower, upper = DAMPING_RANGE
        stuck = ~accepted & (self.damping >= upper)
        factor = torch.where(accepted, 0.1, 10.0).to(self.damping)
        self.damping = (self.damping * factor).clamp(lower, upper)
        self.moving = self.moving & ~tiny & ~stuck & (self.cost > 0)
        self._remember(patterns, residual, accepted)

    def _remember(self, patterns: Patterns, residual: Tensor, changed: Tensor) -> None:
        """Keep what does best on the validation patterns, or on the fitted ones where there are none to validate."""
        chosen = patterns.validation if patterns.validation.any() else torch.ones_like(patterns.validation)
        weight = patterns.weight * chosen
        error = (residual.square() * weight).sum(-1) / weight.sum()
        better = changed & (error < self.best_error)
        self.best_error = torch.where(better, error, self.best_error)
        self.best = torch.where(better[..., None, None], self.parameters_now, self.best)

    def _energy(self, patterns: Patterns) -> Tensor:
        winner = self.best_error.argmin(0)
        chosen = self.best[winner, torch.arange(self.best.shape[1])]
        products = sum_of_products(self._weigh(patterns.x, chosen), self.orders)
        return ((patterns.d - products).square() * patterns.weight[:, None]).sum(0) / 2
