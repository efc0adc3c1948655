"""Build a scaled network and its patterns from training pairs."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.levenberg_marquardt import Patterns
from pisigma.network.pairs import TrainingPairs
from pisigma.network.pi_sigma import PiSigma
from pisigma.network.sections import NetworkSection
from pisigma.robot.description import Robot

TARGET_RANGE = 1.25
"""Range to which targets are scaled. It contains 1, near which products start, and no negative values, so no product
has to change its sign. With [-1, 1], some starts end in poor minima; with [0, 2], the paper's learning rates
diverge."""

_MIN_INPUT_RANGE = 1e-9
"""Range of an input [m, rad or 1] below which it is treated as constant."""
_MIN_TARGET_RANGE = 1e-12
"""Smallest range by which targets are scaled [rad or m]."""


def build_network(
    robot: Robot, sections: Sequence[NetworkSection], pairs: TrainingPairs
) -> CorrectionNetwork:
    """Build the network of a recipe, scaled by the rows that are used for training.

    Inputs are scaled from their range in the data to [-1, 1] and targets to [0, 1.25] / sqrt(n) for n patterns; the
    product of the fixed weights of a unit is also 1 / sqrt(n). The energy of eq. (3) is then half the mean square of
    the error in units of the scaled range, so a learning rate has the same effect for 100 rows as for 1000.

    A constant target is scaled as if it varied by 1e-12, so that the correction is this constant.

    Raises:
        RecipeError: an input is unknown; the message lists the valid ones.
        IdentificationError: an input does not vary in the used rows, so nothing can be learned from it.
    """
    names = [joint.name for joint in robot.joints]
    used = pairs.used_rows
    groups, networks = [], []
    for section in sections:
        inputs = Inputs.from_names(robot, section.inputs, np.array(section.reference, dtype=np.float64))
        group = JointGroup(tuple(names.index(name) for name in section.joints), inputs)
        rows = int(used.sum())
        network = PiSigma(len(section.inputs), len(section.joints), section.orders, fixed_product=rows**-0.5)
        x = inputs(pairs.T[used], pairs.q_nominal[used])
        d = pairs.target[used][:, list(group.joints)]
        input_width, target_width = x.amax(0) - x.amin(0), d.amax(0) - d.amin(0)
        _check_varying(section.inputs, input_width, rows)
        network.input_offset, network.input_scale = (x.amax(0) + x.amin(0)) / 2, input_width / 2
        network.output_offset = d.amin(0)
        network.output_scale = target_width.clamp_min(_MIN_TARGET_RANGE) / TARGET_RANGE * rows**0.5
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
    """Return the scaled patterns of every joint group; all groups have the same validation rows.

    Args:
        network: network built by `build_network` from the same pairs.
        pairs: training pairs.
        validation_share: share of the used rows that are held out for validation.
        groups_of_rows: group index of every row; groups are not split.
        generator: generator for the choice of validation rows.

    Raises:
        IdentificationError: there are fewer fitted rows than free parameters of the network per joint.
    """
    validation = _draw_validation(pairs.used_rows, groups_of_rows, validation_share, generator)[
        pairs.used_rows
    ]
    patterns = []
    for group, net in network.members():
        _check_count(group, net, int((~validation).sum()))
        x = net.scale_inputs(group.inputs(pairs.T, pairs.q_nominal))[pairs.used_rows]
        d = net.scale_targets(pairs.target[:, list(group.joints)])[pairs.used_rows]
        patterns.append(Patterns(x, d, validation))
    return patterns


def _check_varying(names: Sequence[str], width: Float64[Tensor, " inputs"], rows: int) -> None:
    if (width < _MIN_INPUT_RANGE).any():
        name = names[int((width < _MIN_INPUT_RANGE).nonzero()[0])]
        raise IdentificationError(
            f"the network input '{name}' does not vary over the {rows} training rows, so no correction can be learned "
            "from it",
            value=name,
            remedy="measure poses in which it varies, or omit it from the recipe",
        )


def _check_count(group: JointGroup, network: PiSigma, fitted: int) -> None:
    """Check that there are at least as many rows as free parameters, without those that only rescale factors."""
    free = sum(network.orders) * (network.inputs + 1) - sum(order - 1 for order in network.orders)
    if fitted < free:
        raise IdentificationError(
            f"there are {fitted} rows to fit, but the network of inputs {', '.join(group.inputs.names)} has {free} "
            "free parameters per joint",
            expected=f"at least {free} rows",
            value=fitted,
            remedy="measure more poses, or give the network fewer inputs or lower orders",
        )


def _draw_validation(
    used: Bool[Tensor, " rows"], groups: Int64[Tensor, " rows"], share: float, generator: torch.Generator
) -> Bool[Tensor, " rows"]:
    """Draw whole groups of rows at random until they have the requested share; at least one group is fitted."""
    present, counts = torch.unique(groups[used], return_counts=True)
    order = torch.randperm(len(present), generator=generator)
    before = counts[order].cumsum(0) - counts[order]
    enough = int((before < round(share * int(used.sum()))).sum())
    chosen = present[order[: min(enough, len(present) - 1)]]
    return torch.isin(groups, chosen) & used
