"""Sockets: fixed points that the ball at the tool sits in, and known distances between them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.kinematics.parameter_jacobian import ToolMotion
from pisigma.sensors.sensor import AbstractSensor, OwnDerivative, OwnUnknowns

SHORTEST = 1e-12
"""[m] Distances are not divided by less."""


@dataclass(frozen=True, eq=False)
class SocketSensor(AbstractSensor):
    """A ball that sits in a socket: `p_tool - p_socket = 0`, the socket's place being unknown.

    Attributes:
        socket: number of every row's socket, -1 where there is none.
        seen: whether a row has one.
        sigma: standard deviation of a coordinate [m] of every row, or None.
    """

    name = "socket"
    unit = "m"
    components = 3
    turning = False
    socket: Int64[Tensor, " rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """The socket's place minus the tool's [m]."""
        return own.sockets[:, self.socket[rows]] - motion.position

    def select(self, rows: Int64[Tensor, " chosen"]) -> "SocketSensor":
        """Some of the rows."""
        return SocketSensor(
            self.socket[rows], self.seen[rows], None if self.sigma is None else self.sigma[rows]
        )

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """The tool's shift."""
        return motion.derivative[:, :3]

    def own_derivatives(self, motion: ToolMotion, own: OwnUnknowns, rows: slice) -> tuple[OwnDerivative, ...]:
        """Minus the socket's shift."""
        eye = torch.eye(3).to(motion.position)
        return (
            OwnDerivative("socket", self.socket[rows], -eye[..., None].expand(3, 3, len(self.socket[rows]))),
        )


@dataclass(frozen=True, eq=False)
class SocketDistanceSensor(AbstractSensor):
    """Known distances between two sockets, each attached to a row of one of them.

    Attributes:
        first: number of one socket, -1 where a row has no such distance.
        second: number of the other.
        measured: the distance [m].
        seen: whether a row has one.
        sigma: how well it is known [m].
    """

    name = "socket distance"
    unit = "m"
    components = 1
    turning = False
    certain = True
    first: Int64[Tensor, " rows"]
    second: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Known minus present distance [m]."""
        residual: Tensor = self.measured[rows] - self._apart(own, rows).norm(dim=0)
        return residual[None]

    def select(self, rows: Int64[Tensor, " chosen"]) -> "SocketDistanceSensor":
        """Some of the rows."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return SocketDistanceSensor(
            self.first[rows], self.second[rows], self.measured[rows], self.seen[rows], sigma
        )

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """None: the tool has no part in it."""
        return torch.zeros_like(motion.derivative[:, :1])

    def own_derivatives(self, motion: ToolMotion, own: OwnUnknowns, rows: slice) -> tuple[OwnDerivative, ...]:
        """The direction from the second socket to the first, and back."""
        apart = self._apart(own, rows)
        direction = (apart / apart.norm(dim=0).clamp(min=SHORTEST))[:, None]
        return (
            OwnDerivative("socket", self.first[rows], direction),
            OwnDerivative("socket", self.second[rows], -direction),
        )

    def _apart(self, own: OwnUnknowns, rows: slice) -> Tensor:
        apart: Tensor = own.sockets[:, self.first[rows]] - own.sockets[:, self.second[rows]]
        return apart
