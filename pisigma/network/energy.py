"""Energy of a Pi-Sigma network: value, derivatives in closed form, and history during training."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.network.pi_sigma import PiSigma, products_of_others, sum_of_products, weigh_sums


def energy(
    outputs: Float[Tensor, "patterns *models"], targets: Float[Tensor, "patterns *models"]
) -> Float[Tensor, "*models"]:
    """Return the energy `E = 1/2 Σ_μ (d - y)²` over the patterns for every output (Jeong et al. 1998, eq. 3)."""
    return (targets - outputs).square().sum(0) / 2


def energy_gradient(
    network: PiSigma, x: Float[Tensor, "patterns inputs"], d: Float[Tensor, "patterns outputs"]
) -> tuple[Float[Tensor, " outputs"], Float[Tensor, "outputs units inputs"], Float[Tensor, "outputs units"]]:
    """Compute the energy of every output and its gradient (Jeong et al. 1998, eq. 4).

    `∂E/∂h_j = -Σ_μ (d - y) · Π_{i≠j} W_i h_i · W_j`, times `∂h_j/∂w_ji = x_i`, or times 1 for the bias.

    Args:
        network: the network.
        x: scaled inputs.
        d: scaled targets.

    Returns:
        The energy of every output, and its gradients with respect to `network.weight` and `network.bias`.
    """
    weighted = weigh_sums(x, network.weight.detach(), network.bias.detach(), network.fixed)
    difference = d - sum_of_products(weighted, network.orders)
    weight_gradient, bias_gradient = pull_back(-difference, x, weighted, network.fixed, network.orders)
    return difference.square().sum(0) / 2, weight_gradient, bias_gradient


def pull_back(
    output_gradient: Float[Tensor, "patterns *models"],
    x: Float[Tensor, "patterns inputs"],
    weighted_sums: Float[Tensor, "patterns *models units"],
    fixed: Float[Tensor, "*models units"],
    orders: Sequence[int],
) -> tuple[Float[Tensor, "*models units inputs"], Float[Tensor, "*models units"]]:
    """Backpropagate derivatives with respect to the outputs to weights and biases, summed over the patterns.

    Args:
        output_gradient: derivative of any quantity with respect to every output of every pattern.
        x: scaled inputs.
        weighted_sums: `W_j h_j` of the summing units, see `weigh_sums`.
        fixed: fixed weights W.
        orders: number of summing units of every product unit.

    Returns:
        The derivatives with respect to weights and biases: `J^T output_gradient` without forming J.
    """
    sum_gradient = output_gradient[..., None] * products_of_others(weighted_sums, orders) * fixed
    weight_gradient = sum_gradient.reshape(x.shape[0], -1).mT @ x
    return weight_gradient.reshape(*sum_gradient.shape[1:], x.shape[-1]), sum_gradient.sum(0)


def output_jacobian(
    x: Float[Tensor, "patterns inputs"],
    weighted_sums: Float[Tensor, "patterns *models units"],
    fixed: Float[Tensor, "*models units"],
    orders: Sequence[int],
) -> Float[Tensor, "*models patterns parameters"]:
    """Compute the derivatives of the outputs with respect to all weights and biases.

    Args:
        x: scaled inputs.
        weighted_sums: `W_j h_j` of the summing units, see `weigh_sums`.
        fixed: fixed weights W.
        orders: number of summing units of every product unit.

    Returns:
        For each summing unit, the derivatives with respect to its weights and then to its bias.
    """
    sum_gradient = (products_of_others(weighted_sums, orders) * fixed).movedim(0, -2)
    with_bias = torch.cat([x, x.new_ones((x.shape[0], 1))], -1)
    return (sum_gradient[..., None] * with_bias[:, None, :]).flatten(-2)


@dataclass(frozen=True, eq=False)
class TrainingHistory:
    """Energies of a training run, by epoch.

    Attributes:
        joints: names of the corrected joints.
        energies: `E = 1/2 Σ_μ (d - y)²` of every joint in every epoch (Jeong et al. 1998, eq. 3), in scaled units:
            before the step of the epoch (gradient descent), after it (Levenberg-Marquardt), or over its steps
            (mini-batches).
        resumed_from: epoch from which the training was resumed; 0 for a new training.
    """

    joints: tuple[str, ...]
    energies: Float[Tensor, "epochs joints"]
    resumed_from: int
