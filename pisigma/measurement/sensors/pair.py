"""Pairs: the distance between the tools of two rows, as with a ball bar or a gauge block."""

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
    along,
    names_of,
    unit_vectors,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

LARGEST_MISS = 0.2
"""[reach] By the robot as drawn, a measured distance between two poses is not wrong by more."""


@dataclass(frozen=True, eq=False)
class PairSensor(AbstractSensor):
    """The distance between the tools of two rows, which are neighbours; the first of them counts.

    Attributes:
        measured: the distance [m].
        present: whether a row is the first of a pair; then it has an even number.
        sigma: standard deviation of every row [m], or None.
    """

    name = "pair"
    unit = "m"
    components = 1
    paired = True
    holds_frame = False
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "PairSensor | None":
        """Gather the pairs, whose rows come first, side by side."""
        data = rows.measurements
        if data.distance is None or data.pair is None:
            return None
        paired = torch.tensor([bool(name) for name in data.pair], device=data.q.device)
        first = torch.arange(data.rows, device=paired.device) % 2 == 0
        present = data.measured("distance") & paired & first
        return cls(torch.where(present, data.distance, 0.0), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted distances [m]."""
        residual: Tensor = self.measured[rows] - _apart(motion.position).norm(dim=0)
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the shift of the first tool against the second along their line."""
        return along(unit_vectors(_apart(motion.position)), _apart(motion.derivative[:, :3]))

    def partner_derivative(self, motion: ToolMotion) -> Derivative:
        """Return minus the shift of the next row's tool along the line."""
        return -along(unit_vectors(_apart(motion.position)), _following(motion.derivative[:, :3]))

    @classmethod
    def initial_guess(cls, measurements: Measurements, T: Poses, reach: float) -> InitialUnknowns | None:
        """Guess nothing.

        Raises:
            IdentificationError: a distance is far from what the robot as drawn has.
        """
        if measurements.pair is None or measurements.distance is None:
            return None
        rows = torch.arange(0, 2 * len(names_of(measurements.pair)), 2)
        apart = (T[rows, :3, 3] - T[rows + 1, :3, 3]).norm(dim=-1)
        distance = measurements.distance.cpu()[rows]
        miss = (distance - apart).abs()
        if len(miss) == 0 or float(miss.max()) <= LARGEST_MISS * reach:
            return None
        worst = int(miss.argmax())
        row = int(rows[worst])
        raise IdentificationError(
            f"{measurements.place(row)}: pair '{measurements.pair[row]}' is {float(distance[worst]) * 1e3:.6g} mm "
            f"apart, but the guessed robot has its two tool points {float(apart[worst]) * 1e3:.4g} mm apart; "
            "correct the distance or the names of the pairs."
        )


def _following(values: Tensor) -> Tensor:
    """Of every row, what the next one has."""
    return torch.cat([values[..., 1:], values[..., :1]], -1)


def _apart(values: Tensor) -> Tensor:
    """Of every row minus that of the next; it is used in the first rows of pairs only."""
    apart: Tensor = values - _following(values)
    return apart
