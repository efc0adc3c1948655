"""Temperatures in degrees Fahrenheit, payloads in grams, and conditions that only some rows state, are warned of."""

from dataclasses import replace

import pytest
import torch
from testing.checked import checked
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.validation.checks.check import Check
from pisigma.validation.checks.conditions import (
    check_conditions,
    check_expansion,
    check_payload,
    check_temperature,
)


@pytest.mark.parametrize(
    ("name", "check", "largest", "findings"),
    [
        ("temperature", check_temperature, 35.0, 0),
        ("temperature", check_temperature, 70.0, 1),
        ("payload", check_payload, 5.0, 0),
        ("payload", check_payload, 5000 * 0.35, 1),
    ],
)
def test_values_of_another_unit_are_warned_of(name: str, check: Check, largest: float, findings: int) -> None:
    simulated = simulate("ur5", rows=30, noise=5e-5)
    values = torch.linspace(0.3, 1, 30, dtype=torch.float64) * largest
    values[0] = torch.nan
    rows = replace(simulated.measurements, **{name: values})
    found = list(check(checked(GeometricCalibrator(simulated.nominal), rows)))
    assert len(found) == findings
    for diagnostic in found:
        assert (diagnostic.kind, diagnostic.severity) == (name, "warning")
        assert rows.place(29) in diagnostic.values.values()
        assert diagnostic.values[name] == largest
        limit = 60 if name == "temperature" else 200 * simulated.nominal.reach**3
        assert diagnostic.row_places == tuple(rows.place(row) for row in range(30) if values[row] > limit)


@pytest.mark.parametrize("name", ["payload", "temperature"])
@pytest.mark.parametrize(("missing", "findings"), [(0, 0), (12, 1), (30, 0)])
def test_a_condition_that_only_some_rows_state_is_warned_of(name: str, missing: int, findings: int) -> None:
    simulated = simulate("ur5", rows=30, noise=5e-5)
    values = torch.linspace(0, 5, 30, dtype=torch.float64)
    values[30 - missing :] = torch.nan
    rows = replace(simulated.measurements, **{name: values})
    found = list(check_conditions(checked(GeometricCalibrator(simulated.nominal), rows)))
    assert len(found) == findings
    for diagnostic in found:
        assert diagnostic.cause.startswith(name)
        assert diagnostic.row_places == tuple(rows.place(row) for row in range(18, 30))


@pytest.mark.parametrize("expansion", [0.0, 12e-6])
def test_thermal_expansion_of_links_is_warned_of(expansion: float) -> None:
    simulated = simulate("ur5", rows=80, noise=3e-5)
    rows = replace(simulated.measurements, temperature=torch.linspace(15, 35, 80, dtype=torch.float64))
    calibrator = GeometricCalibrator(simulated.nominal)
    geometry = calibrator.fit(rows).solved.geometry
    from_base = rows.position - torch.from_numpy(next(iter(geometry.bases.values()))[:3])
    warm = replace(rows, position=rows.position + expansion * (rows.temperature - 20)[:, None] * from_base)
    found = list(check_expansion(checked(calibrator, warm)))
    assert [one.kind for one in found] == ["expansion"] * bool(expansion)
    for one in found:
        assert abs(one.values["expansion_per_k"] - expansion) < 4 * one.values["sigma"]
