"""Temperatures in degrees Fahrenheit, and conditions that only some rows state, are warned of."""

from dataclasses import replace

import pytest
import torch
from testing.checked import checked
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.validation.checks.conditions import check_conditions, check_temperature


@pytest.mark.parametrize(("hottest", "findings"), [(35.0, 0), (70.0, 1)])
def test_hot_rows_are_warned_of(hottest: float, findings: int) -> None:
    simulated = simulate("ur5", rows=30, noise=5e-5)
    temperature = torch.linspace(20, hottest, 30, dtype=torch.float64)
    temperature[0] = torch.nan
    rows = replace(simulated.measurements, temperature=temperature)
    found = list(check_temperature(checked(GeometricCalibrator(simulated.nominal), rows)))
    assert len(found) == findings
    for diagnostic in found:
        assert diagnostic.severity == "warning"
        assert diagnostic.values == {"hottest": rows.place(29), "temperature": 70.0}
        assert diagnostic.rows == tuple(rows.place(row) for row in range(24, 30))


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
        assert diagnostic.rows == tuple(rows.place(row) for row in range(18, 30))
