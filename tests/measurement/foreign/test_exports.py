"""Small exports of instruments and controllers, all of the same six poses."""

from pathlib import Path

import pytest
from testing.closeness import assert_close

from pisigma.measurement.dataset import Measurements
from pisigma.workflow.import_rows import ImportedRows, import_rows
from pisigma.workflow.settings.importing import ImportSettings

EXPORTS = Path(__file__).parent / "exports"
REFERENCE = EXPORTS / "reference.csv"


def imported(*names: str, settings: ImportSettings | None = None) -> ImportedRows:
    return import_rows([EXPORTS / name for name in names], settings)


def check(rows: ImportedRows, atol_rotation: float | None = 2e-8, atol: float = 1e-15) -> None:
    reference, data = Measurements.read_csv(REFERENCE), rows.measurements
    assert_close(data.q, reference.q, atol=atol)
    assert_close(data.position, reference.position, atol=1e-15)
    if atol_rotation is None:
        assert data.rotation is None
    else:
        assert_close(data.rotation, reference.rotation, atol=atol_rotation)


@pytest.mark.parametrize("name", ["kuka.csv", "abb.txt", "fanuc.txt", "matrices.txt"])
def test_controllers_and_matrices(name: str):
    rows = imported(name, settings=ImportSettings(units="deg" if name == "abb.txt" else ""))
    check(rows)
    assert [row.line for row in rows.left_out] == (
        [11] if name == "fanuc.txt" else []
    )  # the line below its table


def test_a_recorder_that_counts_from_0_in_rad_and_m():
    rows = imported("ur_rtde.csv")
    check(rows, atol=1e-9)
    becomes = {row["heading"]: row["read_as"] for row in rows.proposal.columns_json()}
    assert becomes["target_q_0"] == "q1_rad"
    assert becomes["actual_q_0"] is None  # what was commanded counts
    assert becomes["actual_TCP_pose_0"] == "x_m"


def test_utf_16_without_a_mark_and_a_rotation_that_has_to_be_stated():
    check(imported("staubli.csv", settings=ImportSettings(rotation="staubli")))
    check(imported("staubli.csv", settings=ImportSettings(rotation="none")), None)


def test_spreadsheet_with_grouped_thousands_and_decimal_commas():
    check(imported("excel_german.csv"), None)


def test_points_without_a_partner_are_listed():
    rows = imported("polyworks_log.csv", "polyworks_points.csv", settings=ImportSettings(join="point"))
    check(rows, None)
    assert [(row.point, row.line) for row in rows.left_out if "points" in row.file] == [("P099", 9)]
    assert [row.point for row in rows.left_out if "log" in row.file] == ["p7"]


def test_points_joined_by_time_stamps():
    rows = imported("leica_list.txt", "leica_log.csv", settings=ImportSettings(join="time"))
    check(rows, None)
    assert not rows.warnings
    assert_close(rows.measurements.temperature, [20.5] * 6, atol=0.0)


def test_cells_keep_their_digits():
    header, first, *_ = imported("kuka.csv").measurement_table.text().splitlines()
    assert header.split(",")[8:10] == ["z_mm", "roll_deg"]
    assert (
        first
        == "10.500,-90.000,90.000,0.000,45.250,-179.125,-29.789,632.883,-86.260,114.655874,-38.090496,-44.347675"
    )
    assert "-29.789,632.883,-86.260" in imported("ur_rtde.csv").measurement_table.text()
