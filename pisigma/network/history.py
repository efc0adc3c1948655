"""How a training of networks went."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class TrainingHistory:
    """What a training left behind.

    Attributes:
        joints: names of the corrected joints.
        energies: `E = 1/2 Σ_μ (d - y)²` of every joint in every epoch (Jeong et al. 1998, eq. 3), in scaled units:
            before the step of the epoch; after it with Levenberg-Marquardt; over its steps with mini-batches.
        resumed_from: epoch the training went on from, 0 for a fresh one.
    """

    joints: tuple[str, ...]
    energies: Float[Tensor, "epochs joints"]
    resumed_from: int
