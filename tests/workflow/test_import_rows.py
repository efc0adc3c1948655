"""Import of exports: those of `../shared/exports`, several files, rows without a measurement, units, JSON."""

import os
from pathlib import Path

import pytest
from testing.models import REPOSITORY
from testing.refusals import refused

import pisigma
from pisigma.files.errors import MeasurementError, OutputError
from pisigma.workflow.import_rows import import_rows, propose_import
from pisigma.workflow.settings.importing import ImportSettings

EXPORTS = (
    Path(os.environ.get("PISIGMA_DATA", REPOSITORY / ".." / "shared" / "data")).resolve().parent / "exports"
)
STATED = ImportSettings(units="mm,deg")
HEADER = "name,J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm]"


@pytest.mark.skipif(not EXPORTS.is_dir(), reason="the exports are not here")
@pytest.mark.parametrize(
    ("files", "settings"),
    [
        (("01_semicolon_decimal_comma.csv",), None),
        (("02_tabs_bom.txt",), None),
        (("03_spatial_analyzer_points.txt", "03_joint_log.csv"), ImportSettings(join="point")),
        (
            ("03_joint_log.csv", "03_spatial_analyzer_points.txt"),
            ImportSettings(units="mm,deg", join="point"),
        ),
        (("04_maker_names.csv",), None),
        (("04_maker_names.csv",), STATED),
        (("05_units_in_brackets.csv",), None),
        (("06_utf16.csv",), None),
        (("07_no_units_no_header.txt",), STATED),
        (("08_unit_row_and_note.csv",), None),
    ],
)
def test_exports_become_what_is_expected(
    files: tuple[str, ...], settings: ImportSettings | None, tmp_path: Path
):
    rows = import_rows([EXPORTS / name for name in files], settings)
    rows.save(tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text() == (EXPORTS / "expected.csv").read_text()
    assert (rows.warnings, rows.left_out) == ((), ())
    assert all(file.rows_read == file.rows_used == 24 for file in rows.accounts)


def write(tmp_path: Path, *texts: str) -> list[Path]:
    paths = [tmp_path / f"{number}.csv" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths


def test_rows_without_a_measurement_are_left_out_and_named(tmp_path: Path):
    paths = write(tmp_path, f"{HEADER}\np1,1,2,3,4,5\np2,1,3,,,\np3,1,4,NaN,---,-\np4,1,5,6,7,8\n")
    rows = import_rows(paths)
    assert rows.row_count == 2
    assert [row.line for row in rows.measurement_table.left_out] == [3, 4]
    assert rows.to_json()["left_out"] == [
        {"file": str(paths[0]), "line": line, "reason": "nothing was measured"} for line in (3, 4)
    ]
    with refused(MeasurementError, file="0.csv", line=2, column="z_mm"):
        import_rows(write(tmp_path, f"{HEADER}\np1,1,2,3,4,\np4,1,5,6,7,8\n"))


def test_a_table_in_which_nothing_is_recognised(tmp_path: Path):
    with refused(MeasurementError, file="0.csv"):
        import_rows(write(tmp_path, "Hz,V,D\n100.5,99.2,3.5\n101.5,98.2,3.6\n"))


def test_several_files_are_concatenated(tmp_path: Path):
    paths = write(
        tmp_path, f"{HEADER}\np1,1,2,3,4,5\n", f"{HEADER.replace('mm', 'm')}\np1,1,3,.003,.004,.005\n"
    )
    rows = import_rows(paths)
    assert rows.measurement_table.text().splitlines()[1:] == ["1,2,3,4,5", "1,3,3,4,5"]
    with refused(MeasurementError, file="1.csv"):
        import_rows(write(tmp_path, f"{HEADER}\np1,1,2,3,4,5\n", "name,X [mm],Y [mm],Z [mm]\np1,1,2,3\n"))


def test_a_join_needs_joint_values_and_measurements(tmp_path: Path):
    paths = write(tmp_path, f"{HEADER}\np1,1,2,3,4,5\n", f"{HEADER}\np1,1,2,3,4,5\n")
    with refused(MeasurementError, option="--join", expected="a file without joint values"):
        import_rows(paths, ImportSettings(join="point"))


def test_a_file_given_twice_is_refused(tmp_path: Path):
    (path,) = write(tmp_path, f"{HEADER}\np1,1,2,3,4,5\n")
    with refused(MeasurementError, file="0.csv", remedy="give it once"):
        import_rows([path, path])


def test_a_saved_mapping_states_everything_for_the_next_import(tmp_path: Path):
    paths = write(tmp_path, "j1,j2,x,y,z,note\n1,2,3,4,5,warm\n")
    proposal = propose_import(paths, ImportSettings(units="m,rad"))
    assert not proposal.is_stated
    again = propose_import(
        paths, ImportSettings(maps=({row.heading: row.target.text for row in proposal.mappings[0].columns},))
    )
    assert again.is_stated
    assert import_rows(again).measurement_table.text() == "q1_rad,q2_rad,x_mm,y_mm,z_mm\n1,2,3000,4000,5000\n"


def test_doubtful_units_are_warned_of(tmp_path: Path):
    rows = "".join(f"{i},{170 - i},2,{1200 + i},4,5\n" for i in range(8))
    warnings = pisigma.import_rows(write(tmp_path, f"{HEADER.replace('deg', 'rad')}\n{rows}")).warnings
    assert len(warnings) == 1


def test_an_export_is_not_written_over(tmp_path: Path):
    paths = write(tmp_path, f"{HEADER}\np1,1,2,3,4,5\n")
    with pytest.raises(OutputError):
        import_rows(paths).save(paths[0])
