"""Joint corrections of a pose by one Pi-Sigma network per group of joints with the same inputs."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma


@dataclass(frozen=True, eq=False)
class JointGroup:
    """Joints whose corrections are the outputs of one network.

    Attributes:
        joints: indices of the joints in the order of the network's outputs.
        inputs: inputs of the network.
    """

    joints: tuple[int, ...]
    inputs: Inputs


class CorrectionNetwork(nn.Module):
    """Networks that compute corrections of the joints [rad or m]; joints without a group are not corrected."""

    networks: nn.ModuleList

    def __init__(self, dof: int, groups: Sequence[JointGroup], networks: Sequence[PiSigma]) -> None:
        """Combine groups and their networks.

        Raises:
            ValueError: a joint is in two groups, or a network does not fit its group.
        """
        super().__init__()
        joints = [joint for group in groups for joint in group.joints]
        if len(set(joints)) != len(joints):
            raise ValueError(f"a joint appears in two groups of the network: {joints}.")
        for group, network in zip(groups, networks, strict=True):
            if (network.inputs, network.outputs) != (len(group.inputs.names), len(group.joints)):
                raise ValueError(
                    f"expected a network with {len(group.joints)} outputs and {len(group.inputs.names)} inputs for its "
                    f"group, got {network.outputs} outputs and {network.inputs} inputs."
                )
        self.dof = dof
        self.groups = tuple(groups)
        self.networks = nn.ModuleList(networks)

    def members(self) -> list[tuple[JointGroup, PiSigma]]:
        """Return pairs of every joint group and its network."""
        return [(group, network) for group, network in zip(self.groups, self.networks, strict=True)]  # type: ignore[misc]

    def scaled_inputs(
        self, T: Float[Tensor, "*batch 4 4"], q: Float[Tensor, "*batch dof"]
    ) -> Float[Tensor, "*batch all_inputs"]:
        """Compute the concatenated scaled inputs of all groups, in which the domain is defined."""
        return torch.cat([net.scale_inputs(group.inputs(T, q)) for group, net in self.members()], -1)

    def forward(
        self, T: Float[Tensor, "*batch 4 4"], q: Float[Tensor, "*batch dof"]
    ) -> Float[Tensor, "*batch dof"]:
        """Compute the correction [rad or m] of the nominal joint values `q` [rad or m] of poses T_base_tool [m]."""
        columns: list[Tensor] = [torch.zeros_like(q[..., 0])] * self.dof
        for group, network in self.members():
            for joint, value in zip(group.joints, network(group.inputs(T, q)).unbind(-1), strict=True):
                columns[joint] = value
        return torch.stack(columns, -1)
