"""How a network is trained: the `fit` section of a recipe."""

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from jaxtyping import Float64
from pydantic import Field, PositiveFloat
from torch import Tensor

from pisigma.errors import RecipeError
from pisigma.yaml_file import Section

Seed = Annotated[int, Field(ge=0, lt=2**63)]
Epochs = Annotated[int, Field(ge=1, le=1_000_000)]


class GradientDescentSection(Section):
    """The paper's rule: `Δw = -η ∂E/∂w` over all patterns at once (Jeong et al. 1998, eqs 3 and 4).

    Attributes:
        learning_rate: η of every joint, by name.
        epochs: number of steps.
        seed: of the start.
        spread: half width of the uniform start of weights (around 0) and biases (around 1).
    """

    method: Literal["gradient_descent"]
    learning_rate: dict[str, PositiveFloat]
    epochs: Epochs = 3000
    seed: Seed = 0
    spread: PositiveFloat = 0.3

    def rates(self, joints: Sequence[str]) -> Float64[Tensor, " outputs"]:
        """Learning rates in the order of the joints.

        Raises:
            RecipeError: a joint has none.
        """
        for joint in joints:
            if joint not in self.learning_rate:
                given = ", ".join(sorted(self.learning_rate)) or "none"
                raise RecipeError(
                    f"'fit.learning_rate' has no rate for joint '{joint}'; add one to those given ({given})."
                )
        return torch.tensor([self.learning_rate[joint] for joint in joints], dtype=torch.float64)


class LevenbergMarquardtSection(Section):
    """Least squares for every output, from several starts; the best by validation error is kept.

    Attributes:
        epochs: largest number of iterations; it stops earlier when nothing moves any more.
        starts: number of starts of every output.
        validation_share: share of the patterns that only choose between starts.
        ridge: pull of the weights (not the biases) towards 0, beside a mean square of 1.
        seed: of starts and validation patterns.
        spread: half width of the uniform start of weights (around 0) and biases (around 1).
    """

    method: Literal["levenberg_marquardt"]
    epochs: Epochs = 300
    starts: Annotated[int, Field(ge=1, le=1000)] = 8
    validation_share: Annotated[float, Field(ge=0, lt=0.9)] = 0.2
    ridge: Annotated[float, Field(ge=0)] = 0.0
    seed: Seed = 0
    spread: PositiveFloat = 0.3


FitSection = GradientDescentSection | LevenbergMarquardtSection
