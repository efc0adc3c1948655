"""How far a pose lies from the data that a correction was learned from."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

MAXIMUM_SAMPLES = 2048
MARGIN = 1.05
"""A pose may lie this much farther from the data than the data lie from each other."""

REPEAT = 1e-3
"""Training rows nearer than this, in scaled inputs that range over 2, count as repeats of one measurement."""

_CHUNK = 4096


class Domain(nn.Module):
    """The region of the network's scaled inputs that the training rows cover.

    The measure of a pose is its distance to the nearest training row over `radius`, the largest distance of a
    training row to its nearest neighbour (with 5 % of margin; repeats are no neighbours); up to 1 a pose is
    inside.

    Attributes:
        samples: `(samples, inputs)`: scaled inputs of training rows.
        radius: in scaled units.
    """

    samples: Tensor
    radius: Tensor

    def __init__(self, samples: Float[Tensor, "samples inputs"], radius: Float[Tensor, ""]) -> None:
        """Keep samples and radius as buffers.

        Raises:
            ValueError: there is no sample, or the radius is not above 0.
        """
        super().__init__()
        if samples.shape[0] == 0 or not float(radius) > 0:
            raise ValueError(
                f"a domain needs a sample and a radius above 0, got {samples.shape[0]} samples, radius "
                f"{radius:g}."
            )
        self.register_buffer("samples", samples)
        self.register_buffer("radius", radius)

    @staticmethod
    def around(scaled: Float[Tensor, "rows inputs"], generator: torch.Generator) -> "Domain":
        """The region around training rows; of more than 2048, as many are drawn."""
        if scaled.shape[0] > MAXIMUM_SAMPLES:
            drawn = torch.randperm(scaled.shape[0], generator=generator)[:MAXIMUM_SAMPLES]
            scaled = scaled[drawn.to(scaled.device)]
        distances = _distances(scaled, scaled)
        nearest = torch.where(distances > REPEAT, distances, torch.inf).amin(-1)
        spacing = torch.where(torch.isfinite(nearest), nearest, REPEAT).amax()
        return Domain(scaled, spacing * MARGIN)

    def measure(self, scaled: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch"]:
        """Distance to the nearest training row over the radius; NaN where an input is NaN."""
        chunks = torch.split(scaled.reshape(-1, scaled.shape[-1]), _CHUNK)
        nearest = torch.cat([_distances(chunk, self.samples).amin(-1) for chunk in chunks])
        return (nearest / self.radius).reshape(scaled.shape[:-1])

    def contains(self, scaled: Float[Tensor, "*batch inputs"]) -> Bool[Tensor, "*batch"]:
        """Whether poses are inside; a NaN never is."""
        return self.measure(scaled) <= 1


def _distances(
    a: Float[Tensor, "rows inputs"], b: Float[Tensor, "samples inputs"]
) -> Float[Tensor, "rows samples"]:
    """Euclidean distances from differences: products of matrices would lose half the digits of small ones."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
