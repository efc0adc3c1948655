"""Dates of measurements, wherever they are stated."""

import datetime

import pytest
from testing.refusals import refused

from pisigma.files.errors import FleetError, MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.dates import date_in_name, is_date
from pisigma.robot import Robot
from pisigma.workflow.cell.new_cell import NewCell
from pisigma.workflow.fleet.manifest import new_cells
from pisigma.workflow.settings.monitoring import MonitorSettings

SLIPS = ("0206-11-22", "1969-12-31", "2206-11-22", "9999-12-31")


def test_days_from_1970_to_tomorrow_are_dates():
    today = datetime.date.today()
    for days, expected in ((0, True), (1, True), (2, False)):
        assert is_date((today + datetime.timedelta(days)).isoformat()) is expected
    assert is_date("1970-01-01")
    assert is_date((today + datetime.timedelta(300)).isoformat(), days_ahead=366)
    assert not any(map(is_date, (*SLIPS, "2026-1-1", "20260101", "2026-02-30", "", "May")))


def test_a_day_is_read_from_the_name_of_a_file():
    assert date_in_name("cell_2026-02-01.csv") == date_in_name("20260201.csv") == "2026-02-01"
    assert date_in_name("drawing_4711.csv") == date_in_name("part-1234-56-78.csv") == ""


@pytest.mark.parametrize("name", ["2026-02-30", "robot_2026-13-05", "2026_00_01"])
def test_a_day_that_does_not_exist_is_refused_in_the_name_of_a_file(name):
    with refused(MeasurementError, file=f"{name}.csv", value=name[-10:].replace("_", "-")):
        date_in_name(f"{name}.csv")
    assert date_in_name(f"{name.replace('-', '').replace('_', '')}.csv") == ""  # may be a serial number


@pytest.mark.parametrize("slip", SLIPS)
def test_a_mistyped_year_is_refused(slip, tmp_path):
    with pytest.raises(MeasurementError):
        date_in_name(f"cell_{slip}.csv")
    with pytest.raises(MeasurementError):
        MonitorSettings(dates=(slip,))
    (tmp_path / "rows.csv").write_text(
        f"q1_deg,q2_deg,q3_mm,q4_deg,x_mm,y_mm,z_mm,date\n1,2,-3,4,5,6,7,{slip}\n"
    )
    with pytest.raises(MeasurementError):
        Measurements.read_csv(tmp_path / "rows.csv", Robot.load("kiro3"))
    (tmp_path / "fleet.csv").write_text(f"id,robot,data,date\na,kiro3,rows.csv,{slip}\n")
    with pytest.raises(FleetError):
        new_cells(tmp_path / "fleet.csv", tmp_path / "cells", NewCell(""))
