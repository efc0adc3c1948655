"""Distance of a pose from the training data of a joint correction."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

MAX_SAMPLES = 2048
MARGIN = 1.05
"""Ratio of the radius of a domain to the largest distance between neighbouring training rows."""

REPEAT = 1e-3
"""Distance in scaled inputs from -1 to 1 below which training rows are treated as repeats of one measurement."""

_CHUNK = 4096


class Domain(nn.Module):
    """Region of the network's scaled inputs that is covered by the training rows.

    The measure of a pose is its distance from the nearest training row divided by `radius`, which is the largest
    distance of a training row from its nearest neighbour plus 5 % (repeats are not neighbours). A pose with a
    measure of at most 1 is inside.

    Attributes:
        samples: `(samples, inputs)`: scaled inputs of training rows.
        radius: radius in scaled inputs.
    """

    samples: Tensor
    radius: Tensor

    def __init__(self, samples: Float[Tensor, "samples inputs"], radius: Float[Tensor, ""]) -> None:
        """Store samples and radius as buffers.

        Raises:
            ValueError: there is no sample, or the radius is not positive.
        """
        super().__init__()
        if samples.shape[0] == 0 or not float(radius) > 0:
            raise ValueError(
                f"expected at least one sample and a radius > 0, got {samples.shape[0]} samples and radius {radius:g}."
            )
        self.register_buffer("samples", samples)
        self.register_buffer("radius", radius)

    @staticmethod
    def from_rows(scaled_inputs: Float[Tensor, "rows inputs"], generator: torch.Generator) -> "Domain":
        """Return the region around training rows; at most `MAX_SAMPLES` rows, drawn at random, are kept."""
        if scaled_inputs.shape[0] > MAX_SAMPLES:
            sampled = torch.randperm(scaled_inputs.shape[0], generator=generator)[:MAX_SAMPLES]
            scaled_inputs = scaled_inputs[sampled.to(scaled_inputs.device)]
        distances = _distances(scaled_inputs, scaled_inputs)
        nearest = torch.where(distances > REPEAT, distances, torch.inf).amin(-1)
        spacing = torch.where(torch.isfinite(nearest), nearest, REPEAT).amax()
        return Domain(scaled_inputs, spacing * MARGIN)

    def measure(self, scaled_inputs: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch"]:
        """Compute the distance from the nearest training row divided by the radius; NaN where an input is NaN."""
        chunks = torch.split(scaled_inputs.reshape(-1, scaled_inputs.shape[-1]), _CHUNK)
        nearest = torch.cat([_distances(chunk, self.samples).amin(-1) for chunk in chunks])
        return (nearest / self.radius).reshape(scaled_inputs.shape[:-1])

    def contains(self, scaled_inputs: Float[Tensor, "*batch inputs"]) -> Bool[Tensor, "*batch"]:
        """Return whether poses are inside the domain; False where an input is NaN."""
        return self.measure(scaled_inputs) <= 1


def _distances(
    a: Float[Tensor, "rows inputs"], b: Float[Tensor, "samples inputs"]
) -> Float[Tensor, "rows samples"]:
    """Compute Euclidean distances from differences; matrix products would be faster but lose half of the digits."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
