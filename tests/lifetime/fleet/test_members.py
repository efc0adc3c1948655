"""Manifests and folders of robots, and what is wrong with them."""

import pytest

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
    with pytest.raises(FleetError, match="line 2: the columns 'camera' and 'board' belong together"):
        read_fleet(write(tmp_path, f"{header}a,ur5,a.csv,wrist.yaml,\n"))


def test_a_tree_of_folders_is_a_fleet(tmp_path):
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
    assert "cell1: holds none of robot.yaml" in undescribed.fault
    assert (described.fault, "cell3.csv: holds none" in file.fault) == ("", True)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("id,robot,date\na,ur5,\n", "line 1: column 'data' is missing"),
        ("id,robot,data,dats\na,ur5,a.csv,\n", "line 1: column 'dats' is unknown; did you mean 'date'"),
        (
            "id;robot;data\na;ur5;a.csv\n",
            "line 1, column 'id;robot;data': fields are separated by semicolons",
        ),
        ("id,robot,data\n../a,ur5,a.csv\n", "line 2: '../a' cannot be the id of a robot"),
        ("id,robot,data\na,ur5,a.csv\nA,ur5,b.csv\n", "the ids 'a' and 'A' differ by capitals only"),
        ("id,robot,data\na,,a.csv\n", "line 2: the field 'robot' is empty"),
        ("id,robot,data\na,ur5,\n", "line 2: the field 'data' is empty"),
        ("id,robot,data\na,ur5\n", "line 2: 3 fields were wanted, got 2"),
        (
            "id,robot,data,date\na,ur5,a.csv,May\n",
            "line 2: expected a day from 1970-01-01 to today",
        ),
        ("id,robot,data\na,ur5,a.csv\na,ur5,b.csv\n", "line 2: robot 'a': has several sessions, and not all"),
        ("id,robot,data\na,ur5,x/a.csv\na,ur5,y/a.csv\n", "has two sessions 'a'"),
        (
            "id,robot,data,date\na,ur5,a.csv,2026-01-01\na,ur5,./a.csv,2026-02-01\n",
            "the sessions '2026-01-01' and '2026-02-01' are of the same file 'a.csv'",
        ),
        (
            "id,robot,data\na,ur5,of cell 7.csv\n",
            "the session of 'of cell 7.csv' cannot be called 'of cell 7'",
        ),
        ("id,robot,data\na,ur5,a.csv\na,ur10,b.csv\n", "several different entries in the column 'robot'"),
    ],
)
def test_what_is_wrong_with_a_manifest_is_said_with_its_line(tmp_path, text, complaint):
    with pytest.raises((FleetError, MeasurementError)) as raised:
        read_fleet(write(tmp_path, text))
    assert complaint in str(raised.value)


@pytest.mark.parametrize("file", ["cell1.csv", "Cell1.csv"])
def test_a_folder_and_a_file_of_one_name_are_refused(tmp_path, file):
    (tmp_path / "cell1").mkdir()
    for path in (tmp_path / "cell1" / "2026-03-01.csv", tmp_path / file):
        path.write_text("")
    with pytest.raises(FleetError, match="rename one"):
        read_fleet(tmp_path, "ur5")


def test_an_empty_folder_is_no_fleet(tmp_path):
    with pytest.raises(FleetError, match="holds no robot"):
        read_fleet(tmp_path)
