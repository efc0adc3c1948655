"""Interface of sensors: residuals of rows of measurements, and their derivatives by the chain rule."""

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError, choice_remedy
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.readings import SensorReadings
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

OtherUnit = Literal["px", "1"]
ParameterUnit = Literal["m", "rad", "px", "1"]
ShownUnit = Literal["mm", "deg", "px", "1"]
SHOWN_UNITS: Mapping[str, tuple[ShownUnit, float]] = {
    "m": ("mm", 1e3),
    "rad": ("deg", math.degrees(1.0)),
    "px": ("px", 1.0),
    "1": ("1", 1.0),
}
"""For every unit, the unit in which figures are shown, and the conversion factor."""
_MIN_LENGTH = 1e-12
"""Lower bound of lengths in denominators [m]."""

Unknowns = Mapping[str, Float64[Tensor, "columns owners"]]
"""Unknowns of sensors by group; points are in the frame of the anchor of their base."""

Poses = Float64[Tensor, "rows 4 4"]
"""Tool poses, each in the frame of the row."""
Values = Float[Tensor, "components poses"]
"""Measured values of a sensor, or their residuals [m or rad]."""
Derivative = Float[Tensor, "parameters components poses"]
"""Derivative of predicted values with respect to parameters that move the tool [m/m, m/rad, rad/m or rad/rad]."""


@dataclass(frozen=True)
class UnknownGroup:
    """Unknowns of one kind of sensor; every owner, such as an anchor, has one set of them.

    Attributes:
        name: name of the group, such as "anchor".
        columns: names of one owner's unknowns. If the first ones are x, y, z, they are a point in the owner's frame
            [m]; all others are the same in every frame.
        owners: names of the owners, for example of the anchors.
        frames: per owner, the frame in which it is located.
        angles: columns that are angles [rad]; other columns are lengths [m].
        units: units of columns that are neither angles nor lengths: "px" or "1" (dimensionless).
    """

    name: str
    columns: tuple[str, ...]
    owners: tuple[str, ...]
    frames: tuple[str, ...] = ()
    angles: frozenset[str] = frozenset()
    units: Mapping[str, OtherUnit] = field(default_factory=dict)

    def unit(self, column: str) -> ParameterUnit:
        """Return the unit of a column."""
        return self.units.get(column, "rad" if column in self.angles else "m")

    @property
    def has_point(self) -> bool:
        """Whether an owner's first three unknowns are a point in its frame."""
        return self.columns[:3] == ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class InitialUnknowns:
    """Initial values of the unknowns of a group.

    Attributes:
        values: values of every owner, in the owner's frame [m or rad].
        free: mask of the values that are estimated; other values are fixed.
    """

    values: Float64[Tensor, "owners columns"]
    free: Bool[Tensor, "owners columns"]


@dataclass(frozen=True, eq=False)
class SensorRows:
    """Rows of measurements from which sensors are built.

    Attributes:
        measurements: the rows; pairs come first, with their rows next to each other.
        base_anchors: per row, the anchor of the base, `T_frame_tool = anchor · T_anchor_tool`.
        tool_rotation_anchors: per row, the anchor of the tool's rotation, `R_anchor_tool = R_predicted · anchor`.
    """

    measurements: Measurements
    base_anchors: Float64[Tensor, "rows 4 4"]
    tool_rotation_anchors: Float64[Tensor, "rows 3 3"]

    def sigma(
        self, present: Bool[Tensor, " rows"], unit: Literal["m", "rad"] = "m"
    ) -> Float64[Tensor, " rows"] | None:
        """Return the standard deviations that a sensor's rows state [m or rad]; None if no row states one.

        Raises:
            IdentificationError: some of the sensor's rows state a standard deviation and others do not.
        """
        data = self.measurements
        sigma = data.sigma_position if unit == "m" else data.sigma_rotation
        if sigma is None or not bool(torch.isfinite(sigma[present]).any()):
            return None
        lacking = present & ~torch.isfinite(sigma)
        if bool(lacking.any()):
            row = int(lacking.nonzero()[0, 0])
            raise IdentificationError(
                "the standard deviation is given in some rows, but not in this one",
                at=data.place_of(row, "sigma_mm" if unit == "m" else "sigma_deg"),
                remedy="give it in every row, or in none to have it estimated",
            )
        return sigma

    @property
    def has_corner_poses(self) -> Bool[Tensor, " rows"]:
        """Mask of the rows with a complete pose from the corners of a board in an image, with its covariance."""
        return self.measurements.is_measured("corner") & self.measurements.is_measured("pose")

    def readings(self, name: str) -> Float64[Tensor, " rows"]:
        """Return a numeric column of a registered sensor [SI]; NaN in rows without a value."""
        values = self.measurements.readings.get(name)
        return values if isinstance(values, Tensor) else torch.full_like(self.measurements.q[:, 0], torch.nan)

    def name_indices(self, names: tuple[str, ...] | None, order: tuple[str, ...]) -> Int64[Tensor, " rows"]:
        """Return the index of every row's name in `order`; -1 if `order` does not contain it."""
        return indices_of_names(names, order, self.measurements.rows).to(self.measurements.q.device)


@dataclass(frozen=True, eq=False)
class UnknownDerivative:
    """Derivative of a sensor's values with respect to the unknowns of a group.

    Attributes:
        group: name of the group.
        owner: per row, the index of the owner on whose unknowns the value depends.
        derivative: derivative of the predicted value with respect to each of that owner's unknowns.
    """

    group: str
    owner: Int64[Tensor, " poses"]
    derivative: Float[Tensor, "columns components poses"]


class AbstractSensor(ABC):
    """A kind of sensor: measured values, their predictions from the tool's motion, and derivatives.

    A subclass is a frozen dataclass whose tensors have the row index last; rows are those of the calibration
    problem. It is registered with `pisigma.measurement.sensors.register_sensor`. Values are predicted in the frame of
    the base's anchor (see `SensorRows`), so that no angle of a base is near its singularity.

    Attributes:
        name: name of the sensor, such as "position"; one noise level is estimated per name.
        unit: unit of the values.
        components: number of values per row.
        depends_on_rotation: whether the predicted values depend on the tool's rotation.
        are_values_given: whether the values are stated rather than measured, so that their standard deviation is not
            estimated and they are never outliers.
        is_paired: whether a value belongs to a row and the next one.
        determines_frame: whether the values determine the position of the frame in which the sensor measures.
        readings: columns that the sensor adds to measurement files; None for a sensor whose values are fields of
            `Measurements`.
        present: mask of the rows with a value.
        sigma: standard deviation of the values if the rows state it; None if it is estimated.
    """

    name: ClassVar[str]
    unit: ClassVar[Literal["m", "rad"]]
    components: ClassVar[int]
    depends_on_rotation: ClassVar[bool] = False
    are_values_given: ClassVar[bool] = False
    is_paired: ClassVar[bool] = False
    determines_frame: ClassVar[bool] = True
    readings: ClassVar[SensorReadings | None] = None
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    @abstractmethod
    def build(cls, rows: SensorRows) -> "AbstractSensor | None":
        """Build the sensor from the rows with values of this kind; None if no row has a value.

        Raises:
            IdentificationError: the rows contradict each other.
        """

    @abstractmethod
    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted values; the result is arbitrary in rows without a value."""

    @abstractmethod
    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivative of the predicted values with respect to every parameter that moves the tool."""

    def partner_derivative(self, motion: ToolMotion) -> Derivative:
        """Return the derivative with respect to the next row's tool for paired values, otherwise 0."""
        return motion.derivative.new_zeros(1, self.components, 1).expand(
            motion.derivative.shape[0], -1, motion.derivative.shape[2]
        )

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the derivatives of the predicted values with respect to the sensor's unknowns, if it has any."""
        return ()

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Return the unknowns of this sensor in the rows; None if it has no unknowns."""
        return None

    @classmethod
    def initial_guess(
        cls, measurements: Measurements, T_frame_tool: Poses, reach: float
    ) -> InitialUnknowns | None:
        """Estimate initial unknowns with the nominal robot, and refuse values that are impossible for a similar robot.

        Args:
            measurements: the rows; pairs come first, with their rows next to each other.
            T_frame_tool: poses of the best-fitting tool of the nominal robot, in the frame of every row.
            reach: reach of the robot [m].

        Raises:
            IdentificationError: a value is impossible, or there are too few values.
        """
        return None

    @classmethod
    def uncalibrated_unknowns(
        cls, measurements: Measurements, owner: str, T: Poses, calibrated_owners: Collection[str]
    ) -> Float64[Tensor, " columns"]:
        """Return the unknowns of an owner that was not calibrated, for the validation of its rows.

        Args:
            measurements: rows that were not used for the calibration.
            owner: name of the owner, such as an anchor.
            T: poses of the tool according to a model, in the frame of every row.
            calibrated_owners: names of the owners that were calibrated.

        Raises:
            IdentificationError: the rows do not determine the unknowns.
        """
        row = next(row for row in range(measurements.rows) if owner in _names_in(measurements, row))
        raise IdentificationError(
            f"'{owner}' of the sensor '{cls.name}' was not calibrated",
            at=measurements.place_of(row),
            value=owner,
            remedy=choice_remedy(owner, calibrated_owners),
        )

    def select(self, rows: Int64[Tensor, " chosen"]) -> "AbstractSensor":
        """Return the sensor with the rows that an index selects."""
        tensors = {item.name: getattr(self, item.name) for item in fields(self)}  # type: ignore[arg-type]
        chosen: dict[str, Any] = {
            name: value[..., rows] for name, value in tensors.items() if isinstance(value, Tensor)
        }
        return replace(self, **chosen)  # type: ignore[type-var]


def _names_in(measurements: Measurements, row: int) -> set[str]:
    return {texts[row] for texts in measurements.as_fields().texts.values()}


def indices_of_names(
    names: tuple[str, ...] | None, order: Sequence[str], rows: int
) -> Int64[Tensor, " rows"]:
    """Return the index of every row's name in `order`; -1 if `order` does not contain it."""
    numbers = {name: number for number, name in enumerate(order)}
    different = set(names or ("",))
    if len(different) == 1:
        return torch.full((rows,), numbers.get(different.pop(), -1), dtype=torch.int64)
    return torch.tensor([numbers.get(name, -1) for name in names or ()], dtype=torch.int64)


def distinct_names(names: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return the distinct names except "", in the order of their first row."""
    return tuple(name for name in dict.fromkeys(names or ()) if name)


def owners_of(
    measurements: Measurements, names: tuple[str, ...] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the distinct names, and for each the frame of its first row."""
    owners = distinct_names(names)
    return owners, tuple(measurements.frame[(names or ()).index(owner)] for owner in owners)


def component_along(
    axis: Float[Tensor, "3 poses"], derivative: Float[Tensor, "parameters six poses"]
) -> Float[Tensor, "parameters 1 poses"]:
    """Return the component along an axis of the tool's shift due to every parameter."""
    total = derivative[:, 0] * axis[0]
    for k in (1, 2):
        total = torch.addcmul(total, derivative[:, k], axis[k])
    return total[:, None]


def unit_vectors(vectors: Float[Tensor, "3 poses"]) -> Float[Tensor, "3 poses"]:
    """Return the unit vectors of vectors [m]; 0 for zero vectors."""
    directions: Tensor = vectors / vectors.norm(dim=0).clamp(min=_MIN_LENGTH)
    return directions
