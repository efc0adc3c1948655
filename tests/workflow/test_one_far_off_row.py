"""A single row that is far off is named, and the others are used, whether or not the instrument moved."""

import dataclasses
import math

import pytest
from testing.aged import original_model, rows_after_change
from testing.models import no_type_checker

from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import save_model
from pisigma.workflow.monitor import monitor
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.report import report

WRONG = 5


def with_one_far_off(rows: Measurements) -> Measurements:
    """Return the rows with 162 deg added to the first joint of one row."""
    q = rows.q.clone()
    q[WRONG, 0] += math.radians(162)
    return dataclasses.replace(rows, q=q, source="rows.csv", line=tuple(range(2, rows.rows + 2)))


@pytest.mark.parametrize("base", [(0.0,) * 6, (0.4, 0.2, 0.0, 0.0, 0.0, 0.3)], ids=["there", "moved"])
def test_monitor_uses_the_other_rows(base):
    rows = rows_after_change(16, 3, base=base)
    with no_type_checker():
        done = monitor(original_model(), [with_one_far_off(rows)])
        alone = monitor(original_model(), [rows])
    assert done.untrusted_sessions == ()
    (session,), (right,) = (one.sessions_of_call for one in (done, alone))
    assert session.session.rows == 15
    assert session.session.verdict == right.session.verdict
    assert abs(session.session.rms - right.session.rms) < 5e-5
    assert sum("rows.csv, line 7" in one for one in done.warnings) == 1


def test_report_uses_the_other_rows(tmp_path):
    save_model(original_model(), tmp_path)
    with no_type_checker():
        done = report(tmp_path, with_one_far_off(rows_after_change(24, 3)))
    assert done.diagnostics == ()
    assert done.content.rows.measurements.rows == 23
    assert float(done.content.rows.model_errors.position.max()) < 2e-3
    assert sum("rows.csv, line 7" in one for one in done.content.remarks) == 1


def test_recalibrate_uses_the_other_rows():
    with no_type_checker():
        done = recalibrate(original_model(), with_one_far_off(rows_after_change(12, 3)))
    assert done.trusted
    assert [one.row for one in done.summary.outliers] == [WRONG]
