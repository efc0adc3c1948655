"""What was different from row to row besides the joint values: payload and temperature."""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements

CONDITIONS = ("payload_kg", "temperature_c")
"""Columns of measurement files that may stand beside any row."""
SMALLEST_SPREAD = 1e-9
"""A condition that varies less tells nothing."""


def stated_conditions(measurements: Measurements) -> tuple[str, ...]:
    """Names of the conditions that every row states and that are not always the same."""
    found = []
    for name, values in zip(CONDITIONS, conditions_of(measurements, CONDITIONS).t(), strict=True):
        if bool(torch.isfinite(values).all()) and float(values.max() - values.min()) > SMALLEST_SPREAD:
            found.append(name)
    return tuple(found)


def conditions_of(measurements: Measurements, names: Sequence[str]) -> Float64[Tensor, "rows _conditions"]:
    """Conditions of every row [kg, deg C], NaN where a row does not state one."""
    columns = {"payload_kg": measurements.payload, "temperature_c": measurements.temperature}
    missing = torch.full((measurements.rows,), torch.nan, dtype=torch.float64, device=measurements.q.device)
    found = [values if (values := columns[name]) is not None else missing for name in names]
    return torch.stack(found, 1) if found else missing.new_zeros((measurements.rows, 0))


def with_conditions(measurements: Measurements, names: Sequence[str]) -> Float64[Tensor, "rows _state"]:
    """Joint values, and behind them the conditions of every row: what features are functions of."""
    return torch.cat([measurements.q, conditions_of(measurements, names)], 1)
