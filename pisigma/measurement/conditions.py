"""What differs from row to row besides the joint values: payload, temperature, and from which side joints came."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements

CONDITIONS = ("payload_kg", "temperature_c")
"""Columns of measurement files that may stand beside any row."""
SMALLEST_SPREAD = 1e-9
"""A condition that varies less shows nothing of what it does."""
APPROACH = "approach"
"""Of `JointState.stated`: `(*batch, dof)`, +1 where the joint's value grew before it stopped, -1 where it fell; 0 or
NaN where that is not stated."""


@dataclass(frozen=True, eq=False)
class JointState:
    """What features of a joint correction are functions of: joint values, and what is stated beside them.

    Attributes:
        q: joint values [rad or m].
        stated: by name what is stated beside them: the conditions `(*batch,)` [kg, deg C], `APPROACH` `(*batch, dof)`.
            What is missing, or NaN, is as usual.
    """

    q: Float[Tensor, "*batch dof"]
    stated: Mapping[str, Tensor] = field(default_factory=dict)

    @staticmethod
    def of(measurements: Measurements) -> "JointState":
        """Of measured rows: joint values and all that they state."""
        columns = {
            "payload_kg": measurements.payload,
            "temperature_c": measurements.temperature,
            APPROACH: measurements.approach,
        }
        return JointState(
            measurements.q, {name: values for name, values in columns.items() if values is not None}
        )

    def __getitem__(self, rows: slice | Tensor) -> "JointState":
        """Some of the rows, by slice, index or mask of the first axis."""
        return JointState(self.q[rows], {name: values[rows] for name, values in self.stated.items()})

    def split(self, size: int) -> Iterator["JointState"]:
        """At most so many rows at a time."""
        return (self[start : start + size] for start in range(0, len(self.q), size))


def stated_conditions(measurements: Measurements) -> tuple[str, ...]:
    """Names of the conditions that every row states and that are not always the same."""
    stated = []
    for name, values in zip(CONDITIONS, conditions_of(measurements, CONDITIONS).t(), strict=True):
        if bool(torch.isfinite(values).all()) and float(values.max() - values.min()) > SMALLEST_SPREAD:
            stated.append(name)
    return tuple(stated)


def conditions_of(measurements: Measurements, names: Sequence[str]) -> Float64[Tensor, "rows _conditions"]:
    """Conditions of every row [kg, deg C], NaN where a row does not state one."""
    columns = {"payload_kg": measurements.payload, "temperature_c": measurements.temperature}
    missing = torch.full((measurements.rows,), torch.nan, dtype=torch.float64, device=measurements.q.device)
    stacked = [values if (values := columns[name]) is not None else missing for name in names]
    return torch.stack(stacked, 1) if stacked else missing.new_zeros((measurements.rows, 0))


def repeat_key(measurements: Measurements) -> Float64[Tensor, "rows _key"]:
    """What rows agree in that repeat one pose: joint values, payload and approach (0 where not stated).

    The payload counts where every row states one and it varies.
    """
    loaded = tuple(name for name in stated_conditions(measurements) if name == "payload_kg")
    columns = [measurements.q, conditions_of(measurements, loaded)]
    if measurements.approach is not None:
        columns.append(measurements.approach.nan_to_num(0.0))
    return torch.cat(columns, 1)
