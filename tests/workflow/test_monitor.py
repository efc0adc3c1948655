"""`pisigma.monitor`: sessions and dates in, verdicts and charts out."""

from dataclasses import replace

import pytest
from testing.aged import model_before, rows_later
from testing.closeness import assert_close

from pisigma.errors import IdentificationError, MeasurementError
from pisigma.model.folder.model_folder import save_model
from pisigma.workflow.monitor import MonitorSettings, monitor

COLLISION = (0.0, 0.0, 0.00436, 0.0, 0.0, 0.0)


def dated(rows, *dates):
    return replace(rows, date=tuple(dates[k * len(dates) // rows.rows] for k in range(rows.rows)))


def test_rows_of_several_days_are_several_sessions():
    rows = dated(rows_later(12, 30), "2026-02-01", "2026-01-01")
    monitoring = monitor(model_before(), [rows, dated(rows_later(6, 31), "2026-03-01")])
    assert [one.date for one in monitoring.sessions] == ["2026-01-01", "2026-02-01", "2026-03-01"]
    assert [one.session.rows for one in monitoring.sessions] == [6, 6, 6]
    assert not monitoring.action
    assert [chart.what for chart in monitoring.charts][-2:] == ["joint 6", "error"]


def test_an_instrument_that_was_moved_raises_no_alarm():
    monitoring = monitor(model_before(), [rows_later(12, 3, base=(1e-3, -2e-3, 5e-4, 2e-3, 0.0, 0.0))])
    assert [one.moved.what for one in monitoring.sessions[0].session.moved] == ["base", "base"]
    assert monitoring.sentences == ()
    assert not monitoring.action


def test_a_collision_calls_for_action():
    settings = MonitorSettings(dates=("2026-01-01", "2026-02-01"), limit_mm=0.5)
    monitoring = monitor(model_before(), [rows_later(10, 30), rows_later(10, 31, COLLISION)], settings)
    report = monitoring.to_json()
    assert report["action"]
    assert [one["verdict"] for one in report["sessions"]] == ["unchanged", "moved"]
    moved = report["sessions"][1]["moved"]
    assert [one["what"] for one in moved] == ["joint 3"]
    assert_close(moved[0]["shift_deg"], 0.25, rtol=0.05)
    assert moved[0]["interval"][0] < 0.25 < moved[0]["interval"][1]
    assert report["sessions"][1]["recalibrate"]
    assert report["forecast"]["passed"]
    assert any("pisigma recalibrate" in line for line in report["says"])


@pytest.mark.parametrize(
    ("settings", "fault"),
    [({"dates": ("1.2.2026",)}, MeasurementError), ({"limit_mm": 0.0}, IdentificationError)],
)
def test_settings_that_make_no_sense_are_refused(settings, fault):
    with pytest.raises(fault):
        MonitorSettings(**settings)


def test_every_file_has_a_date_or_none():
    with pytest.raises(MeasurementError, match="2 were wanted"):
        monitor(model_before(), [rows_later(6, 1)] * 2, MonitorSettings(dates=("2026-01-01",)))


def test_rows_that_no_motion_explains_are_refused_and_not_remembered(tmp_path):
    rows = rows_later(10, 30)
    metres = replace(rows, position=rows.position * 1e-3)
    (folder := tmp_path / "model").mkdir()
    save_model(model_before(), folder)
    with pytest.raises(
        IdentificationError, match="another robot was measured, or a column or a unit is wrong"
    ):
        monitor(folder, [rows, metres])
    assert [one.name for one in tmp_path.iterdir()] == ["model"]
