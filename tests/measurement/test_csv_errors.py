"""Every fault of a measurement file is refused with file, line, column and value."""

from pathlib import Path

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

POSITION = "x_mm,y_mm,z_mm"

# name: (robot, content, (line, column, value, *names that the remedy lists))
Case = tuple[str | None, str | bytes, tuple[object, ...]]
CASES: dict[str, Case] = {
    "empty": (None, "", (None, None, None)),
    "only comments": (None, "# nothing\n\n", (None, None, None)),
    "header only": (None, f"# tracker\nq1_deg,{POSITION}\n", (2, None, None)),
    "not UTF-8": (
        None,
        f"q1_deg,{POSITION},target\n1,1,2,3,K\xf6rper\n".encode("latin-1"),
        (2, None, "0xf6"),
    ),
    "UTF-16": (None, f"q1_deg,{POSITION}\n1,1,2,3\n".encode("utf-16"), (1, None, "0xff")),
    "unknown column": (
        None,
        f"q1_deg,{POSITION},temperatur_c\n",
        (1, "temperatur_c", "temperatur_c", "temperature_c", "sigma_mm"),
    ),
    "misspelt joint": (None, f"q1_deg,q2deg,{POSITION}\n", (1, "q2deg", "q2deg", "q2_deg", "q2_mm")),
    "capitals": (None, "Q1_DEG,x_mm,y_mm,z_mm\n", (1, "Q1_DEG", "Q1_DEG", "q1_deg")),
    "joints from zero": (None, f"q0_deg,q1_deg,{POSITION}\n", (1, "q0_deg", "q0_deg", "q1_deg")),
    "no header": (None, "0.1,1,2,3\n", (1, 1, "0.1")),
    "semicolons": (None, "q1_deg;x_mm;y_mm;z_mm\n", (1, "q1_deg;x_mm;y_mm;z_mm", "semicolons")),
    "nameless column": (None, f"q1_deg,{POSITION},\n", (1, 5, None)),
    "broken header": (None, f'q1_deg,{POSITION},"set\n', (1, None, 'q1_deg,x_mm,y_mm,z_mm,"set')),
    "duplicate column": (None, f"q1_deg,x_mm,{POSITION}\n", (1, "x_mm", None)),
    "quantity in two units": (None, f"q1_deg,q1_rad,{POSITION}\n", (1, "q1_rad", None)),
    "position in two units": (None, "q1_deg,x_mm,y_mm,z_m\n", (1, "z_m", "m")),
    "no joint": (None, f"{POSITION}\n", (1, None, None, "q1_deg", "q1_rad")),
    "gap in the joints": (None, f"q1_deg,q3_deg,{POSITION}\n", (1, "q3_deg", None)),
    "joints from two": (None, f"q2_rad,q3_rad,{POSITION}\n", (1, "q2_rad", None)),
    "mixed angles": (None, f"q1_deg,q2_rad,{POSITION}\n", (1, "q2_rad", "rad")),
    "mixed strokes": (None, f"q1_mm,q2_deg,q3_m,{POSITION}\n", (1, "q3_m", "m")),
    "no position": (None, "q1_deg,qx,qy,qz,qw\n", (1, "x_mm", None, "x_mm,y_mm,z_mm")),
    "no z": (None, "q1_deg,x_m,y_m\n", (1, "z_m", None, "x_m,y_m,z_m")),
    "orientation twice": (None, f"q1_deg,{POSITION},roll_deg,qx,qy,qz,qw\n", (1, "qx", None)),
    "incomplete angles": (None, f"q1_deg,{POSITION},roll_deg,yaw_deg\n", (1, "roll_deg", None, "pitch_deg")),
    "incomplete quaternion": (None, f"q1_deg,{POSITION},qx,qy\n", (1, "qx", None, "qz", "qw")),
    "approach of no joint": (None, f"q1_deg,{POSITION},approach2\n1,1,2,3,1\n", (1, "approach2", 2)),
    "too many joints": ("kiro3", f"q1_deg,q2_deg,q3_mm,q4_deg,q5_deg,{POSITION}\n", (1, "q5_deg", 5)),
    "too few joints": ("kiro3", f"q1_deg,q2_deg,q3_mm,{POSITION}\n", (1, "q3_mm", 3)),
    "angle of a slide": (
        "kiro3",
        f"q1_deg,q2_deg,q3_deg,q4_deg,{POSITION}\n",
        (1, "q3_deg", "deg", "q3_mm", "q3_m"),
    ),
    "stroke of a hinge": (
        "kiro3",
        f"q1_deg,q2_m,q3_m,q4_deg,{POSITION}\n",
        (1, "q2_m", "m", "q2_deg", "q2_rad"),
    ),
}
ROWS: dict[str, Case] = {
    "no number": (None, f"q1_deg,{POSITION}\n1,1,2,3\nabc,1,2,3\n", (3, "q1_deg", "abc")),
    "underscore": (None, f"q1_deg,{POSITION}\n1,1_000,2,3\n", (2, "x_mm", "1_000")),
    "NaN": (None, f"q1_deg,{POSITION}\n1,1,nan,3\n", (2, "y_mm", "nan")),
    "infinite": (None, f"q1_deg,{POSITION}\n1,1,2,-inf\n", (2, "z_mm", "-inf")),
    "too large": (None, f"q1_deg,{POSITION}\n1,1,2,1e999\n", (2, "z_mm", "1e999")),
    "empty joint": (None, f"q1_deg,{POSITION}\n ,1,2,3\n", (2, "q1_deg", "")),
    "too few fields": (None, f"# a\nq1_deg,{POSITION}\n1,1,2\n", (3, "z_mm", 3)),
    "too many fields": (None, f"q1_deg,{POSITION}\n1,1,2,3,5\n", (2, 5, 5)),
    "open quote": (None, f'q1_deg,{POSITION},target\n1,1,2,3,"A\n1,2,3,4,B\n', (2, None, None)),
    "bad set": (None, f"q1_deg,{POSITION},set\n1,1,2,3,trian\n", (2, "set", "trian")),
    "empty set": (None, f"q1_deg,{POSITION},set\n1,1,2,3,\n", (2, "set", "")),
    "zero sigma": (None, f"q1_deg,{POSITION},sigma_mm\n1,1,2,3,0\n", (2, "sigma_mm", 0.0)),
    "negative sigma": (None, f"q1_deg,{POSITION},sigma_deg\n1,1,2,3,-1\n", (2, "sigma_deg", -1.0)),
    "negative payload": (None, f"q1_deg,{POSITION},payload_kg\n1,1,2,3,-1\n", (2, "payload_kg", -1.0)),
    "kelvins": (
        None,
        f"q1_deg,{POSITION},temperature_c\n1,1,2,3,293.2\n",
        (2, "temperature_c", 293.2, "273.15"),
    ),
    "below absolute zero": (
        None,
        f"q1_deg,{POSITION},temperature_c\n1,1,2,3,20\n2,1,2,3,-400\n",
        (3, "temperature_c", -400.0),
    ),
    "a joint value that a spreadsheet could not calculate": (
        None,
        f"q1_deg,{POSITION}\n# a note, with, some, commas\n1,1,2,3\n #N/A ,1,2,3\n",
        (4, "q1_deg", "#N/A"),
    ),
    "an approach that is none": (None, f"q1_deg,{POSITION},approach1\n1,1,2,3,0\n", (2, "approach1", 0.0)),
    "a sigma of nothing": (None, f"q1_deg,{POSITION},sigma_mm\n1,1,2,3,1e-300\n", (2, "sigma_mm", 1e-300)),
    "huge": (None, f"q1_deg,{POSITION}\n1,1,2,3\n2,1e300,2,3\n", (3, "x_mm", 1e300)),
    "joint without a unit": (None, f"q1,{POSITION}\n1,1,2,3\n", (1, "q1", "q1", "q1_deg")),
    "nothing measured": (
        None,
        f"q1_deg,{POSITION}\n1,1,2,3\n1,,,\n",
        (3, None, None, "x_mm", "y_mm", "z_mm"),
    ),
    "part of a position": (None, f"q1_deg,{POSITION}\n1,1,,3\n", (2, "y_mm", "")),
    "part of the angles": (
        None,
        f"q1_deg,{POSITION},roll_deg,pitch_deg,yaw_deg\n1,1,2,3,1,,\n",
        (2, "pitch_deg", ""),
    ),
    "part of a quaternion": (None, f"q1_deg,{POSITION},qx,qy,qz,qw\n1,1,2,3,0,0,0,\n", (2, "qw", "")),
    "long quaternion": (None, f"q1_deg,{POSITION},qx,qy,qz,qw\n1,1,2,3,0,0,0,1.0011\n", (2, "qx", 1.0011)),
    "degrees in a _rad column": (
        "kiro3",
        f"q1_rad,q2_rad,q3_mm,q4_rad,{POSITION}\n0.5,1,-1,0,1,2,3\n30,1,-1,0,1,2,3\n40,1,-1,0,1,2,3\n",
        (3, "q1_rad", 30.0),
    ),
    "millimetres in a _m column": (
        "kiro3",
        f"q1_deg,q2_deg,q3_m,q4_deg,{POSITION}\n30,1,-100,0,1,2,3\n",
        (2, "q3_m", -100.0),
    ),
    "outside a limit": (
        "kiro3",
        f"q1_deg,q2_deg,q3_mm,q4_deg,{POSITION}\n30,-203.001,-100,0,1,2,3\n",
        (2, "q2_deg", -203.001),
    ),
}


@pytest.mark.parametrize("case", [*CASES, *ROWS])
def test_faults_are_refused(tmp_path: Path, case: str):
    robot, content, (line, column, value, *names) = (CASES | ROWS)[case]
    if case in CASES and isinstance(content, str) and content.count("\n") == 1:
        content += "1,2,3\n"
    path = tmp_path / "tracker.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with refused(MeasurementError, file=path, line=line, column=column, value=value) as caught:
        Measurements.read_csv(path, Robot.load(robot) if robot else None)
    assert "\n" not in str(caught.value)
    assert all(str(name) in caught.value.remedy for name in names)


def test_further_faults_are_counted(tmp_path: Path):
    path = tmp_path / "tracker.csv"
    path.write_text(f"q1_deg,{POSITION}\nabc,1,2,3\n1,1,2,3\n2,def,2,3\n3,1,2,ghi\n")
    with refused(MeasurementError, line=2, column="q1_deg", value="abc") as caught:
        Measurements.read_csv(path)
    assert " 2 more rows " in str(caught.value)


@pytest.mark.parametrize("name", ["missing.csv", ""])
def test_missing_file(tmp_path: Path, name: str):
    with refused(MeasurementError, file=tmp_path / name, line=None):
        Measurements.read_csv(tmp_path / name)


@pytest.mark.usefixtures("without_type_checker")
def test_an_unknown_choice_for_bad_rows_is_refused(tmp_path: Path):
    with refused(MeasurementError, option="on_bad_row", value="leaveout") as caught:
        Measurements.read_csv(tmp_path / "data.csv", on_bad_row="leaveout")
    assert "leave_out" in caught.value.remedy
