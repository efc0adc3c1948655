"""Every fault of a measurement file gives one sentence with file, line, column and remedy."""

from pathlib import Path

import pytest

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

POSITION = "x_mm,y_mm,z_mm"

# name: (robot, content, what the message holds besides the file)
CASES: dict[str, tuple[str | None, str | bytes, tuple[str, ...]]] = {
    "empty": (None, "", ("is empty", "a header")),
    "only comments": (None, "# nothing\n\n", ("is empty",)),
    "header only": (None, f"# tracker\nq1_deg,{POSITION}\n", ("line 2", "add one row")),
    "not UTF-8": (
        None,
        f"q1_deg,{POSITION},target\n1,1,2,3,K\xf6rper\n".encode("latin-1"),
        ("line 2", "UTF-8"),
    ),
    "UTF-16": (None, f"q1_deg,{POSITION}\n1,1,2,3\n".encode("utf-16"), ("line 1", "UTF-8")),
    "unknown column": (
        None,
        f"q1_deg,{POSITION},temperatur_c\n",
        ("'temperatur_c'", "'temperature_c'", "sigma_mm"),
    ),
    "misspelt joint": (None, f"q1_deg,q2deg,{POSITION}\n", ("'q2deg'", "did you mean 'q2_deg'", "q2_mm")),
    "capitals": (None, "Q1_DEG,x_mm,y_mm,z_mm\n", ("'Q1_DEG'", "did you mean 'q1_deg'")),
    "joints from zero": (None, f"q0_deg,q1_deg,{POSITION}\n", ("'q0_deg'", "Valid: ")),
    "no header": (None, "0.1,1,2,3\n", ("column 1", "begin the file with the names")),
    "semicolons": (None, "q1_deg;x_mm;y_mm;z_mm\n", ("'q1_deg;x_mm;y_mm;z_mm'", "commas")),
    "nameless column": (None, f"q1_deg,{POSITION},\n", ("column 5", "no name")),
    "broken header": (None, f'q1_deg,{POSITION},"set\n', ("quotes",)),
    "duplicate column": (None, f"q1_deg,x_mm,{POSITION}\n", ("column 'x_mm'", "column 2", "remove")),
    "quantity in two units": (None, f"q1_deg,q1_rad,{POSITION}\n", ("'q1_rad'", "'q1_deg'", "remove")),
    "position in two units": (None, "q1_deg,x_mm,y_mm,z_m\n", ("'z_m'", "is in m", "'x_mm' is in mm")),
    "no joint": (None, f"{POSITION}\n", ("no joint column", "q1_deg or q1_rad")),
    "gap in the joints": (None, f"q1_deg,q3_deg,{POSITION}\n", ("column 'q3_deg'", "add q2_deg")),
    "joints from two": (None, f"q2_rad,q3_rad,{POSITION}\n", ("column 'q2_rad'", "add q1_rad")),
    "mixed angles": (None, f"q1_deg,q2_rad,{POSITION}\n", ("'q2_rad'", "'q1_deg'", "one unit")),
    "mixed strokes": (None, f"q1_mm,q2_deg,q3_m,{POSITION}\n", ("'q3_m'", "'q1_mm'", "one unit")),
    "no position": (None, "q1_deg,qx,qy,qz,qw\n", ("'x_mm' is missing", "x_mm,y_mm,z_mm")),
    "no z": (None, "q1_deg,x_m,y_m\n", ("'z_m' is missing", "x_m,y_m,z_m")),
    "orientation twice": (
        None,
        f"q1_deg,{POSITION},roll_deg,qx,qy,qz,qw\n",
        ("'roll_deg'", "'qw'", "stands twice"),
    ),
    "incomplete angles": (
        None,
        f"q1_deg,{POSITION},roll_deg,yaw_deg\n",
        ("'roll_deg', 'yaw_deg'", "add pitch_deg"),
    ),
    "incomplete quaternion": (None, f"q1_deg,{POSITION},qx,qy\n", ("'qx', 'qy'", "add qz, qw")),
    "approach of no joint": (
        None,
        f"q1_deg,{POSITION},approach2\n1,1,2,3,1\n",
        ("line 1", "column 'approach2'", "q1 to q1"),
    ),
    "too many joints": (
        "kiro3",
        f"q1_deg,q2_deg,q3_mm,q4_deg,q5_deg,{POSITION}\n",
        ("'q5_deg'", "joint 5", "'kiro3' has 4 joints"),
    ),
    "too few joints": (
        "kiro3",
        f"q1_deg,q2_deg,q3_mm,{POSITION}\n",
        ("'q3_mm'", "joint 3", "'kiro3' has 4 joints"),
    ),
    "angle of a slide": (
        "kiro3",
        f"q1_deg,q2_deg,q3_deg,q4_deg,{POSITION}\n",
        ("'q3_deg'", "'d_3'", "prismatic", "give q3_mm or q3_m"),
    ),
    "stroke of a hinge": (
        "kiro3",
        f"q1_deg,q2_m,q3_m,q4_deg,{POSITION}\n",
        ("'q2_m'", "'theta_2'", "revolute", "give q2_deg or q2_rad"),
    ),
}
ROWS = {
    "no number": (None, f"q1_deg,{POSITION}\n1,1,2,3\nabc,1,2,3\n", (3, "column 'q1_deg'", "'abc'", "-12.5")),
    "underscore": (None, f"q1_deg,{POSITION}\n1,1_000,2,3\n", (2, "column 'x_mm'", "'1_000'", "empty")),
    "NaN": (None, f"q1_deg,{POSITION}\n1,1,nan,3\n", (2, "column 'y_mm'", "'nan'", "empty")),
    "infinite": (None, f"q1_deg,{POSITION}\n1,1,2,-inf\n", (2, "column 'z_mm'", "'-inf'", "empty")),
    "too large": (None, f"q1_deg,{POSITION}\n1,1,2,1e999\n", (2, "column 'z_mm'", "'1e999'")),
    "empty joint": (None, f"q1_deg,{POSITION}\n ,1,2,3\n", (2, "column 'q1_deg'", "empty")),
    "too few fields": (None, f"# a\nq1_deg,{POSITION}\n1,1,2\n", (3, "column 'z_mm'", "3 fields", "has 4")),
    "too many fields": (
        None,
        f"q1_deg,{POSITION}\n1,1,2,3,5\n",
        (2, "column 5", "5 fields", "has 4", "decimal point"),
    ),
    "open quote": (None, f'q1_deg,{POSITION},target\n1,1,2,3,"A\n1,2,3,4,B\n', (2, "all columns", "quotes")),
    "bad set": (
        None,
        f"q1_deg,{POSITION},set\n1,1,2,3,trian\n",
        (2, "column 'set'", "'trian'", "train or test"),
    ),
    "empty set": (None, f"q1_deg,{POSITION},set\n1,1,2,3,\n", (2, "column 'set'", "''", "train or test")),
    "zero sigma": (
        None,
        f"q1_deg,{POSITION},sigma_mm\n1,1,2,3,0\n",
        (2, "column 'sigma_mm'", "1e-09 or more was wanted"),
    ),
    "negative sigma": (None, f"q1_deg,{POSITION},sigma_deg\n1,1,2,3,-1\n", (2, "column 'sigma_deg'", "-1")),
    "negative payload": (
        None,
        f"q1_deg,{POSITION},payload_kg\n1,1,2,3,-1\n",
        (2, "column 'payload_kg'", "0 to 2500"),
    ),
    "kelvins": (
        None,
        f"q1_deg,{POSITION},temperature_c\n1,1,2,3,293.2\n",
        (2, "column 'temperature_c'", "293.2", "-50 to 150 deg C", "K - 273.15"),
    ),
    "below absolute zero": (
        None,
        f"q1_deg,{POSITION},temperature_c\n1,1,2,3,20\n2,1,2,3,-400\n",
        (3, "column 'temperature_c'", "-400"),
    ),
    "a joint value that a spreadsheet could not calculate": (
        None,
        f"q1_deg,{POSITION}\n# a note, with, some, commas\n1,1,2,3\n #N/A ,1,2,3\n",
        (4, "column 'q1_deg'", "'#N/A' is no finite number"),
    ),
    "an approach that is none": (
        None,
        f"q1_deg,{POSITION},approach1\n1,1,2,3,0\n",
        (2, "column 'approach1'", "+1", "leave it empty"),
    ),
    "a sigma of nothing": (
        None,
        f"q1_deg,{POSITION},sigma_mm\n1,1,2,3,1e-300\n",
        (2, "column 'sigma_mm'", "1e-300 stands where 1e-09 or more was wanted"),
    ),
    "huge": (
        None,
        f"q1_deg,{POSITION}\n1,1,2,3\n2,1e300,2,3\n",
        (3, "column 'x_mm'", "1e+300 mm is more than can be measured"),
    ),
    "joint without a unit": (None, f"q1,{POSITION}\n1,1,2,3\n", (1, "column 'q1'", "did you mean 'q1_deg'")),
    "nothing measured": (
        None,
        f"q1_deg,{POSITION}\n1,1,2,3\n1,,,\n",
        (3, "'x_mm', 'y_mm', 'z_mm'", "nothing was"),
    ),
    "part of a position": (None, f"q1_deg,{POSITION}\n1,1,,3\n", (2, "column 'y_mm'", "fill all")),
    "part of the angles": (
        None,
        f"q1_deg,{POSITION},roll_deg,pitch_deg,yaw_deg\n1,1,2,3,1,,\n",
        (2, "column 'pitch_deg'", "fill all"),
    ),
    "part of a quaternion": (
        None,
        f"q1_deg,{POSITION},qx,qy,qz,qw\n1,1,2,3,0,0,0,\n",
        (2, "column 'qw'", "fill all"),
    ),
    "long quaternion": (
        None,
        f"q1_deg,{POSITION},qx,qy,qz,qw\n1,1,2,3,0,0,0,1.0011\n",
        (2, "'qx', 'qy', 'qz', 'qw'", "norm 1.0011", "order"),
    ),
    "degrees in a _rad column": (
        "kiro3",
        f"q1_rad,q2_rad,q3_mm,q4_rad,{POSITION}\n0.5,1,-1,0,1,2,3\n30,1,-1,0,1,2,3\n40,1,-1,0,1,2,3\n",
        (
            3,
            "'q1_rad'",
            "30 rad",
            "-3.14159 to 3.14159 rad",
            "'theta_1'",
            "degrees in a _rad",
            "1 more row has",
        ),
    ),
    "millimetres in a _m column": (
        "kiro3",
        f"q1_deg,q2_deg,q3_m,q4_deg,{POSITION}\n30,1,-100,0,1,2,3\n",
        (2, "'q3_m'", "-100 m", "-0.447 to 0 m", "'d_3'", "millimetres in a _m"),
    ),
    "outside a limit": (
        "kiro3",
        f"q1_deg,q2_deg,q3_mm,q4_deg,{POSITION}\n30,-203.001,-100,0,1,2,3\n",
        (2, "'q2_deg'", "-203.001 deg", "-158 to 158 deg", "'theta_2'", "check"),
    ),
}


def message_of(tmp_path: Path, robot: str | None, content: str | bytes) -> str:
    """What reading a file with this content complains of."""
    path = tmp_path / "tracker.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(MeasurementError) as caught:
        Measurements.read_csv(path, Robot.load(robot) if robot else None)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert message.endswith(".")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("case", CASES)
def test_files_and_headers(tmp_path: Path, case: str):
    robot, content, parts = CASES[case]
    if isinstance(content, str) and content.count("\n") == 1:
        content += "1,2,3\n"
        parts = ("line 1", *parts)
    message = message_of(tmp_path, robot, content)
    for part in parts:
        assert part in message


@pytest.mark.parametrize("case", ROWS)
def test_rows(tmp_path: Path, case: str):
    robot, content, (line, *parts) = ROWS[case]
    message = message_of(tmp_path, robot, content)
    assert (
        f"tracker.csv, line {line}, column" in message or f"tracker.csv, line {line}, all columns" in message
    )
    for part in parts:
        assert part in message


@pytest.mark.parametrize("name", ["missing.csv", ""])
def test_missing_file(tmp_path: Path, name: str):
    with pytest.raises(MeasurementError, match=r"cannot be read .*; check the path\.$") as caught:
        Measurements.read_csv(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.usefixtures("without_type_checker")
def test_unknown_way_with_bad_rows(tmp_path: Path):
    with pytest.raises(MeasurementError, match="did you mean 'leave_out'"):
        Measurements.read_csv(tmp_path / "data.csv", on_bad_row="leaveout")
