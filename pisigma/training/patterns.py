"""From training pairs to a scaled network and its patterns."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot.description import Robot
from pisigma.training.levenberg_marquardt import Patterns
from pisigma.training.pairs import TrainingPairs
from pisigma.training.recipe import NetworkSection

TARGET_RANGE = 1.25
"""Products start near 1, so targets are scaled to [0, 1.25]: the start lies among them, and no product has to change
its sign. With [-1, 1] some starts end in poor minima, with [0, 2] the paper's learning rates diverge."""


def build_network(robot: Robot, sections: Sequence[NetworkSection], pairs: TrainingPairs) -> CorrectionNetwork:
    """Build the network of a recipe, scaled by the rows that are used for training.

    Inputs are scaled from their range in the data to [-1, 1] and targets to [0, 1.25] / sqrt(n), n being the number
    of patterns; the fixed weights of a unit have the product 1 / sqrt(n) too. The energy of eq. (3) is then half the
    mean square of the error in units of the scaled range, and a learning rate means the same for 100 rows as for 1000.

    Raises:
        RecipeError: an input is unknown; the message lists the valid ones.
    """
    names = [joint.name for joint in robot.joints]
    used = pairs.used
    groups, networks = [], []
    for section in sections:
        inputs = Inputs.of(robot, section.inputs, np.array(section.reference, dtype=np.float64))
        group = JointGroup(tuple(names.index(name) for name in section.joints), inputs)
        rows = int(used.sum())
        network = PiSigma(len(section.inputs), len(section.joints), section.orders, fixed_product=rows**-0.5)
        x = inputs(pairs.T[used], pairs.q_nominal[used])
        d = pairs.target[used][:, list(group.joints)]
        network.input_offset, network.input_scale = (x.amax(0) + x.amin(0)) / 2, _width(x) / 2
        network.output_offset, network.output_scale = d.amin(0), _width(d) / TARGET_RANGE * rows**0.5
        groups.append(group)
        networks.append(network)
    return CorrectionNetwork(robot.dof, groups, networks)


def build_patterns(
    network: CorrectionNetwork,
    pairs: TrainingPairs,
    validation_share: float,
    groups_of_rows: Int64[Tensor, " rows"],
    generator: torch.Generator,
) -> list[Patterns]:
    """Scaled patterns of every joint group; the validation rows are drawn once for all.

    Args:
        network: built by `build_network` from the same pairs.
        pairs: the training pairs.
        validation_share: share of the used rows that only validates.
        groups_of_rows: rows of equal number stay on one side.
        generator: draws the validation rows.
    """
    validation = _draw_validation(pairs.used, groups_of_rows, validation_share, generator)[pairs.used]
    patterns = []
    for group, net in network.members():
        x = net.scale_inputs(group.inputs(pairs.T, pairs.q_nominal))[pairs.used]
        d = net.scale_targets(pairs.target[:, list(group.joints)])[pairs.used]
        patterns.append(Patterns(x, d, torch.ones(len(x), dtype=x.dtype), validation))
    return patterns


def _draw_validation(
    used: Bool[Tensor, " rows"], groups: Int64[Tensor, " rows"], share: float, generator: torch.Generator
) -> Bool[Tensor, " rows"]:
    """Whole groups of rows, until their share of the used rows is reached."""
    validation = torch.zeros_like(used)
    present = groups[used].unique()
    wanted = round(share * int(used.sum()))
    for group in present[torch.randperm(len(present), generator=generator)].tolist():
        if int(validation.sum()) >= wanted:
            break
        validation |= (groups == group) & used
    return validation


def _width(values: Float64[Tensor, "rows columns"]) -> Float64[Tensor, " columns"]:
    """Range of every column, 1 where a column does not vary."""
    width = values.amax(0) - values.amin(0)
    return torch.where(width > 1e-12, width, torch.ones_like(width))
