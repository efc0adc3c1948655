"""Conditions of a measurement in addition to the joint values: payload, temperature and direction of approach."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements

CONDITIONS = ("payload_kg", "temperature_c")
"""Columns of conditions that any row of a measurement file may contain."""
MIN_SPREAD = 1e-9
"""Smallest range of a condition [kg or deg C] over which its effect can be identified."""
APPROACH = "approach"
"""Key of `JointState.stated`: `(*batch, dof)`, +1 if the joint's value increased before it stopped, -1 if it decreased;
0 or NaN if not given."""

TORQUE = "torque"
"""Key of `JointState.stated`: `(*batch, dof)`, measured torques of the drives [Nm; N for prismatic joints]; NaN if not
given."""
MIN_MOTION = 1e-3
"""[rad or m] Smaller motions of a joint need not take up the play of its gear."""


@dataclass(frozen=True, eq=False)
class JointState:
    """Inputs of the features of a joint correction: joint values and conditions.

    Attributes:
        q: joint values [rad or m].
        stated: conditions `(*batch,)` [kg, deg C] and `APPROACH` `(*batch, dof)` by name. A missing entry or NaN
            stands for the mean condition.
    """

    q: Float[Tensor, "*batch dof"]
    stated: Mapping[str, Tensor] = field(default_factory=dict)

    @staticmethod
    def from_measurements(measurements: Measurements) -> "JointState":
        """Return the joint values of measured rows with the conditions that they state."""
        columns = {
            "payload_kg": measurements.payload,
            "temperature_c": measurements.temperature,
            APPROACH: measurements.approach,
            TORQUE: measurements.torque,
        }
        return JointState(
            measurements.q, {name: values for name, values in columns.items() if values is not None}
        )

    def __getitem__(self, rows: slice | Tensor) -> "JointState":
        """Return the rows that a slice, index or mask of the first axis selects."""
        return JointState(self.q[rows], {name: values[rows] for name, values in self.stated.items()})

    def split_rows(self, size: int) -> Iterator["JointState"]:
        """Yield at most `size` rows at a time."""
        return (self[start : start + size] for start in range(0, len(self.q), size))


def stated_conditions(measurements: Measurements) -> tuple[str, ...]:
    """Return the names of the conditions that every row states and that vary."""
    stated = []
    for name, values in zip(CONDITIONS, conditions_of(measurements, CONDITIONS).t(), strict=True):
        if bool(torch.isfinite(values).all()) and float(values.max() - values.min()) > MIN_SPREAD:
            stated.append(name)
    return tuple(stated)


def conditions_of(measurements: Measurements, names: Sequence[str]) -> Float64[Tensor, "rows _conditions"]:
    """Return the conditions of every row [kg, deg C]; NaN if a row does not state one."""
    columns = {"payload_kg": measurements.payload, "temperature_c": measurements.temperature}
    missing = torch.full((measurements.rows,), torch.nan, dtype=torch.float64, device=measurements.q.device)
    stacked = [values if (values := columns[name]) is not None else missing for name in names]
    return torch.stack(stacked, 1) if stacked else missing.new_zeros((measurements.rows, 0))


def repeat_key(measurements: Measurements) -> Float64[Tensor, "rows _key"]:
    """Return the values that repeats of a pose have in common: joint values, payload and approach (0 if not given).

    The payload is included if every row states one and it varies.
    """
    loaded = tuple(name for name in stated_conditions(measurements) if name == "payload_kg")
    columns = [measurements.q, conditions_of(measurements, loaded)]
    if measurements.approach is not None:
        columns.append(measurements.approach.nan_to_num(0.0))
    return torch.cat(columns, 1)


def motions_between_rows(
    measurements: Measurements,
) -> tuple[Float64[np.ndarray, "rows dof"], Float64[np.ndarray, "rows dof"]]:
    """Compute the motions [rad or m] from the previous row, and from the next row back; 0 at the ends of a file."""
    q = measurements.q.cpu().numpy()
    order = _order_of_files(measurements)
    origin = np.array(measurements.origin or ("",) * len(q))[order]
    step = np.diff(q[order], axis=0) * (origin[1:] == origin[:-1])[:, None]
    none = np.zeros((1, q.shape[1]))
    before, after = np.empty_like(q), np.empty_like(q)
    before[order], after[order] = np.concatenate([none, step]), np.concatenate([-step, none])
    return before, after


def approach_by_order(measurements: Measurements) -> Float64[Tensor, "rows dof"]:
    """Return the direction of approach of every joint if the rows were measured in the order of their file.

    It is that of the joint's last motion by more than `MIN_MOTION`; NaN before its first one in a file.
    """
    motion = motions_between_rows(measurements)[0]
    direction = np.where(np.abs(motion) > MIN_MOTION, np.sign(motion), np.nan)
    approach, last, file = np.empty_like(direction), direction[0], ""
    for row in _order_of_files(measurements):
        origin = measurements.origin[row] if measurements.origin else ""
        last = np.where(np.isnan(direction[row]), np.nan if origin != file else last, direction[row])
        approach[row], file = last, origin
    return torch.from_numpy(approach).to(measurements.q.device)


def _order_of_files(measurements: Measurements) -> Int64[np.ndarray, " rows"]:
    """Return the rows in the order of their lines; those of several files follow one another."""
    if measurements.origin:
        return np.arange(measurements.rows)
    return np.argsort(np.array(measurements.line), kind="stable")
