"""Manifests and folders of robots, and their faults."""

import pytest
from testing.refusals import assert_fields, refused

from pisigma.files.errors import FleetError, MeasurementError
from pisigma.lifetime.fleet.members import read_fleet
from pisigma.workflow.fleet.one_robot import settings_for
from pisigma.workflow.settings.fleet import FleetSettings


def write(folder, text):
    path = folder / "fleet.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_rows_of_one_id_are_sessions_of_one_robot(tmp_path):
    (tmp_path / "arm.yaml").write_text("", encoding="utf-8")
    path = write(
        tmp_path,
        "id,robot,data,date,options\n"
        "b,ur5,b2.csv,2026-05-01,free=joint_offsets; model=geometric\n"
        "b,ur5,b1.csv,2026-04-01,\n"
        "a,arm.yaml,data/a_20260301.csv,,\n",
    )
    a, b = read_fleet(path)
    assert (a.id, a.robot, a.sessions[0].date) == ("a", str(tmp_path / "arm.yaml"), "2026-03-01")
    assert a.sessions[0].data == tmp_path / "data" / "a_20260301.csv"
    assert [one.name for one in b.sessions] == ["2026-04-01", "2026-05-01"]
    assert b.options == (("free", "joint_offsets"), ("model", "geometric"))


def test_cameras_and_boards_of_corners(tmp_path):
    header = "id,robot,data,camera,board\n"
    a, b = read_fleet(
        write(tmp_path, f"{header}a,ur5,a.csv,wrist.yaml; beside.yaml,board.yaml\nb,ur5,b.csv,,\n")
    )
    assert a.cameras is not None
    wrist, beside, board = (str(tmp_path / name) for name in ("wrist.yaml", "beside.yaml", "board.yaml"))
    assert a.cameras.files == (wrist, beside, board)
    assert settings_for(FleetSettings(), a).cameras == a.cameras
    assert b.cameras is None
    with refused(FleetError, file="fleet.csv", line=2, column="board"):
        read_fleet(write(tmp_path, f"{header}a,ur5,a.csv,wrist.yaml,\n"))


def test_a_fleet_of_folders(tmp_path):
    for name in ("cell1", "cell2", ".git"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "2026-01-01.csv").write_text("", encoding="utf-8")
    (tmp_path / "cell2" / "robot.yaml").write_text("", encoding="utf-8")
    (tmp_path / "cell3.csv").write_text("", encoding="utf-8")
    (tmp_path / "notes.txt").write_text("", encoding="utf-8")
    members = read_fleet(tmp_path, "ur5")
    assert [(one.id, one.robot) for one in members] == [
        ("cell1", "ur5"),
        ("cell2", str(tmp_path / "cell2" / "robot.yaml")),
        ("cell3", "ur5"),
    ]
    undescribed, described, file = read_fleet(tmp_path)
    assert_fields(undescribed.error, file="cell1")
    assert (described.fault, described.error) == ("", None)
    assert_fields(file.error, file="cell3.csv")


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
        ("id,robot,data\na,ur5\n", 2, None, 2),
        ("id,robot,data,date\na,ur5,a.csv,May\n", 2, "date", "May"),
        ("id,robot,data\na,ur5,a.csv\na,ur5,b.csv\n", 2, None, "a"),
        ("id,robot,data\na,ur5,x/b.csv\na,ur5,y/b.csv\n", 2, None, "b"),
        (
            "id,robot,data,date\na,ur5,a.csv,2026-01-01\na,ur5,./a.csv,2026-02-01\n",
            2,
            None,
            "a.csv",
        ),
        ("id,robot,data\na,ur5,of cell 7.csv\n", 2, None, "of cell 7"),
        ("id,robot,data\nb,ur5,a.csv\nb,ur10,b.csv\n", 2, "robot", "b"),
    ],
)
def test_faults_of_a_manifest_are_reported_with_line_and_column(tmp_path, text, line, column, value):
    with pytest.raises((FleetError, MeasurementError)) as raised:
        read_fleet(write(tmp_path, text))
    assert_fields(raised.value, file="fleet.csv", line=line, column=column)
    if value is not None:
        assert_fields(raised.value, value=value)


@pytest.mark.parametrize("file", ["cell1.csv", "Cell1.csv"])
def test_a_folder_and_a_file_of_one_name_are_refused(tmp_path, file):
    (tmp_path / "cell1").mkdir()
    for path in (tmp_path / "cell1" / "2026-03-01.csv", tmp_path / file):
        path.write_text("")
    with refused(FleetError) as caught:
        read_fleet(tmp_path, "ur5")
    assert caught.value.value.casefold() == "cell1"


def test_an_empty_folder_is_refused(tmp_path):
    with refused(FleetError, file=str(tmp_path), value="no robot"):
        read_fleet(tmp_path)
