"""How accurate a robot will be after so many poses, and what will remain uncertain."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.estimation.covariance_root import after_values
from pisigma.planning.knowledge import Knowledge

RANDOM_CHOICES = 5
"""Poses are drawn at random so often to compare with."""
DRAWS = 100
"""Robots that are drawn from the distribution, for its quantiles."""


@dataclass(frozen=True)
class ExpectedAccuracy:
    """Errors of the tool's position over the task that are expected after so many poses.

    Attributes:
        poses: how many were measured.
        rms: root mean square [m].
        p95: 95 % of the errors are smaller [m].
        random_rms: root mean square after as many poses that are drawn from the candidates at random [m].
    """

    poses: int
    rms: float
    p95: float
    random_rms: float


@dataclass(frozen=True)
class RemainingError:
    """What a group of unknowns does to the error that remains.

    Attributes:
        name: such as "correction of joint 2" or "tool".
        rms: by so much the error over the task would be smaller if the group were certain, `sqrt(rms² - rms'²)` [m].
        share: of the variance.
    """

    name: str
    rms: float
    share: float


def curve(
    B: Float64[Tensor, "candidates values directions"],
    D: Float64[Tensor, "tasks 3 directions"],
    chosen: Int64[Tensor, " chosen"],
    counts: Sequence[int],
    seed: int = 0,
) -> tuple[ExpectedAccuracy, ...]:
    """Predict the accuracy against the number of poses.

    Args:
        B: of the candidates, before the first of them is measured; see `Knowledge.measured`.
        D: of the poses where the robot shall be accurate; see `Knowledge.tool`.
        chosen: numbers of candidates, in their order.
        counts: numbers of poses.
        seed: of the random choices.
    """
    generator = torch.Generator().manual_seed(seed)
    orders = [torch.randperm(len(B), generator=generator) for _ in range(RANDOM_CHOICES)]
    points = []
    for count in counts:
        after = after_values(D, B[chosen[:count]].flatten(0, 1))
        random = torch.stack(
            [after_values(D, B[order[:count]].flatten(0, 1)).square().sum() for order in orders]
        )
        points.append(
            ExpectedAccuracy(
                count, rms_of(after), p95_of(after, seed), float((random.mean() / len(D)).sqrt())
            )
        )
    return tuple(points)


def rms_of(D: Float64[Tensor, "tasks 3 directions"]) -> float:
    """Root mean square of the position's error over the task [m]; for D see `Knowledge.tool`."""
    return float((D.square().sum() / len(D)).sqrt())


def p95_of(D: Float64[Tensor, "tasks 3 directions"], seed: int = 0) -> float:
    """95 % of the position errors over the task are smaller [m], by `DRAWS` robots of the distribution."""
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randn(D.shape[2], DRAWS, generator=generator, dtype=D.dtype)
    return float(torch.quantile((D @ numbers).norm(dim=1).flatten(), 0.95))


def remaining_errors(knowledge: Knowledge, task: Float64[Tensor, "tasks dof"]) -> tuple[RemainingError, ...]:
    """Say what the error that remains comes from, the largest first.

    With D as in `Knowledge.tool` and R_g the rows of the root that belong to a group, the group's certainty would take
    the projection of D on the directions of R_g away (conditioning of a normal distribution).
    """
    known = knowledge.uncertainty
    D, root, total = knowledge.tool(task), known.root, rms_of(knowledge.tool(task)) ** 2
    errors = []
    for name, rows in _groups(knowledge).items():
        # Directions in which the group hardly varies are rounding.
        _, sizes, vectors = torch.linalg.svd(root[rows], full_matrices=False)
        taken = D @ vectors[sizes > 1e-9 * sizes.max().clamp(min=1e-300)].t()
        square = float(taken.square().sum() / len(D))
        errors.append(RemainingError(name, square**0.5, square / max(total, 1e-300)))
    return tuple(sorted(errors, key=lambda error: -error.rms))


def _groups(knowledge: Knowledge) -> dict[str, list[int]]:
    """Numbers of the unknowns by name of their group."""
    known = knowledge.uncertainty
    names = {"theta": "joint offsets", "d": "link lengths", "a": "link lengths"}
    names |= {"alpha": "angles between axes", "beta": "angles between axes"}
    groups: dict[str, list[int]] = {}
    for index, parameter in enumerate(known.space.parameters):
        groups.setdefault(names.get(parameter.group, parameter.group), []).append(index)
    index = len(known.space.parameters)
    for feature in known.features:
        for joint in feature.used.nonzero()[:, 0].tolist():
            groups.setdefault(f"correction of joint {joint + 1}", []).append(index)
            index += 1
    return groups
