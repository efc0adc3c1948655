"""History of a training of networks."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class TrainingHistory:
    """Energies of a training by epoch.

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
