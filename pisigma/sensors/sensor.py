"""Sensors as residual blocks: what is predicted, what is left over, and its derivative by the chain rule."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.kinematics.parameter_jacobian import ToolMotion
from pisigma.sensors.rotation_difference import rotation_difference


@dataclass(frozen=True, eq=False)
class OwnUnknowns:
    """What sensors have to find out about themselves; as seen from the base's anchor of their frame.

    Attributes:
        sockets: places of the sockets [m].
        anchors: places of the anchors, and what their sensors show at no distance [m].
    """

    sockets: Float64[Tensor, "3 sockets"]
    anchors: Float64[Tensor, "4 anchors"]


@dataclass(frozen=True, eq=False)
class OwnDerivative:
    """Derivative of a sensor's values by its own unknowns.

    Attributes:
        group: "socket" or "anchor".
        owner: per row, the number of the socket or anchor that has a part in it.
        derivative: of the predicted value by each unknown of that owner.
    """

    group: Literal["socket", "anchor"]
    owner: Int64[Tensor, " poses"]
    derivative: Float[Tensor, "own components poses"]


class AbstractSensor(ABC):
    """One kind of measurement; its rows are those of the problem, and `seen` says where it has one.

    A new kind of sensor says how its value follows from the tool's motion and, where it has any, from its own
    unknowns. Values have the row index last.

    Attributes:
        name: such as "position"; one noise figure is estimated per name.
        unit: of its values.
        components: values a row.
        turning: whether it needs the tool's rotation.
        certain: whether its values are known rather than measured: their standard deviation is as given, and none
            of them counts as wrong.
        paired: whether a value belongs to a row and the next one together.
        seen: whether a row has a value.
        sigma: standard deviation of a value where the rows give it, else None: it is estimated.
    """

    name: ClassVar[str]
    unit: ClassVar[Literal["m", "rad"]]
    components: ClassVar[int]
    turning: ClassVar[bool]
    certain: ClassVar[bool] = False
    paired: ClassVar[bool] = False
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @abstractmethod
    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Measured minus predicted; whatever it is where nothing was seen, it is not used."""

    @abstractmethod
    def select(self, rows: Int64[Tensor, " chosen"]) -> "AbstractSensor":
        """The same sensor with some of the rows."""

    @abstractmethod
    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """Derivative of the predicted value by every parameter that moves the tool."""

    def partner_derivative(self, motion: ToolMotion) -> Float[Tensor, "parameters components poses"]:
        """The part of the derivative that comes from the next row's tool, where values are paired; else 0."""
        return motion.derivative.new_zeros(1, self.components, 1).expand(
            motion.derivative.shape[0], -1, motion.derivative.shape[2]
        )

    def own_derivatives(self, motion: ToolMotion, own: OwnUnknowns, rows: slice) -> tuple[OwnDerivative, ...]:
        """Derivatives by the sensor's own unknowns; none where it has none."""
        return ()


@dataclass(frozen=True, eq=False)
class PositionSensor(AbstractSensor):
    """A tracker that sees a reflector: three coordinates in its frame.

    Attributes:
        measured: positions [m].
        seen: whether a row has one.
        sigma: standard deviation of a coordinate [m] of every row, or None.
    """

    name = "position"
    unit = "m"
    components = 3
    turning = False
    measured: Float64[Tensor, "3 rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Measured minus predicted position [m]."""
        return self.measured[:, rows] - motion.position

    def select(self, rows: Int64[Tensor, " chosen"]) -> "PositionSensor":
        """Some of the rows."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return PositionSensor(self.measured[:, rows], self.seen[rows], sigma)

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """The tool's shift."""
        return motion.derivative[:, :3]


@dataclass(frozen=True, eq=False)
class RotationSensor(AbstractSensor):
    """The orientation that a 6D tracker sees, as a rotation vector from the predicted to the measured one.

    Attributes:
        measured: rotations, the row index last.
        seen: whether a row has one.
        sigma: standard deviation of an angle [rad] of every row, or None.
    """

    name = "rotation"
    unit = "rad"
    components = 3
    turning = True
    measured: Float64[Tensor, "3 3 rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Rotation vector of measured · predicted^T [rad]."""
        return rotation_difference(self.measured[..., rows], motion.rotation)

    def select(self, rows: Int64[Tensor, " chosen"]) -> "RotationSensor":
        """Some of the rows."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return RotationSensor(self.measured[..., rows], self.seen[rows], sigma)

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """The tool's turn.

        The residual r falls by `J_r(r)^-1 turn` rather than by the turn; as `J_r^-T r = r`, the cost's
        gradient is exact with the turn itself, and the Gauss-Newton matrix is right to second order in r.
        """
        return motion.derivative[:, 3:]
