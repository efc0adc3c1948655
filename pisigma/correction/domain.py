"""How far a pose lies from the data that a correction was learned from."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

MAXIMUM_SAMPLES = 2048
MARGIN = 1.05
"""A pose may lie this much farther from the data than the data lie from each other."""


class Domain(nn.Module):
    """The region of the network's scaled inputs that the training rows cover.

    The measure of a pose is its distance to the nearest training row over `radius`, the largest distance of a training
    row to its nearest neighbour (with 5 % of margin); up to 1 a pose is inside.

    Attributes:
        samples: `(samples, inputs)`: scaled inputs of training rows.
        radius: in scaled units.
    """

    samples: Tensor
    radius: Tensor

    def __init__(self, samples: Float[Tensor, "samples inputs"], radius: Float[Tensor, ""]) -> None:
        super().__init__()
        self.register_buffer("samples", samples)
        self.register_buffer("radius", radius)

    @staticmethod
    def around(scaled: Float[Tensor, "rows inputs"], generator: torch.Generator) -> "Domain":
        """The region around training rows; of more than 2048, as many are drawn."""
        if scaled.shape[0] > MAXIMUM_SAMPLES:
            drawn = torch.randperm(scaled.shape[0], generator=generator)[:MAXIMUM_SAMPLES]
            scaled = scaled[drawn]
        distances = torch.cdist(scaled, scaled)
        distances.fill_diagonal_(torch.inf)
        nearest = distances.amin(-1)
        largest = nearest[torch.isfinite(nearest)].amax() if scaled.shape[0] > 1 else scaled.new_zeros(())
        return Domain(scaled, largest * MARGIN)

    def measure(self, scaled: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch"]:
        """Distance to the nearest training row over the radius; NaN where an input is NaN."""
        flat = scaled.reshape(-1, scaled.shape[-1])
        nearest = torch.cat([torch.cdist(part, self.samples).amin(-1) for part in flat.split(4096)])
        return (nearest / self.radius.clamp_min(torch.finfo(flat.dtype).tiny)).reshape(scaled.shape[:-1])

    def contains(self, scaled: Float[Tensor, "*batch inputs"]) -> Bool[Tensor, "*batch"]:
        """Whether poses are inside; a NaN never is."""
        return self.measure(scaled) <= 1
