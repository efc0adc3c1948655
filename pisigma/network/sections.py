"""Sections of recipes for networks and their training."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import AfterValidator, Field, PositiveFloat, PositiveInt
from torch import Tensor, nn

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Section, Seed

Epochs = Annotated[int, Field(ge=1, le=1_000_000)]

_Row = tuple[float, float, float]


def _check_rotation(rows: tuple[_Row, _Row, _Row]) -> tuple[_Row, _Row, _Row]:
    R = np.array(rows, dtype=np.float64)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        expected = "an orthonormal, right-handed matrix"
        raise RecipeError(f"expected {expected}, got three rows that are not a rotation", expected=expected)
    return rows


Rotation = Annotated[tuple[_Row, _Row, _Row], AfterValidator(_check_rotation)]


class NetworkSection(Section):
    """One group of joints whose corrections depend on the same inputs. See `pisigma.network.inputs.Inputs`.

    Attributes:
        joints: names of the joints.
        inputs: names of the inputs.
        orders: summing units of every product unit; `[3]` is the paper's network, `[1, 2, 3]` a ridge
            polynomial.
        reference: rotation from which roll, pitch and yaw are counted, as three rows.
    """

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    inputs: Annotated[tuple[str, ...], Field(min_length=1)]
    orders: Annotated[tuple[Annotated[int, Field(ge=1, le=20)], ...], Field(min_length=1, max_length=20)]
    reference: Rotation = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


class GradientDescentSection(Section):
    """The paper's rule: `Δw = -η ∂E/∂w` over all patterns at once (Jeong et al. 1998, eqs 3 and 4).

    Attributes:
        method: "gradient_descent".
        learning_rate: η of every joint, by name.
        epochs: number of gradient steps.
        seed: random seed of the initial weights.
        spread: half width of the uniform start of weights (around 0) and biases (around 1).
    """

    method: Literal["gradient_descent"]
    learning_rate: dict[str, PositiveFloat]
    epochs: Epochs = 3000
    seed: Seed = 0
    spread: PositiveFloat = 0.3

    def rates(self, joints: Sequence[str]) -> Float64[Tensor, " outputs"]:
        """Return the learning rate of every joint, in the order of the joints.

        Raises:
            RecipeError: a joint has no rate.
        """
        for joint in joints:
            if joint not in self.learning_rate:
                stated = ", ".join(sorted(self.learning_rate)) or "none"
                raise RecipeError(
                    f"there is no learning rate for joint '{joint}'",
                    value=joint,
                    option="fit.learning_rate",
                    remedy=f"add one to those stated ({stated})",
                )
        return torch.tensor([self.learning_rate[joint] for joint in joints], dtype=torch.float64)


class LevenbergMarquardtSection(Section):
    """Least squares for every output from several starts, of which the one with the lowest validation error is kept.

    Attributes:
        method: "levenberg_marquardt".
        epochs: largest number of iterations; the training ends earlier if the weights converge.
        starts: number of starts of every output.
        validation_share: share of the patterns that are held out to choose between starts.
        ridge: ridge penalty of the weights (not the biases), relative to a mean square of 1.
        seed: random seed of initial weights and validation patterns.
        spread: half width of the uniform start of weights (around 0) and biases (around 1).
    """

    method: Literal["levenberg_marquardt"]
    epochs: Epochs = 300
    starts: Annotated[int, Field(ge=1, le=1000)] = 8
    validation_share: Annotated[float, Field(ge=0, lt=0.9)] = 0.2
    ridge: Annotated[float, Field(ge=0)] = 0.0
    seed: Seed = 0
    spread: PositiveFloat = 0.3


class MiniBatchSection(Section):
    """Stochastic gradient descent on mini-batches, for data with many rows.

    The learning rate decreases along half a cosine to 0 at the last step.

    Attributes:
        method: "mini_batches".
        batch_rows: rows of a mini-batch.
        epochs: number of passes over all rows.
        optimiser: "adam", "adamw", or "sgd" with momentum 0.9.
        learning_rate: learning rate of the first step.
        seed: random seed of the initial weights and of the order of the rows.
        spread: half width of the uniform start of weights (around 0) and biases (around 1).
    """

    method: Literal["mini_batches"]
    batch_rows: PositiveInt = 256
    epochs: Epochs = 100
    optimiser: Literal["adam", "adamw", "sgd"] = "adam"
    learning_rate: PositiveFloat = 0.02
    seed: Seed = 0
    spread: PositiveFloat = 0.3

    def build(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        """Return the optimiser for the given parameters."""
        if self.optimiser == "sgd":
            return torch.optim.SGD(parameters, lr=self.learning_rate, momentum=0.9)
        kind = torch.optim.Adam if self.optimiser == "adam" else torch.optim.AdamW
        return kind(parameters, lr=self.learning_rate)


FitSection = GradientDescentSection | LevenbergMarquardtSection | MiniBatchSection
