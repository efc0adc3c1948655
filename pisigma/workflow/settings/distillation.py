"""Settings of a distillation."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pisigma.files.errors import RecipeError
from pisigma.files.setting import HIDDEN, KEY

if TYPE_CHECKING:
    from pisigma.workflow.distilled_network import NetworkSize
    from pisigma.workflow.solved_poses import Region


@dataclass(frozen=True)
class DistillationSettings:
    """Settings of a distillation.

    Attributes:
        region: where poses are drawn. None: around the joint values at which the model was calibrated.
        poses: number of poses to fit to, in addition to those for model selection and testing.
        size: the only network size to fit. None: those of `sizes_for`.
        seed: random seed.
        epochs: maximum number of iterations for a joint.

    Raises:
        RecipeError: the seed is out of range.
    """

    region: Annotated["Region | None", HIDDEN] = None
    poses: int = 5000
    size: Annotated["NetworkSize | None", HIDDEN] = None
    seed: Annotated[int, KEY] = 0
    epochs: Annotated[int, HIDDEN] = 80

    def __post_init__(self) -> None:
        """Check the seed."""
        if not 0 <= self.seed < 2**63:
            raise RecipeError(expected="an integer from 0 to 2^63 - 1", value=self.seed, option="seed")
