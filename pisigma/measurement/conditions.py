"""Conditions of a measurement other than the joint values: payload, temperature, approach and torques."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, numbers_of_names

CONDITIONS = ("payload_kg", "temperature_c")
"""Columns of conditions with one number per row."""
_MIN_SPREAD = 1e-9
"""Smallest range of a condition [kg or deg C] over which its effect can be identified."""
APPROACH = "approach"
"""Key of `JointState.conditions`: `(*batch, dof)`, +1 if the joint's value increased before it stopped, -1 if it
decreased; 0 or NaN if not stated."""

TORQUE = "torque"
"""Key of `JointState.conditions`: `(*batch, dof)`, measured torques of the drives [Nm; N for prismatic joints]; NaN if
not stated."""
_TORQUE_STEP = 0.2
"""Difference of torques that shows a different load of the arm, relative to the standard deviation, over all rows, of
the torque that varies most; the torque of a joint that gravity does not load varies only by its noise."""
_MIN_MOTION = 1e-3
"""Smallest motion of a joint that is certain to take up the play of its gear [rad or m]."""


@dataclass(frozen=True, eq=False)
class JointState:
    """Inputs of the features of a joint correction: joint values and conditions.

    Attributes:
        q: joint values [rad or m].
        conditions: `CONDITIONS` `(*batch,)` [kg, deg C], `APPROACH` and `TORQUE` `(*batch, dof)` by name. A missing
            entry or NaN stands for the mean condition, the middle of the backlash, or a modelled torque.
    """

    q: Float[Tensor, "*batch dof"]
    conditions: Mapping[str, Tensor] = field(default_factory=dict)

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
        return JointState(self.q[rows], {name: values[rows] for name, values in self.conditions.items()})

    def split_rows(self, size: int) -> Iterator["JointState"]:
        """Yield at most `size` rows at a time."""
        return (self[start : start + size] for start in range(0, len(self.q), size))


def varying_conditions(measurements: Measurements) -> tuple[str, ...]:
    """Return the names of the conditions that every row states and that vary."""
    stated = []
    for name, values in zip(CONDITIONS, conditions_of(measurements, CONDITIONS).t(), strict=True):
        if bool(torch.isfinite(values).all()) and float(values.max() - values.min()) > _MIN_SPREAD:
            stated.append(name)
    return tuple(stated)


def conditions_of(measurements: Measurements, names: Sequence[str]) -> Float64[Tensor, "rows _conditions"]:
    """Return the conditions of every row [kg, deg C]; NaN if a row does not state one."""
    stated = JointState.from_measurements(measurements).conditions
    missing = torch.full((measurements.rows,), torch.nan, dtype=torch.float64, device=measurements.q.device)
    stacked = [stated.get(name, missing) for name in names]
    return torch.stack(stacked, 1) if stacked else missing.new_zeros((measurements.rows, 0))


def repeat_key(measurements: Measurements) -> Float64[Tensor, "rows _key"]:
    """Return the values that repeats of a pose have in common: joint values, payload, approach (0 if not stated), load.

    The payload is included if every row states one and the values vary. The load is the difference of the torques from
    those of the first row at the same values, in steps of `_TORQUE_STEP`; smaller differences are noise.
    """
    loaded = tuple(name for name in varying_conditions(measurements) if name == "payload_kg")
    columns = [measurements.q, conditions_of(measurements, loaded)]
    if measurements.approach is not None:
        columns.append(measurements.approach.nan_to_num(0.0))
    if measurements.torque is not None:
        torque = measurements.torque.nan_to_num(0.0)
        group = groups_of_equal_joints(torch.cat(columns, 1))
        first = torch.full_like(group, len(group)).scatter_reduce(
            0, group, torch.arange(len(group), device=group.device), "amin"
        )
        step = _TORQUE_STEP * torque.std(0, correction=0).max().clamp(min=_MIN_SPREAD)
        columns.append(((torque - torque[first[group]]) / step).round())
    return torch.cat(columns, 1)


def order_of_rows(measurements: Measurements) -> Int64[np.ndarray, " rows"]:
    """Return the rows in the order in which they were measured: file after file, in the order of their lines."""
    file = numbers_of_names(measurements.origin or ("",) * measurements.rows).numpy()
    return np.lexsort((np.array(measurements.line), file))


def motions_between_rows(
    measurements: Measurements,
) -> tuple[Float64[np.ndarray, "rows dof"], Float64[np.ndarray, "rows dof"]]:
    """Compute the motions [rad or m] from the previous row to each row, and from the next row back to it.

    Unknown motions are NaN: those at the ends of a file and next to lines of the file without a row, because a row that
    was left out or not selected may have been measured there.
    """
    q, order = measurements.q.cpu().numpy(), order_of_rows(measurements)
    file = np.array(measurements.origin or ("",) * len(q))[order]
    first, last = (
        np.array(lines)[order] for lines in (measurements.line, measurements.last_line or measurements.line)
    )
    follows = (file[1:] == file[:-1]) & (first[1:] - last[:-1] <= 1)
    step = np.where(follows[:, None], np.diff(q[order], axis=0), np.nan)
    unknown = np.full((1, q.shape[1]), np.nan)
    before, after = np.empty_like(q), np.empty_like(q)
    before[order], after[order] = np.concatenate([unknown, step]), np.concatenate([-step, unknown])
    return before, after


def approach_by_order(measurements: Measurements) -> Float64[Tensor, "rows dof"]:
    """Return the direction of approach of every joint if the rows were measured in the order of their file.

    It is that of the joint's last motion by more than `_MIN_MOTION`; NaN if this is not known (`motions_between_rows`).
    """
    motion = motions_between_rows(measurements)[0]
    approach, last = np.empty_like(motion), np.full(motion.shape[1], np.nan)
    for row in order_of_rows(measurements):
        last = np.where(np.abs(motion[row]) <= _MIN_MOTION, last, np.sign(motion[row]))
        approach[row] = last
    return torch.from_numpy(approach).to(measurements.q.device)
