"""The report of a cell has what its acceptance needs: statements, budget, measured errors, and who accepted it."""

import math

import pytest
import torch
from testing.cell_before import cell_of_schema_1
from testing.cell_rows import measured
from testing.closeness import assert_close
from testing.refusals import refused
from testing.simulated_arm import BASE

from pisigma.files.errors import PlanningError
from pisigma.measurement.dataset import Measurements
from pisigma.workflow.cell.acceptance import acceptance_of
from pisigma.workflow.cell.cell import Cell

STATED = """
pose_repeatability_mm: 0.05
expansion_per_k: 1.2e-5
instrument:
  name: Tracker 7
  serial: "0012"
  certificate: K-1
  calibrated: 2026-02-14
  expanded_uncertainty_mm: 0.03
  coverage_factor: 2
"""


@pytest.fixture
def cell(tmp_path):
    return Cell.open(cell_of_schema_1(tmp_path))


def _stated(cell, text=STATED):
    path = cell.folder / "cell.yaml"
    path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")
    return Cell.open(cell.folder)


def test_what_is_not_stated_is_named(cell):
    found = acceptance_of(cell)
    assert [one.evaluation for one in found.budget.components] == ["A", "A"]
    names = [line.partition(":")[0] for line in found.not_stated_sentences]
    assert names.count("instrument") == 5
    assert {"thermal expansion", "pose repeatability of the maker", "AP and RP", "AT and RT"} < set(names)
    assert found.temperature_span is None


def test_what_is_stated_is_in_the_budget(cell):
    cell = _stated(cell)
    cell.sessions.set_aside("2026-08-01", "joint 3 had slipped")
    found = acceptance_of(cell)
    assert found.instrument.serial == "0012"
    u = [one.standard_uncertainty for one in found.budget.components]
    assert_close(u[2], 0.015e-3, rtol=1e-12)
    assert_close(found.budget.combined_uncertainty, math.sqrt(sum(one**2 for one in u)))
    assert (found.measured.session, found.measured.rows) == ("2026-06-01", 10)
    assert found.measured.errors.statistics["p95"] < found.budget.coverage_radius * 1e3
    assert not found.is_contradicted


def test_errors_that_the_budget_does_not_explain_are_found(cell):
    assert acceptance_of(_stated(cell)).is_contradicted


def test_repeated_poses_after_the_instrument_was_moved_have_no_accuracy(cell):
    """The base is then fitted to the rows; two cycles show the scatter, but not RP."""
    base = BASE.copy()
    base[0] += 0.4
    rows = measured(12, 9, base=base)
    noise = 3e-5 * torch.randn(4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rows = Measurements(
        q=torch.cat([rows.q, rows.q[:4]]), position=torch.cat([rows.position, rows.position[:4] + noise])
    )
    cell.sessions.set_aside("2026-08-01", "joint 3 had slipped")
    cell.history.record("instrument", "2026-09-01")
    cell.add_session(rows, day="2026-09-10")
    found = acceptance_of(cell)
    assert (found.measured.session, found.measured.fitted_frames) == ("2026-09-10", ("base",))
    assert not found.is_contradicted
    assert [(one.rows, one.accuracy, one.repeatability) for one in found.repeats] == [(2, None, None)] * 4
    assert found.to_json()["repeats"]["degrees_of_freedom"] == 12


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("instrument.coverage_factor", "instrument: {coverage_factor: 0.5}"),
        ("instrument.serial", "instrument: {serial: 12}"),
        ("instrument.calibrated", "instrument: {calibrated: 2126-01-01}"),
        ("expansion_per_k", "expansion_per_k: -1"),
    ],
)
def test_wrong_statements_are_refused(cell, key, text):
    with refused(PlanningError, file="cell.yaml", column=key):
        _stated(cell, f"\n{text}\n")
