"""Check whether all rows state a condition, and whether temperatures are plausible in degrees Celsius."""

from collections.abc import Iterator

import torch

from pisigma.measurement.conditions import CONDITIONS, conditions_of
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


def check_conditions(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about a payload or temperature that only some rows state, so that its effect is not learned."""
    rows = checked.rows
    for name, values in zip(CONDITIONS, conditions_of(rows, CONDITIONS).t(), strict=True):
        missing = values.isnan().nonzero()[:, 0].tolist()
        if 0 < len(missing) < rows.rows:
            remedy = f"Add it to these rows (0 kg without a payload), or remove the column {name}."
            yield Diagnostic(
                kind="conditions",
                severity="warning",
                sentence=f"expected {name} in every row, got none in {len(missing)} of {rows.rows} rows (the first is "
                f"{rows.place(missing[0])}): its effect is not learned and remains as an error. {remedy}",
                rows=tuple(rows.place(row) for row in missing),
                cause=name,
                values={"missing": len(missing)},
                remedy=remedy,
            )
