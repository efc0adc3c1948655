"""Distances between the tool positions of two rows, measured with a ball bar or a gauge block."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    Derivative,
    InitialUnknowns,
    Poses,
    SensorRows,
    Unknowns,
    Values,
    component_along,
    distinct_names,
    unit_vectors,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

MAX_NOMINAL_ERROR = 0.2
"""Largest plausible error of a distance between two poses of the nominal robot, as a share of the reach."""


@dataclass(frozen=True, eq=False)
class PairSensor(AbstractSensor):
    """The distance between the tool positions of two neighbouring rows, as a value of the first row.

    Attributes:
        measured: measured distance of every row [m].
        present: mask of the first rows of pairs, which have even indices.
        sigma: standard deviation of every row's distance [m]; None if it is estimated.
    """

    name = "pair"
    unit = "m"
    components = 1
    paired = True
    determines_frame = False
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "PairSensor | None":
        """Build the sensor from the pairs, whose rows come first and are neighbours; None if there are none."""
        data = rows.measurements
        if data.distance is None or data.pair is None:
            return None
        paired = torch.tensor([bool(name) for name in data.pair], device=data.q.device)
        first = torch.arange(data.rows, device=paired.device) % 2 == 0
        present = data.is_measured("distance") & paired & first
        return cls(torch.where(present, data.distance, 0.0), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted distances [m]."""
        residual: Tensor = self.measured[rows] - _apart(motion.position).norm(dim=0)
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the distances: the relative shift of the tools along their connecting line."""
        return component_along(unit_vectors(_apart(motion.position)), _apart(motion.derivative[:, :3]))

    def partner_derivative(self, motion: ToolMotion) -> Derivative:
        """Return the derivatives with respect to the next row's tool: its negative shift along the connecting line."""
        return -component_along(unit_vectors(_apart(motion.position)), _following(motion.derivative[:, :3]))

    @classmethod
    def initial_guess(cls, measurements: Measurements, T: Poses, reach: float) -> InitialUnknowns | None:
        """Check the distances; there are no unknowns to guess.

        Raises:
            IdentificationError: a distance differs too much from that of the nominal robot.
        """
        if measurements.pair is None or measurements.distance is None:
            return None
        rows = torch.arange(0, 2 * len(distinct_names(measurements.pair)), 2)
        apart = (T[rows, :3, 3] - T[rows + 1, :3, 3]).norm(dim=-1)
        distance = measurements.distance.cpu()[rows]
        error = (distance - apart).abs()
        if len(error) == 0 or float(error.max()) <= MAX_NOMINAL_ERROR * reach:
            return None
        worst = int(error.argmax())
        row = int(rows[worst])
        raise IdentificationError(
            expected=f"about {float(apart[worst]) * 1e3:.4g} mm between the tool points of pair "
            f"'{measurements.pair[row]}', as for the nominal robot",
            value=float(f"{float(distance[worst]) * 1e3:.6g}"),
            at=measurements.place_of(row, "distance"),
            remedy="correct the distance or the names of the pairs",
        )


def _following(values: Tensor) -> Tensor:
    """Return the values of the next row, for every row."""
    return torch.cat([values[..., 1:], values[..., :1]], -1)


def _apart(values: Tensor) -> Tensor:
    """Return the value of every row minus that of the next row; used only for the first rows of pairs."""
    apart: Tensor = values - _following(values)
    return apart
