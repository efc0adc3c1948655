"""The interface of sensors: from rows of measurements to residual blocks with derivatives by the chain rule."""

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError, nearest_choice
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
"""In which unit figures of a unit are shown, and how many of it make one."""
SHORTEST = 1e-12
"""[m] Distances are not divided by less."""

Unknowns = Mapping[str, Float64[Tensor, "columns owners"]]
"""By group, what sensors have to find out about themselves; points are as seen from the anchor of their base."""

Poses = Float64[Tensor, "rows 4 4"]
"""Tool poses, each in the frame of its row."""
Values = Float[Tensor, "components poses"]
"""What a sensor measures, or by how much it misses what is predicted [m or rad]."""
Derivative = Float[Tensor, "parameters components poses"]
"""Derivative of predicted values by parameters that move the tool [m/m, m/rad, rad/m or rad/rad]."""


@dataclass(frozen=True)
class UnknownGroup:
    """What one kind of sensor has to find out about itself, once for each of its owners.

    Attributes:
        name: such as "anchor".
        columns: names of one owner's unknowns. Where they begin with x, y, z, these are a point in the owner's frame
            [m]; all others are the same in every frame.
        owners: names of those that have such unknowns, such as the anchors.
        frames: per owner, the frame that it stands in.
        angles: the columns that are angles [rad]; the others are lengths [m].
        units: by column, the unit of those that are neither: "px", or "1" of plain numbers.
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
    """Where the unknowns of a group start.

    Attributes:
        values: of every owner, in its frame [m or rad].
        free: which of them are to be identified; the others stay.
    """

    values: Float64[Tensor, "owners columns"]
    free: Bool[Tensor, "owners columns"]


@dataclass(frozen=True, eq=False)
class SensorRows:
    """Rows of measurements as sensors are built from them.

    Attributes:
        measurements: the rows; those of pairs come first, side by side.
        bases: per row the anchor of its base, `T_frame_tool = anchor · T_anchor_tool`.
        tools: per row the anchor of its tool's rotation, `R_anchor_tool = R_predicted · anchor`.
    """

    measurements: Measurements
    bases: Float64[Tensor, "rows 4 4"]
    tools: Float64[Tensor, "rows 3 3"]

    def sigma(
        self, present: Bool[Tensor, " rows"], unit: Literal["m", "rad"] = "m"
    ) -> Float64[Tensor, " rows"] | None:
        """Return the standard deviations that a sensor's rows state [m or rad]; None where none does.

        Raises:
            IdentificationError: some of the sensor's rows state one and some do not.
        """
        data = self.measurements
        sigma = data.sigma_position if unit == "m" else data.sigma_rotation
        if sigma is None or not bool(torch.isfinite(sigma[present]).any()):
            return None
        lacking = present & ~torch.isfinite(sigma)
        if bool(lacking.any()):
            row = int(lacking.nonzero()[0, 0])
            raise IdentificationError(
                f"{data.source}: {'sigma_mm' if unit == 'm' else 'sigma_deg'} is stated in some rows but not in "
                f"{data.place(row)}; state it in every row or in none, then it is estimated."
            )
        return sigma

    @property
    def by_corners(self) -> Bool[Tensor, " rows"]:
        """Which rows hold a pose that the corners of a board in an image give, whole and with its covariance."""
        return self.measurements.measured("corner") & self.measurements.measured("pose")

    def readings(self, name: str) -> Float64[Tensor, " rows"]:
        """Return the numbers in a column of a registered sensor [SI], NaN where a row has none."""
        values = self.measurements.readings.get(name)
        return values if isinstance(values, Tensor) else torch.full_like(self.measurements.q[:, 0], torch.nan)

    def numbers(self, names: tuple[str, ...] | None, order: tuple[str, ...]) -> Int64[Tensor, " rows"]:
        """Return where every row's name stands in an order, -1 where it is in none."""
        return numbers_of(names, order, self.measurements.rows).to(self.measurements.q.device)


@dataclass(frozen=True, eq=False)
class UnknownDerivative:
    """Derivative of a sensor's values by the unknowns of a group.

    Attributes:
        group: its name.
        owner: per row, the index of the owner whose unknowns the value depends on.
        derivative: of the predicted value by each of that owner's unknowns.
    """

    group: str
    owner: Int64[Tensor, " poses"]
    derivative: Float[Tensor, "columns components poses"]


class AbstractSensor(ABC):
    """One kind of measurement: how rows become values, and how values follow from the tool's motion.

    A subclass is a frozen dataclass whose tensors have the row index last; rows are those of the calibration
    problem. It is registered with `pisigma.measurement.sensors.register_sensor`. Values are predicted as seen from the
    base's anchor (see `SensorRows`), so that no angle of a base comes near its singularity.

    Attributes:
        name: such as "position"; one noise figure is estimated per name.
        unit: of its values.
        components: values a row.
        turning: whether it needs the tool's rotation.
        certain: whether its values are stated rather than measured: their standard deviation stands, and none of them
            counts as wrong.
        paired: whether a value belongs to a row and the next one together.
        holds_frame: whether its values determine where the frame is that it measures in.
        readings: the columns that it adds to measurement files; None for a sensor whose values are fields of
            `Measurements`.
        present: whether a row has a value.
        sigma: standard deviation of a value where the rows state it, else None: it is estimated.
    """

    name: ClassVar[str]
    unit: ClassVar[Literal["m", "rad"]]
    components: ClassVar[int]
    turning: ClassVar[bool] = False
    certain: ClassVar[bool] = False
    paired: ClassVar[bool] = False
    holds_frame: ClassVar[bool] = True
    readings: ClassVar[SensorReadings | None] = None
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    @abstractmethod
    def build(cls, rows: SensorRows) -> "AbstractSensor | None":
        """Gather the values of this kind; None where no row has one.

        Raises:
            IdentificationError: the rows cannot be of one data set.
        """

    @abstractmethod
    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted values; rows without a value may hold anything."""

    @abstractmethod
    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivative of the predicted values by every parameter that moves the tool."""

    def partner_derivative(self, motion: ToolMotion) -> Derivative:
        """Return what of the derivative comes from the next row's tool, where values are paired; else 0."""
        return motion.derivative.new_zeros(1, self.components, 1).expand(
            motion.derivative.shape[0], -1, motion.derivative.shape[2]
        )

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the derivatives of the predicted values by the sensor's unknowns; none where it has none."""
        return ()

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Name the unknowns of this sensor in some rows; None where it has none."""
        return None

    @classmethod
    def initial_guess(cls, measurements: Measurements, T: Poses, reach: float) -> InitialUnknowns | None:
        """Guess the unknowns from the robot as drawn, and refuse values that no robot near it can have measured.

        Args:
            measurements: the rows; those of pairs come first, side by side.
            T: where the robot as drawn has the tool that suits the rows best, in the frame of every row.
            reach: of the robot [m].

        Raises:
            IdentificationError: a value cannot be, or there are too few of them.
        """
        return None

    @classmethod
    def uncalibrated(
        cls, measurements: Measurements, owner: str, T: Poses, calibrated: Collection[str]
    ) -> Float64[Tensor, " columns"]:
        """Return the unknowns of an owner that was not calibrated, for judging its rows.

        Args:
            measurements: rows that were not calibrated with.
            owner: such as the name of an anchor.
            T: where a model has the tool, in the frame of every row.
            calibrated: the owners that were calibrated.

        Raises:
            IdentificationError: the rows do not determine them.
        """
        row = next(row for row in range(measurements.rows) if owner in _names_in(measurements, row))
        raise IdentificationError(
            f"{measurements.place(row)}: '{owner}' of the sensor '{cls.name}' was not calibrated; "
            f"{nearest_choice(owner, calibrated)}"
        )

    def select(self, rows: Int64[Tensor, " chosen"]) -> "AbstractSensor":
        """Return the same sensor with some of the rows."""
        tensors = {item.name: getattr(self, item.name) for item in fields(self)}  # type: ignore[arg-type]
        chosen: dict[str, Any] = {
            name: value[..., rows] for name, value in tensors.items() if isinstance(value, Tensor)
        }
        return replace(self, **chosen)  # type: ignore[type-var]


def _names_in(measurements: Measurements, row: int) -> set[str]:
    return {texts[row] for texts in measurements.as_fields().texts.values()}


def numbers_of(names: tuple[str, ...] | None, order: Sequence[str], rows: int) -> Int64[Tensor, " rows"]:
    """Return where every row's name stands in an order, -1 where it is in none."""
    numbers = {name: number for number, name in enumerate(order)}
    different = set(names or ("",))
    if len(different) == 1:
        return torch.full((rows,), numbers.get(different.pop(), -1), dtype=torch.int64)
    return torch.tensor([numbers.get(name, -1) for name in names or ()], dtype=torch.int64)


def names_of(names: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return the different names, in the order in which they come; "" is none."""
    return tuple(name for name in dict.fromkeys(names or ()) if name)


def owners_of(
    measurements: Measurements, names: tuple[str, ...] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the different names and, for each of them, the frame of its first row."""
    owners = names_of(names)
    return owners, tuple(measurements.frame[(names or ()).index(owner)] for owner in owners)


def along(
    axis: Float[Tensor, "3 poses"], derivative: Float[Tensor, "parameters six poses"]
) -> Float[Tensor, "parameters 1 poses"]:
    """Return the part of every parameter's shift of the tool that is along an axis."""
    total = derivative[:, 0] * axis[0]
    for k in (1, 2):
        total = torch.addcmul(total, derivative[:, k], axis[k])
    return total[:, None]


def unit_vectors(vectors: Float[Tensor, "3 poses"]) -> Float[Tensor, "3 poses"]:
    """Return the directions of vectors [m]; of a vector of no length none."""
    directions: Tensor = vectors / vectors.norm(dim=0).clamp(min=SHORTEST)
    return directions
