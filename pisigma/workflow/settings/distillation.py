"""How a model is distilled."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pisigma.files.errors import RecipeError
from pisigma.files.setting import HIDDEN

if TYPE_CHECKING:
    from pisigma.workflow.distilled_network import Size
    from pisigma.workflow.solved_poses import Region


@dataclass(frozen=True)
class DistillationSettings:
    """How a model is distilled.

    Attributes:
        region: where poses are drawn; None for around the joint values that the model was measured at.
        poses: number of poses to fit to; others are drawn besides for choosing and judging.
        size: the only one to fit; None tries those of `sizes_for`.
        seed: seed of poses and starts.
        epochs: largest number of iterations for a joint.

    Raises:
        RecipeError: the seed is none.
    """

    region: Annotated["Region | None", HIDDEN] = None
    poses: int = 5000
    size: Annotated["Size | None", HIDDEN] = None
    seed: int = 0
    epochs: Annotated[int, HIDDEN] = 80

    def __post_init__(self) -> None:
        """Refuse a seed that is none."""
        if not 0 <= self.seed < 2**63:
            raise RecipeError(f"--seed {self.seed}: a whole number from 0 to 2^63 - 1 was wanted.")
