"""Check whether all rows state a condition, and whether payloads and temperatures are plausible in kg and deg C."""

from collections.abc import Iterator

import numpy as np
import torch

from pisigma.measurement.conditions import CONDITIONS, conditions_of
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

_HOT = 60.0
"""Temperature above which a warning is given [deg C]; robots may work at up to 45 deg C, and their housings warm up
by less than 15 K; 20 deg C is 68 deg F."""

_HEAVY = 200.0
"""Payload of an arm with a reach of 1 m above which a warning is given [kg]; it grows with the cube of the reach. Arms
on the market lift less than a half of it: 10 kg at 1.1 m, 300 kg at 2.6 m, 2,300 kg at 3.7 m, 5 kg at 0.4 m (SCARA)."""

_MIN_SPREAD = 1.0
"""Standard deviation of the temperatures [K] above which an expansion is estimated; within a smaller one, other changes
with time are larger."""
_EXPANDS = 5.0
"""Ratio of the expansion to its standard deviation above which a warning is given; many effects may resemble it."""


def check_payload(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about payloads that look like grams."""
    reach = checked.robot.reach
    what = f"heavy for a robot with a reach of {reach:.2f} m"
    yield from _above(checked.rows, "payload", _HEAVY * reach**3, "kg", "heaviest", what, "grams")


def check_temperature(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about temperatures that look like degrees Fahrenheit."""
    unit = "degrees Fahrenheit: deg C = (deg F - 32) / 1.8"
    yield from _above(checked.rows, "temperature", _HOT, "deg C", "hottest", "hot for a robot", unit)


def _above(
    rows: Measurements, name: str, limit: float, unit: str, superlative: str, what: str, other_unit: str
) -> Iterator[Diagnostic]:
    """Warn about values of a condition above a limit, which look like values in another unit."""
    values = getattr(rows, name)
    if values is None or not bool((values > limit).any()):
        return
    above = (values > limit).nonzero()[:, 0].tolist()
    most = int(torch.nan_to_num(values, -torch.inf).argmax())
    yield Diagnostic(
        kind=name,
        severity="warning",
        sentence=f"{rows.place(most)}: {float(values[most]):.4g} {unit} is {what} ({len(above)} of {rows.rows} rows "
        f"are above {limit:.3g} {unit}); check whether the values are in {other_unit}.",
        row_places=tuple(rows.place(row) for row in above),
        values={superlative: rows.place(most), name: float(values[most])},
    )


def check_expansion(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Warn about errors in proportion to temperature and distance from the base, which joints cannot correct.

    The errors of positions p from the base are fitted by `alpha (T - mean T) p`.
    """
    error = checked.final_errors.get("position")
    if checked.rows.temperature is None or error is None:
        return
    stated = torch.isfinite(error).all(1) & torch.isfinite(checked.rows.temperature)
    rows, y = checked.rows.select(stated.nonzero()[:, 0]), error[stated].flatten()
    assert rows.temperature is not None
    change = (rows.temperature - rows.temperature.mean())[:, None]
    if not float(change.square().mean().sqrt()) > _MIN_SPREAD:
        return
    learned = None if checked.hybrid is None else checked.hybrid.learned
    bases = (checked.geometric if learned is None else learned.geometry).bases
    base = torch.from_numpy(np.stack([bases[name][:3] for name in rows.frame]))
    predicted = (checked.hybrid or checked.geometric).predicted_poses(rows)[:, :3, 3]
    x = (change * (predicted - base)).flatten()
    alpha = float(x @ y / x.square().sum().clamp(min=1e-12))
    sigma = float((y - alpha * x).norm() / (len(x) ** 0.5 * x.norm().clamp(min=1e-6)))
    if alpha > _EXPANDS * sigma:
        yield Diagnostic(
            kind="expansion",
            severity="warning",
            sentence=f"Errors grow by {alpha * 1e3:.2g} +- {sigma * 1e3:.1g} mm per metre from the base and kelvin, as "
            "by thermal expansion of the links (0.012 mm for steel, 0.023 mm for aluminium), which is not corrected "
            "and not included in predicted errors. Calibrate and work at one temperature.",
            values={"expansion_per_k": alpha, "sigma": sigma},
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
                row_places=tuple(rows.place(row) for row in missing),
                cause=name,
                values={"missing": len(missing)},
                remedy=remedy,
            )
