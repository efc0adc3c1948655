"""The Pi-Sigma network: a hidden layer of linear sums and an output layer of products with fixed weights."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn


class PiSigma(nn.Module):
    """Pi-Sigma network, whose outputs are sums of products of linear sums of the inputs.

    For every output k and every unit u of order m_u, with inputs x and outputs y in scaled form::

        h_kj = b_kj + Σ_i w_kji x_i                                (Jeong et al. 1998, eq. 1, with a bias)
        y_k  = Σ_u Π_{j in unit u} W_kj h_kj                       (eq. 2; one unit in the paper)

    One unit is a Pi-Sigma network; several units of increasing order are a ridge polynomial network (Shin and
    Ghosh 1995). The weights W between the summing units and the products are fixed: a buffer, not a parameter.
    Outputs share no weights, so every output can be trained independently.

    Scaling is part of the network: inputs and outputs of `forward` are in physical units.

    Attributes:
        weight: `(outputs, summing_units, inputs)`: weights w.
        bias: `(outputs, summing_units)`: biases b.
        fixed: `(outputs, summing_units)`: fixed weights W, a buffer.
        input_offset, input_scale: `(inputs,)`: scaled input = (input - offset) / scale.
        output_offset, output_scale: `(outputs,)`: output = offset + scale · y.
    """

    weight: nn.Parameter
    bias: nn.Parameter
    fixed: Tensor
    input_offset: Tensor
    input_scale: Tensor
    output_offset: Tensor
    output_scale: Tensor

    def __init__(
        self,
        inputs: int,
        outputs: int,
        orders: Sequence[int],
        *,
        fixed_product: float = 1.0,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        """Build a network whose products are all equal to `fixed_product` until it is initialised or trained.

        Args:
            inputs: number of inputs.
            outputs: number of outputs.
            orders: number of summing units of every product unit, such as `(3,)` or `(1, 2, 3)`.
            fixed_product: product of the fixed weights of a unit, which are all equal.
            dtype: dtype of weights and buffers.

        Raises:
            ValueError: a count is below 1, or the fixed product is not positive.
        """
        super().__init__()
        if inputs < 1 or outputs < 1 or not orders or min(orders) < 1:
            raise ValueError(
                f"expected inputs, outputs and orders >= 1, got {inputs} inputs, {outputs} outputs and orders "
                f"{tuple(orders)}."
            )
        if not fixed_product > 0:
            raise ValueError(f"expected a product of the fixed weights > 0, got {fixed_product}.")
        self.orders = tuple(orders)
        summing_units = sum(self.orders)
        self.weight = nn.Parameter(torch.zeros(outputs, summing_units, inputs, dtype=dtype))
        self.bias = nn.Parameter(torch.ones(outputs, summing_units, dtype=dtype))
        roots = [fixed_product ** (1 / order) for order in self.orders for _ in range(order)]
        self.register_buffer("fixed", torch.tensor(roots, dtype=dtype).expand(outputs, -1).clone())
        self.register_buffer("input_offset", torch.zeros(inputs, dtype=dtype))
        self.register_buffer("input_scale", torch.ones(inputs, dtype=dtype))
        self.register_buffer("output_offset", torch.zeros(outputs, dtype=dtype))
        self.register_buffer("output_scale", torch.ones(outputs, dtype=dtype))

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.weight.shape[-1]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.weight.shape[0]

    @torch.no_grad()
    def initialise(self, spread: float, generator: torch.Generator) -> None:
        """Draw the weights uniformly from ±spread and the biases from 1 ± spread.

        Every product then starts near the product of its fixed weights. Near 0, training would stall, because the
        gradient of a product with respect to one factor is the product of the others.
        """
        for parameter, centre in ((self.weight, 0.0), (self.bias, 1.0)):
            parameter.copy_(centre + draw_uniform(parameter, spread, generator))

    def scale_inputs(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch inputs"]:
        """Return inputs scaled for the summing units."""
        return (x - self.input_offset) / self.input_scale

    def scale_targets(self, y: Float[Tensor, "*batch outputs"]) -> Float[Tensor, "*batch outputs"]:
        """Return target outputs scaled for comparison with the products."""
        return (y - self.output_offset) / self.output_scale

    def products(self, scaled_inputs: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch outputs"]:
        """Compute scaled outputs of scaled inputs: eqs (1) and (2)."""
        return sum_of_products(weigh_sums(scaled_inputs, self.weight, self.bias, self.fixed), self.orders)

    def forward(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch outputs"]:
        """Compute outputs of inputs, both in physical units."""
        return self.output_offset + self.output_scale * self.products(self.scale_inputs(x))


def draw_uniform(like: Tensor, spread: float, generator: torch.Generator) -> Tensor:
    """Draw uniform numbers in ±spread with the shape of `like`, in float64 so that they do not depend on the dtype."""
    uniform = torch.rand(like.shape, generator=generator, dtype=torch.float64, device=generator.device)
    return (spread * (2 * uniform - 1)).to(like)


def weigh_sums(
    x: Float[Tensor, "*batch inputs"],
    weight: Float[Tensor, "*models units inputs"],
    bias: Float[Tensor, "*models units"],
    fixed: Float[Tensor, "*models units"],
) -> Float[Tensor, "... units"]:
    """Compute weighted outputs `W_kj h_kj` of the summing units (eq. 1), for any leading model dimensions."""
    flat = x @ weight.reshape(-1, weight.shape[-1]).mT
    sums = flat.reshape(*x.shape[:-1], *bias.shape) + bias
    return sums * fixed


def sum_of_products(
    weighted_sums: Float[Tensor, "*batch units"], orders: Sequence[int]
) -> Float[Tensor, "*batch"]:
    """Return the sum of the product units (eq. 2), whose summing units are consecutive."""
    total: Tensor | None = None
    for unit in torch.split(weighted_sums, list(orders), dim=-1):
        factors = unit.unbind(-1)
        value = factors[0]
        for factor in factors[1:]:
            value = value * factor
        total = value if total is None else total + value
    assert total is not None
    return total


def products_of_others(
    weighted_sums: Float[Tensor, "*batch units"], orders: Sequence[int]
) -> Float[Tensor, "*batch units"]:
    """Return the product of the other summing units in each one's product unit, exact even for zero factors.

    This is `Π_{i≠j} W_ki h_i` in the derivative of eq. (4).
    """
    columns: list[Tensor] = []
    for unit in torch.split(weighted_sums, list(orders), dim=-1):
        factors = unit.unbind(-1)
        ones = torch.ones_like(factors[0])
        before, after = [ones], [ones]
        for factor in factors[:-1]:
            before.append(before[-1] * factor)
        for factor in reversed(factors[1:]):
            after.append(after[-1] * factor)
        columns += [b * a for b, a in zip(before, reversed(after), strict=True)]
    return torch.stack(columns, -1)
