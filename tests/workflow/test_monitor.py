"""`pisigma.monitor`: from sessions and dates to verdicts and charts."""

import html
from dataclasses import replace

import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close
from testing.hybrid import hybrid_of
from testing.refusals import refused

from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.dataset import join
from pisigma.model.folder.model_folder import save_model
from pisigma.workflow.monitor import monitor
from pisigma.workflow.settings.monitoring import MonitorSettings

pytestmark = pytest.mark.usefixtures("without_type_checker")

COLLISION = (0.0, 0.0, 0.00436, 0.0, 0.0, 0.0)


def dated(rows, *dates):
    return replace(rows, date=tuple(dates[k * len(dates) // rows.rows] for k in range(rows.rows)))


def test_rows_of_several_days_are_several_sessions():
    rows = dated(rows_after_change(12, 30), "2026-02-01", "2026-01-01")
    monitoring = monitor(original_model(), [rows, dated(rows_after_change(6, 31), "2026-03-01")])
    assert [one.date for one in monitoring.sessions_of_call] == ["2026-01-01", "2026-02-01", "2026-03-01"]
    assert [one.session.rows for one in monitoring.sessions_of_call] == [6, 6, 6]
    assert not monitoring.needs_action
    assert [chart.quantity for chart in monitoring.charts][-2:] == ["joint 6", "error"]


def test_an_instrument_that_was_moved_raises_no_alarm():
    monitoring = monitor(
        original_model(), [rows_after_change(12, 3, base=(1e-3, -2e-3, 5e-4, 2e-3, 0.0, 0.0))]
    )
    assert [one.what for one in monitoring.sessions_of_call[0].session.movements] == ["base", "base"]
    assert monitoring.sentences == ()
    assert not monitoring.needs_action


def test_a_collision_calls_for_action():
    settings = MonitorSettings(dates=("2026-01-01", "2026-02-01"), limit_mm=0.5)
    monitoring = monitor(
        original_model(), [rows_after_change(10, 30), rows_after_change(10, 31, COLLISION)], settings
    )
    report = monitoring.to_json()
    assert report["action"]
    assert [one["verdict"] for one in report["sessions"]] == ["unchanged", "moved"]
    moved = report["sessions"][1]["moved"]
    assert [one["what"] for one in moved] == ["joint 3"]
    assert_close(moved[0]["shift_deg"], 0.25, rtol=0.05)
    assert moved[0]["interval"][0] < 0.25 < moved[0]["interval"][1]
    assert report["sessions"][1]["recalibrate"]
    assert report["forecast"]["limit_exceeded"]
    assert any("pisigma recalibrate" in line for line in report["summary"])
    settings = MonitorSettings(dates=("2026-03-01", "2026-02-01"))
    repaired = monitor(
        original_model(), [rows_after_change(10, 30), rows_after_change(10, 31, COLLISION)], settings
    )
    assert repaired.needs_action
    assert repaired.advised_session is None
    assert not any("pisigma recalibrate" in line for line in repaired.sentences)


@pytest.mark.parametrize(
    ("settings", "error", "option", "value"),
    [
        ({"dates": ("1.2.2026",)}, MeasurementError, "dates", "1.2.2026"),
        ({"limit_mm": 0.0}, IdentificationError, "limit_mm", 0.0),
        ({"moved": ("arm",)}, IdentificationError, "moved", "arm"),
    ],
)
def test_settings_out_of_range_are_refused(settings, error, option, value):
    with refused(error, option=option, value=value):
        MonitorSettings(**settings)


def test_every_file_needs_a_date_if_dates_are_given():
    with refused(MeasurementError, option="dates", value=1):
        monitor(original_model(), [rows_after_change(6, 1)] * 2, MonitorSettings(dates=("2026-01-01",)))


def test_rows_that_are_not_trusted_are_in_no_chart_and_not_remembered(tmp_path):
    rows = rows_after_change(10, 30)
    metres = replace(rows, position=rows.position * 1e-3)
    (folder := tmp_path / "model").mkdir()
    save_model(original_model(), folder)
    monitoring = monitor(folder, [rows, metres])
    assert (len(monitoring.sessions_of_call), len(monitoring.all_sessions)) == (1, 1)
    (untrusted,) = monitoring.untrusted_sessions
    assert [one.kind for one in untrusted.diagnostics] == ["setup_fault"]
    assert monitoring.needs_action
    assert len(monitor(folder, [metres]).all_sessions) == 1
    alone = monitor(original_model(), [metres])
    assert (alone.all_sessions, alone.charts, alone.trends) == ((), (), ())
    alone.save_page(tmp_path / "page.html")
    (left_out,) = alone.untrusted_sessions
    assert html.escape(left_out.diagnostics[0].sentence) in (tmp_path / "page.html").read_text()


def test_the_same_rows_again_are_not_a_new_session(tmp_path):
    rows = rows_after_change(10, 30)
    (folder := tmp_path / "model").mkdir()
    save_model(original_model(), folder)
    again = replace(
        rows.select(torch.arange(9, -1, -1)), position=(rows.position.flip(0) * 1e5).round() / 1e5
    )
    both = monitor(folder, [dated(rows, "2026-01-01"), dated(again, "2026-02-01")])
    assert [one.date for one in both.all_sessions] == ["2026-01-01"]
    assert len(both.warnings) == 1
    with refused(MeasurementError, expected="new rows"):
        monitor(folder, [dated(again.select(torch.arange(6)), "2026-03-01")])
    corrected = monitor(folder, [rows], MonitorSettings(dates=("2026-01-05",)))
    assert [one.date for one in corrected.all_sessions] == ["2026-01-05"]
    assert len(corrected.warnings) == 1
    mixed = monitor(original_model(), [rows, join([rows_after_change(8, 31), again])])
    assert sorted(one.session.rows for one in mixed.sessions_of_call) == [8, 10]


def test_rows_of_the_calibration_are_not_a_session():
    own = hybrid_of("rb5").measurements
    with refused(MeasurementError, expected="new rows"):
        monitor(original_model(), [own])
    mixed = monitor(original_model(), [join([own.select(torch.arange(3)), rows_after_change(10, 30)])])
    assert [one.session.rows for one in mixed.sessions_of_call] == [10]
