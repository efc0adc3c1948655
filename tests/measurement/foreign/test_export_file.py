"""Titles, comments, headings, unit rows and footers of exports."""

from pathlib import Path

from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.export_file import ExportFile, read_export


def read(tmp_path: Path, text: str, encoding: str = "utf-8") -> ExportFile:
    path = tmp_path / "export.txt"
    path.write_bytes(text.encode(encoding))
    return read_export(path)


def test_lines_around_the_rows(tmp_path: Path):
    file = read(
        tmp_path,
        "Report of 2 March\n// units mm\n\nname;x;y;;\n;mm;mm;;\n--;--;--;--;--\n"
        "p1;1,5;2,5;;\n\np2;-;3,5;;\n;;;;\n2 points\n",
    )
    assert file.headings == ("name", "x", "y")
    assert file.units == ("", "mm", "mm")
    assert file.records == [["p1", "1,5", "2,5"], ["p2", "-", "3,5"]]
    assert file.lines == (7, 9)
    assert [row.line for row in file.skipped_lines] == [11]
    assert file.comments[:2] == ("Report of 2 March", "// units mm")


def test_first_lines_of_spreadsheets_and_unit_rows_with_dashes(tmp_path: Path):
    file = read(tmp_path, "sep=;\nPoint;x;y;Note\n[-];[mm];[mm];[text]\np1;1,5;2,5;ok\n")
    assert (file.headings, file.units) == (("Point", "x", "y", "Note"), ("", "mm", "mm", ""))


def test_repeated_headings_and_blanks_before_units(tmp_path: Path):
    file = read(tmp_path, "J1 [deg]  J2 [deg]  x [mm]\n1 2 3\n4 5 6\nJ1 [deg]  J2 [deg]  x [mm]\n7 8 9\n")
    assert file.headings == ("J1[deg]", "J2[deg]", "x[mm]")
    assert file.lines == (2, 3, 5)


def test_a_row_of_another_width_is_refused(tmp_path: Path):
    with refused(MeasurementError, line=3, value=2):
        read(tmp_path, "a,b,c\n1,2,3\n4,5\n6,7,8\n")
    with refused(MeasurementError, line=1, value=3) as caught:
        read(tmp_path, "q1_deg,x_mm,y_mm\n1,5,2,5,3,5\n2,5,3,5,4,5\n")
    assert "semicolons" in caught.value.remedy
    with refused(MeasurementError, line=1, value=4):
        read(tmp_path, "j1,j2,x,y\n1,2,3\n4,5,6\n")


def test_a_row_that_a_spreadsheet_could_not_calculate_is_kept(tmp_path: Path):
    assert read(tmp_path, "a,b,c\n1,2,3\n#N/A,5,6\n").lines == (2, 3)
