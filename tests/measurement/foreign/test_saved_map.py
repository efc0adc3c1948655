"""Mappings on a command line and in files."""

from pathlib import Path

from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.saved_map import check_headings_exist, map_for, parse_map


def test_mappings_of_a_command_line():
    assert parse_map("A1=q1_deg, X [mm] =x_mm,note=-") == ({"A1": "q1_deg", "X [mm]": "x_mm", "note": "-"},)
    assert parse_map("X, measured=x_mm,a=b=point") == ({"X, measured": "x_mm", "a=b": "point"},)
    with refused(MeasurementError, option="--map", value="A1=q1_deg,X"):
        parse_map("A1=q1_deg,X")
    with refused(MeasurementError, option="--map", value="A1"):
        parse_map("A1")


def test_mappings_of_a_file(tmp_path: Path):
    path = tmp_path / "map.yaml"
    path.write_text("files:\n- {A1: q1_deg, X: '-'}\n- {name: point, X: x_mm}\n")
    maps = parse_map(str(path))
    assert map_for(maps, ("X", "name")) == maps[1]
    assert map_for(maps, ("A1", "X", "more")) == maps[0]
    assert map_for(maps, ("other",)) == {}
    path.write_text("columns: {}\n")
    with refused(MeasurementError, file=path, line=1, column="columns"):
        parse_map(str(path))


def test_a_heading_that_no_file_has_is_refused():
    check_headings_exist(({"1": "q1_deg", "X": "x_mm"},), [("X", "Y")])
    with refused(MeasurementError, option="--map", value="A1") as caught:
        check_headings_exist(({"A1": "q1_deg"},), [("X", "Y")])
    assert "'X', 'Y'" in caught.value.remedy
