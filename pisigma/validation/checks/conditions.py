"""Check whether all rows state a condition, and whether payloads and temperatures are plausible in kg and deg C."""

from collections.abc import Iterator

import torch

from pisigma.measurement.conditions import CONDITIONS, conditions_of
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

_HOT = 60.0
"""Temperature above which a warning is given [deg C]; robots may work at up to 45 deg C, and their housings warm up
by less than 15 K; 20 deg C is 68 deg F."""

_HEAVY = 200.0
"""Payload of an arm with a reach of 1 m above which a warning is given [kg]; it grows with the cube of the reach. Arms
on the market lift less than a half of it: 10 kg at 1.1 m, 300 kg at 2.6 m, 2,300 kg at 3.7 m, 5 kg at 0.4 m (SCARA)."""


def check_payload(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about payloads that look like grams."""
    rows, largest = checked.rows, _HEAVY * checked.robot.reach**3
    if rows.payload is None:
        return
    heavy = (rows.payload > largest).nonzero()[:, 0].tolist()
    if heavy:
        most = int(torch.nan_to_num(rows.payload, nan=-torch.inf).argmax())
        yield Diagnostic(
            kind="payload",
            severity="warning",
            sentence=f"{rows.place(most)}: {float(rows.payload[most]):.4g} kg is heavy for a robot with a reach of "
            f"{checked.robot.reach:.2f} m ({len(heavy)} of {rows.rows} rows are above {largest:.3g} kg); check whether "
            "the values are in grams.",
            rows=tuple(rows.place(row) for row in heavy),
            values={"heaviest": rows.place(most), "payload": float(rows.payload[most])},
        )


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
