"""Check whether the temperatures of the rows are plausible for a robot in degrees Celsius."""

from collections.abc import Iterator

import torch

from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

_HOT = 60.0
"""Temperature above which a warning is given [deg C]; robots may work at up to 45 deg C, and their housings warm up
by less than 15 K; 20 deg C is 68 deg F."""


def check_temperature(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about temperatures that look like degrees Fahrenheit."""
    rows = checked.rows
    if rows.temperature is None:
        return
    hot = (rows.temperature > _HOT).nonzero()[:, 0].tolist()
    if hot:
        most = int(torch.nan_to_num(rows.temperature, nan=-torch.inf).argmax())
        yield Diagnostic(
            kind="temperature",
            severity="warning",
            sentence=f"{rows.place(most)}: {float(rows.temperature[most]):.4g} deg C is hot for a robot "
            f"({len(hot)} of {rows.rows} rows are above {_HOT:g} deg C); check whether the values are in degrees "
            "Fahrenheit: deg C = (deg F - 32) / 1.8.",
            rows=tuple(rows.place(row) for row in hot),
            values={"hottest": rows.place(most), "temperature": float(rows.temperature[most])},
        )
