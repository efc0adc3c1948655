"""The paper's rule: full-batch gradient descent with a learning rate for every output."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.network.energy import energy_gradient
from pisigma.network.pi_sigma import PiSigma


class GradientDescent(torch.optim.Optimizer):
    """`Δw = -η ∂E/∂w` with a learning rate η per output (Jeong et al. 1998, eq. 4); no momentum, no state."""

    def __init__(
        self, networks: Sequence[PiSigma], learning_rates: Sequence[Float[Tensor, " outputs"]]
    ) -> None:
        """Take weights and biases of networks, with one rate per output; fixed weights are never seen."""
        groups = [
            {"params": [network.weight, network.bias], "rates": rates}
            for network, rates in zip(networks, learning_rates, strict=True)
        ]
        super().__init__(groups, {})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Move every parameter against its gradient."""
        if closure is not None:
            with torch.enable_grad():
                closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                rates = group["rates"].reshape(-1, *[1] * (parameter.dim() - 1))
                parameter.addcmul_(parameter.grad, rates, value=-1)


def set_gradient(
    network: PiSigma, x: Float[Tensor, "patterns inputs"], d: Float[Tensor, "patterns outputs"]
) -> Float[Tensor, " outputs"]:
    """Write the closed-form gradient into the parameters' `grad` and give the energy of every output."""
    energies, network.weight.grad, network.bias.grad = energy_gradient(network, x, d)
    return energies
