"""Distances: from an anchor to the tool, and between the tools of two rows."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.kinematics.parameter_jacobian import ToolMotion
from pisigma.sensors.sensor import AbstractSensor, OwnDerivative, OwnUnknowns
from pisigma.sensors.socket import SHORTEST
from pisigma.sensors.touch import along


@dataclass(frozen=True, eq=False)
class DistanceSensor(AbstractSensor):
    """A wire or bar from a fixed anchor: `|p_tool - p_anchor| + zero`.

    Attributes:
        anchor: number of every row's anchor, -1 where there is none.
        measured: what is shown [m].
        seen: whether a row has one.
        sigma: standard deviation of every row [m], or None.
    """

    name = "distance"
    unit = "m"
    components = 1
    turning = False
    anchor: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Shown minus predicted distance [m]."""
        predicted = self._away(motion, own, rows).norm(dim=0) + own.anchors[3, self.anchor[rows]]
        residual: Tensor = self.measured[rows] - predicted
        return residual[None]

    def select(self, rows: Int64[Tensor, " chosen"]) -> "DistanceSensor":
        """Some of the rows."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return DistanceSensor(self.anchor[rows], self.measured[rows], self.seen[rows], sigma)

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """The tool's shift away from the anchor."""
        return along(self._direction(motion, own, rows), motion.derivative)

    def own_derivatives(self, motion: ToolMotion, own: OwnUnknowns, rows: slice) -> tuple[OwnDerivative, ...]:
        """Minus the anchor's shift along the wire, and one for the zero."""
        direction = self._direction(motion, own, rows)
        parts = torch.cat([-direction, torch.ones_like(direction[:1])])
        return (OwnDerivative("anchor", self.anchor[rows], parts[:, None]),)

    def _away(self, motion: ToolMotion, own: OwnUnknowns, rows: slice) -> Tensor:
        away: Tensor = motion.position - own.anchors[:3, self.anchor[rows]]
        return away

    def _direction(self, motion: ToolMotion, own: OwnUnknowns, rows: slice) -> Tensor:
        away = self._away(motion, own, rows)
        direction: Tensor = away / away.norm(dim=0).clamp(min=SHORTEST)
        return direction


@dataclass(frozen=True, eq=False)
class PairSensor(AbstractSensor):
    """The distance between the tools of two rows, which are neighbours; the first of them counts.

    Attributes:
        measured: the distance [m].
        seen: whether a row is the first of a pair; then it has an even number.
        sigma: standard deviation of every row [m], or None.
    """

    name = "pair"
    unit = "m"
    components = 1
    turning = False
    paired = True
    measured: Float64[Tensor, " rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Measured minus predicted distance [m]."""
        residual: Tensor = self.measured[rows] - self._apart(motion.position).norm(dim=0)
        return residual[None]

    def select(self, rows: Int64[Tensor, " chosen"]) -> "PairSensor":
        """Some of the rows, which part no pair."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return PairSensor(self.measured[rows], self.seen[rows], sigma)

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """The shift of the first tool against the second along their line."""
        apart = self._apart(motion.position)
        direction = apart / apart.norm(dim=0).clamp(min=SHORTEST)
        return along(direction, self._apart(motion.derivative[:, :3]))

    def partner_derivative(self, motion: ToolMotion) -> Float[Tensor, "parameters components poses"]:
        """Minus the shift of the next row's tool along the line."""
        apart = self._apart(motion.position)
        direction = apart / apart.norm(dim=0).clamp(min=SHORTEST)
        shift = motion.derivative[:, :3]
        return -along(direction, torch.cat([shift[..., 1:], shift[..., :1]], -1))

    def _apart(self, values: Tensor) -> Tensor:
        """Of every row minus that of the next; it is used in the first rows of pairs only."""
        following = torch.cat([values[..., 1:], values[..., :1]], -1)
        apart: Tensor = values - following
        return apart
