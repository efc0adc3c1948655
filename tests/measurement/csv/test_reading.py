"""Reading measurement files: units, order of columns, tolerances, and measured robots."""

from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_zyx


@pytest.fixture
def write(tmp_path: Path):
    """Write a file and return its path."""

    def write_file(text: str | bytes) -> Path:
        path = tmp_path / "data.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write_file


def test_units_come_from_the_column_names(write):
    path = write(
        "q1_deg,q2_mm,x_mm,y_mm,z_mm,sigma_mm,sigma_deg,payload_kg,temperature_c\n90,250,1,2,3,0.5,180,4,21\n"
    )
    measurements = Measurements.read_csv(path)
    assert_close(measurements.q, [[np.pi / 2, 0.25]], atol=1e-15)
    assert_close(measurements.position, [[1e-3, 2e-3, 3e-3]])
    assert_close(measurements.sigma_position, [5e-4])
    assert_close(measurements.sigma_rotation, [np.pi], atol=1e-15)
    assert_close(measurements.payload, [4.0])
    assert_close(measurements.temperature, [21.0])


def test_si_units_remain_unchanged(write):
    measurements = Measurements.read_csv(write("q1_rad,q2_m,x_m,y_m,z_m\n1.5,0.25,1,2,3\n"))
    assert_close(measurements.q, [[1.5, 0.25]])
    assert_close(measurements.position, [[1.0, 2.0, 3.0]])


def test_columns_of_a_plan_are_ignored(write):
    rows = "q1_deg,order,x_mm,y_mm,z_mm,candidate\n1,1,1,2,3,17\n1,2,1,2,4,\n"
    plain = "q1_deg,x_mm,y_mm,z_mm\n1,1,2,3\n1,1,2,4\n"
    assert (
        Measurements.read_csv(write(rows)).content_hash()
        == Measurements.read_csv(write(plain)).content_hash()
    )


def test_columns_are_in_any_order(write):
    path = write("set,z_mm,q2_deg,target,x_mm,q1_deg,frame,y_mm\ntrain,3,2,A,1,1,cell,2\n")
    measurements = Measurements.read_csv(path)
    assert_close(measurements.q, np.deg2rad([[1.0, 2.0]]), rtol=1e-15)
    assert_close(measurements.position, [[1e-3, 2e-3, 3e-3]])
    assert (measurements.target, measurements.frame, measurements.split) == (("A",), ("cell",), ("train",))


def test_reads_directions_of_approach(write):
    path = write("q1_rad,q2_rad,x_mm,y_mm,z_mm,approach2\n1,2,0,0,0,1\n1,3,0,0,0,-1\n1,4,0,0,0,\n")
    approach = Measurements.read_csv(path).approach
    assert bool(approach[:, 0].isnan().all())
    assert_close(approach[:2, 1], [1.0, -1.0])
    assert bool(approach[2, 1].isnan())


def test_joints_from_ten_are_sorted_as_numbers(write):
    names = [f"q{number}_rad" for number in range(11, 0, -1)]
    path = write(",".join([*names, "x_mm,y_mm,z_mm"]) + "\n11,10,9,8,7,6,5,4,3,2,1,0,0,0\n")
    assert_close(Measurements.read_csv(path).q, [np.arange(1.0, 12.0)])


def test_reads_roll_pitch_yaw(write):
    measurements = Measurements.read_csv(
        write("q1_deg,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n0,1,2,3,10,20,30\n")
    )
    expected = rotation_from_zyx(torch.deg2rad(torch.tensor([[10, 20, 30]], dtype=torch.float64)))
    assert_close(measurements.rotation, expected, atol=1e-15)
    assert measurements.kinds == {"pose"}


def test_reads_quaternions_and_normalises_them(write):
    measurements = Measurements.read_csv(
        write("q1_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz\n0,1,2,3,0.4004,0.2,0.4,0.8\n")
    )
    expected = rotation_from_quaternion(torch.tensor([[0.2, 0.4, 0.8, 0.4004]], dtype=torch.float64))
    assert_close(measurements.rotation, expected, atol=1e-15)
    assert_close(
        measurements.rotation.mT @ measurements.rotation, torch.eye(3, dtype=torch.float64)[None], atol=1e-14
    )


@pytest.mark.parametrize(
    "text",
    [
        "q1_deg,x_mm,y_mm,z_mm,target\n1,2,3,4,A\n",
        "\ufeffq1_deg,x_mm,y_mm,z_mm,target\n1,2,3,4,A\n",
        "q1_deg,x_mm,y_mm,z_mm,target\r\n1,2,3,4,A\r\n",
        "q1_deg,x_mm,y_mm,z_mm,target\r1,2,3,4,A",
        " q1_deg , x_mm,y_mm\t, z_mm , target\n 1 , 2,3,4 , A \n",
        '"q1_deg", "x_mm",y_mm,z_mm,target\n"1", "2","3",4,"A"\n',
        "# a tracker\n\nq1_deg,x_mm,y_mm,z_mm,target\n  # q1 in degrees\n\n1,2,3,4,A\n  \n",
        "q1_deg,x_mm,y_mm,z_mm,target\n+1.,2e0,3.0E+0,0x4,A\n".replace("0x4", "004"),
    ],
)
def test_tolerates_variants_of_csv(write, text: str):
    measurements = Measurements.read_csv(write(text))
    assert_close(measurements.q, np.deg2rad([[1.0]]), rtol=1e-15)
    assert_close(measurements.position, [[2e-3, 3e-3, 4e-3]])
    assert measurements.target == ("A",)


def test_lines_are_numbered_as_in_an_editor(write):
    path = write("# tracker\n\nq1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n\n# pause\n2,2,3,4\n")
    measurements = Measurements.read_csv(path)
    assert measurements.line == (4, 7)
    assert measurements.place(1) == f"{path}, line 7"


def test_empty_cells_were_not_measured(write):
    path = write(
        "q1_deg,x_mm,y_mm,z_mm,qx,qy,qz,qw,sigma_mm,temperature_c,payload_kg\n"
        "1,,,,0,0,0,1,0.1,,\n"
        "2,1,2,3,,,,,,20,\n"
        "3, , ,,0,0,1,0,,,\n"
    )
    measurements = Measurements.read_csv(path)
    nan = torch.isnan
    assert nan(measurements.position).all(-1).tolist() == [True, False, True]
    assert nan(measurements.rotation).flatten(1).all(-1).tolist() == [False, True, False]
    assert nan(measurements.sigma_position).tolist() == [False, True, True]
    assert nan(measurements.temperature).tolist() == [True, False, True]
    assert measurements.payload is None
    assert_close(measurements.rotation[0], np.eye(3))


def test_repeated_joints_with_other_readings_or_targets_are_measurements(write):
    path = write("q1_deg,x_mm,y_mm,z_mm,target\n1,2,3,4,A\n1,2,3,4,B\n1,2,3,4.01,A\n")
    assert Measurements.read_csv(path).rows == 3


def test_only_what_is_far_outside_a_limit_is_a_fault(write):
    robot = Robot.load("ur10")
    upper = float(robot.limits[0, 1])
    text = "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,x_mm,y_mm,z_mm\n"
    assert Measurements.read_csv(write(f"{text}{upper + 0.7},0,0,0,0,0,1,2,3\n"), robot).rows == 1
    with refused(MeasurementError, line=2, column="q1_rad", value=float(f"{upper + 0.8:.10g}")):
        Measurements.read_csv(write(f"{text}{upper + 0.8},0,0,0,0,0,1,2,3\n"), robot)


def test_leaves_out_rows_on_request_and_states_why(write):
    path = write(
        "q1_deg,q2_deg,q3_mm,q4_deg,x_mm,y_mm,z_mm,sigma_mm,set\n"
        "1,2,-3,4,1,2,3,0.1,train\n"
        "1,2,-3,4,1,2,inf,0.1,train\n"
        "1,2,300,4,1,2,3,0.1,train\n"
        "1,2,-3,4,1,2,3,0.1\n"
        "1,two,-3,4,1,2,3,0.1,train\n"
        "1,2,-3,4,,,,0.1,train\n"
        "1,2,-3,4,1,,3,0.1,train\n"
        "1,2,-3,4,1,2,3,0,train\n"
        "1,2,-3,4,1,2,3,0.1,valid\n"
        '1,2,-3,4,1,2,3,0.1,"train\n'
        "1,2,-4,4,1,2,3,0.1,test\n"
    )
    measurements = Measurements.read_csv(path, Robot.load("kiro3"), on_bad_row="leave_out")
    assert measurements.line == (2, 12)
    assert measurements.split == ("train", "test")
    assert_close(measurements.q[:, 2], [-3e-3, -4e-3])
    assert [left.line for left in measurements.left_out] == list(range(3, 12))
    columns = ["z_mm", "q3_mm", "set", "q2_deg", None, "y_mm", "sigma_mm", "set", None]
    assert [left.fault.column for left in measurements.left_out] == columns
    with refused(MeasurementError, file="data.csv", line=3, column="z_mm") as caught:
        Measurements.read_csv(path, Robot.load("kiro3"))
    assert " 8 more rows " in str(caught.value)


def test_refuses_a_file_without_a_usable_row(write):
    with refused(MeasurementError, line=2, column="q1_deg"):
        Measurements.read_csv(write("q1_deg,x_mm,y_mm,z_mm\nabc,1,2,3\n"), on_bad_row="leave_out")


@pytest.mark.parametrize(
    ("file", "robot", "rows", "kind"),
    [
        ("ur10/series_c_train.csv", "ur10", 1941, "pose"),
        ("ur5/grid.csv", "ur5", 1000, "position"),
        ("fanuc_r2000/positions.csv", None, 720, "position"),
    ],
)
def test_reads_measured_robots(shared_data: Path, file: str, robot: str | None, rows: int, kind: str):
    measurements = Measurements.read_csv(shared_data / file, Robot.load(robot) if robot else None)
    assert (measurements.rows, measurements.dof, measurements.kinds) == (rows, 6, {kind})
    assert measurements.line == tuple(range(2, rows + 2))
    assert measurements.left_out == ()
    table = np.genfromtxt(shared_data / file, delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert_close(measurements.position, np.stack([table[f"{axis}_mm"] for axis in "xyz"], 1) / 1e3)
    assert set(measurements.target) == ({"A", "B", "C"} if "fanuc" in file else {""})
