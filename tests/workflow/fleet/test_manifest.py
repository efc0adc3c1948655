"""Cells of a manifest, of a folder with rows, and of a model folder."""

import hashlib

import pytest
from testing.aged import original_model, rows_after_change
from testing.refusals import assert_fields, refused

from pisigma.files.errors import FleetError, MeasurementError, ModelError
from pisigma.model.folder.model_folder import save_model
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.new_cell import NewCell, cell_from_model
from pisigma.workflow.fleet.manifest import new_cells

ANY = NewCell("")


def write(folder, text, files=("a.csv", "b.csv")):
    for name in files:
        (folder / name).write_text(f"rows of {name}\n")
    path = folder / "fleet.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_rows_of_one_id_are_sessions_of_one_cell(tmp_path):
    (tmp_path / "arm.yaml").write_text("name: arm\n", encoding="utf-8")
    (tmp_path / "data").mkdir()
    path = write(
        tmp_path,
        "id,robot,data,date,options\n"
        "b,ur5,b.csv,2026-05-01,free=joint_offsets; model=geometric\n"
        "b,ur5,a.csv,2026-04-01,\n"
        "a,arm.yaml,data/a_20260301.csv,,\n"
        "c,ur10,data/a_20260301.csv,,folds=4\n",
        ("a.csv", "b.csv", "data/a_20260301.csv"),
    )
    made = new_cells(path, tmp_path / "cells", NewCell("", limit_mm=0.3))
    assert (made.created, made.sessions, list(made.refused)) == (2, 3, ["a"])  # a robot file with a fault
    assert [cell.name for cell in made.cells] == ["b", "c"]
    b, c = map(Cell.open, made.cells)
    assert sorted(one.name for one in (b.folder / "sessions").iterdir()) == [
        "2026-04-01.csv",
        "2026-05-01.csv",
    ]
    settings = b.file.settings_of_step("calibrate")
    assert (settings.free, settings.model, settings.folds) == ("joint_offsets", "geometric", 0)
    assert (c.file.settings_of_step("calibrate").folds, c.file.document.limit_mm, c.robot.name) == (
        4,
        0.3,
        "ur10",
    )
    assert c.status().facts.unrecorded_files == ("2026-03-01.csv",)


def test_a_later_call_adds_new_sessions_only(tmp_path):
    out = tmp_path / "cells"
    new_cells(write(tmp_path, "id,data,date\na,a.csv,2026-01-01\n"), out, NewCell("ur5"))
    (out / "a" / "cell.yaml").write_text("robot: ur5\nlimit_mm: 0.2\n")
    both = "id,data,date\na,a.csv,2026-01-01\na,b.csv,2026-02-01\nb,b.csv,2026-02-01\n"
    again = new_cells(write(tmp_path, both), out, NewCell("ur5"))
    assert (again.created, again.sessions) == (1, 2)
    names = [one.name for one in sorted((out / "a" / "sessions").iterdir())]
    assert names == ["2026-01-01.csv", "2026-02-01.csv"]
    assert Cell.open(out / "a").file.document.limit_mm == 0.2
    assert new_cells(tmp_path / "fleet.csv", out, NewCell("ur5")).sessions == 0


def test_cameras_and_boards_are_copied(tmp_path):
    text = (
        "id,robot,data,camera,board\na,ur5,a.csv,wrist.yaml; side.yaml,board.yaml\nb,ur5,b.csv,wrist.yaml,\n"
    )
    files = ("a.csv", "b.csv", "wrist.yaml", "side.yaml", "board.yaml")
    made = new_cells(write(tmp_path, text, files), tmp_path / "cells", ANY)
    (cell,) = map(Cell.open, made.cells)
    assert [path.rpartition("/")[2] for path in cell.cameras.files] == [
        "wrist.yaml",
        "side.yaml",
        "board.yaml",
    ]
    assert "line 3" in made.refused["b"]


def test_a_folder_of_rows(tmp_path):
    rows = tmp_path / "rows"
    for name in ("cell1", "cell2", ".git"):
        (rows / name).mkdir(parents=True)
        (rows / name / "2026-01-01.csv").write_text("rows\n", encoding="utf-8")
    (rows / "cell2" / "robot.yaml").write_text("name: 3\n")
    (rows / "cell3.csv").write_text("rows\n", encoding="utf-8")
    (rows / "notes.txt").write_text("", encoding="utf-8")
    made = new_cells(rows, tmp_path / "cells", NewCell("ur5"))
    assert ([cell.name for cell in made.cells], list(made.refused)) == (["cell1", "cell3"], ["cell2"])
    with refused(FleetError, file="cell1"):
        new_cells(rows, tmp_path / "others", ANY)
    assert not (tmp_path / "others").exists()


@pytest.mark.parametrize(
    ("text", "line", "column", "value"),
    [
        ("id,robot,date\na,ur5,\n", 1, "data", None),
        ("id,robot,data,dats\na,ur5,a.csv,\n", 1, "dats", "dats"),
        ("id;robot;data\na;ur5;a.csv\n", 1, "id;robot;data", None),
        ("id,robot,data\n../a,ur5,a.csv\n", 2, None, "../a"),
        ("id,robot,data\na,ur5,a.csv\nA,ur5,b.csv\n", None, None, "A"),
        ("id,robot,data\na,,a.csv\n", 2, "robot", None),
        ("id,robot,data\na,ur5,\n", 2, "data", None),
        ("id,robot,data\na,ur5\n", 2, None, None),
        ("id,robot,data\na,ur5,c.csv\n", 2, None, None),
        ("id,robot,data,date\na,ur5,a.csv,May\n", 2, "date", "May"),
        ("id,robot,data\na,ur5,a.csv\na,ur5,b.csv\n", 2, None, "a"),
        ("id,robot,data,date\na,ur5,a.csv,2026-01-01\na,ur5,b.csv,2026-01-01\n", 3, None, "2026-01-01"),
        ("id,robot,data,date\na,ur5,a.csv,2026-01-01\na,ur5,./a.csv,2026-02-01\n", 3, None, "2026-02-01"),
        ("id,robot,data\na,ur5,of cell 7.csv\n", 2, None, "of cell 7"),
        ("id,robot,data\nb,ur5,a.csv\nb,ur10,b.csv\n", 2, "robot", "ur10"),
        ("id,robot,data,options\nr,rb5,a.csv,model=neural\n", 2, "options", "neural"),
        ("id,robot,data,options\nr,rb5,a.csv,seed\n", 2, "options", "seed"),
        ("id,robot,data,options\nr,rb5,a.csv,prior_length=1\n", 2, "options", None),
        ("id,robot,data,options\nr,rb5,a.csv,prior_mm=-1\n", 2, "options", None),
    ],
)
def test_faults_of_a_manifest_are_reported_with_line_and_column(tmp_path, text, line, column, value):
    files = ("a.csv", "b.csv", "of cell 7.csv")
    with pytest.raises((FleetError, MeasurementError)) as raised:
        new_cells(write(tmp_path, text, files), tmp_path / "cells", ANY)
    if line is not None:
        assert_fields(raised.value, file="fleet.csv", line=line, column=column)
    if value is not None:
        assert_fields(raised.value, value=value)
    assert not (tmp_path / "cells").exists()


@pytest.mark.parametrize(
    "row", ["r1,rb5,b.csv,May,", "r1,rb5,b.csv", "r1,,b.csv,2026-10-01,", "r1,rb5,b.csv,,seed"]
)
def test_a_bad_row_refuses_only_its_robot(tmp_path, row):
    path = write(tmp_path, f"id,robot,data,date,options\nr0,rb5,a.csv,2026-10-01,\n{row}\n")
    made = new_cells(path, tmp_path / "cells", ANY)
    assert ([cell.name for cell in made.cells], list(made.refused)) == (["r0"], ["r1"])
    assert "fleet.csv, line 3" in made.refused["r1"]


def test_an_empty_folder_is_refused(tmp_path):
    with refused(FleetError, file=str(tmp_path), value="no robot"):
        new_cells(tmp_path, tmp_path / "cells", ANY)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models") / "welder"
    folder.mkdir()
    save_model(original_model(), folder)
    return folder


def test_the_model_of_a_folder_is_put_into_use(tmp_path, model):
    cell_from_model(model, ANY).write(tmp_path / "cell")
    cell = Cell.open(tmp_path / "cell")
    assert cell.history.in_use.name == "welder"
    assert cell.history.in_use.sha256 == hashlib.sha256((model / "model.yaml").read_bytes()).hexdigest()
    assert cell.robot.dh == pytest.approx(original_model().robot.dh)
    assert (cell.status().step.state, cell.history.in_use.made_of) == ("no_plan", ())
    rows_after_change(10, 11).write_csv(tmp_path / "new.csv", cell.robot)
    cell.add_session(tmp_path / "new.csv")
    assert cell.status().step.state == "session_not_judged"


def test_what_is_not_the_model_of_a_robot_is_refused(tmp_path):
    with refused(ModelError):
        cell_from_model(tmp_path, ANY)
