"""Quantities of columns by headings, by order, as stated; units that are missing or do not fit."""

from pathlib import Path

import pytest
from testing.refusals import assert_fields, refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.conversion import convert_rows
from pisigma.measurement.foreign.export_file import read_export
from pisigma.measurement.foreign.mapping import FileMapping, map_columns, mapping_warnings

ROW = "170,-20,30.5,40,50,60,1200.5,-300,400"


def mapped(
    tmp_path: Path, text: str, stated: dict[str, str] | None = None, rotation: str | None = None, **units: str
) -> FileMapping:
    path = tmp_path / "export.csv"
    path.write_text(text)
    return map_columns(read_export(path), stated or {}, rotation, units)


def targets(mapping: FileMapping) -> list[str]:
    return [column.target.text for column in mapping.columns]


def refusal(tmp_path: Path, text: str, *stated: object, **units: str) -> MeasurementError:
    with refused(MeasurementError) as problem:
        convert_rows(mapped(tmp_path, text, *stated, **units))
    return problem.value


DEGREES_MM = [*(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"]


@pytest.mark.parametrize(
    "header",
    [
        "J1 [deg],J2 [deg],J3 [deg],J4 [deg],J5 [deg],J6 [deg],X [mm],Y [mm],Z [mm]",
        "Joint 1 (°),Joint 2 (°),Joint 3 (°),Joint 4 (°),Joint 5 (°),Joint 6 (°),X (mm),Y (mm),Z (mm)",
        "Axis1/deg,Axis2/deg,Axis3/deg,Axis4/deg,Axis5/deg,Axis6/deg,TCP X in mm,TCP Y in mm,TCP Z in mm",
        "theta_1_deg,theta_2_deg,theta_3_deg,theta_4_deg,theta_5_deg,theta_6_deg,pos_x_mm,pos_y_mm,pos_z_mm",
        "A1,A2,A3,A4,A5,A6,X,Y,Z",
        "S,L,U,R,B,T,X,Y,Z",
        "JT1,JT2,JT3,JT4,JT5,JT6,X,Y,Z",
        "j1,j2,j3,j4,j5,j6,x,y,z\ndeg,deg,deg,deg,deg,deg,mm,mm,mm",
        "# angles: deg, lengths: mm\nj1,j2,j3,j4,j5,j6,x,y,z",
        "# q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm",
        "J0 [deg],J1 [deg],J2 [deg],J3 [deg],J4 [deg],J5 [deg],X Measured [mm],Y Measured [mm],Z Measured [mm]",
    ],
)
def test_headings(tmp_path: Path, header: str):
    assert targets(mapped(tmp_path, f"{header}\n{ROW}\n{ROW}\n")) == DEGREES_MM


def test_units_that_the_file_does_not_state(tmp_path: Path):
    generic = f"j1,j2,j3,j4,j5,j6,x,y,z\n{ROW}\n"
    problem = refusal(tmp_path, generic)
    assert_fields(problem, option="--unit", line=1, column="j1", value="mm,deg")
    assert "'j1=q1_deg'" in problem.remedy
    assert targets(mapped(tmp_path, generic, length="mm", angle="deg")) == DEGREES_MM
    problem = refusal(tmp_path, f"// units m\n{generic}", length="mm")
    assert_fields(problem, option="--unit", value="mm")
    problem = refusal(tmp_path, "j1,j2,x,y,z\n1.5,-2.5,0.5,1.2,3\n1.6,-2.6,0.6,1.2,3\n")
    assert_fields(problem, option="--unit", value="m,rad")
    assert "'j1=q1_rad'" in problem.remedy
    small = "A1,A2,A3,A4,A5,A6,X,Y,Z\n1,-2,0.5,1,2,3,1.2,-0.3,0.4\n"
    # they may as well be rad and m
    assert_fields(refusal(tmp_path, small), option="--unit", column="A1")


def test_a_unit_in_a_heading_that_is_unknown_or_does_not_fit(tmp_path: Path):
    furlongs = ROW.join(("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,X [furlong],Y [mm],Z [mm]\n", "\n"))
    assert_fields(refusal(tmp_path, furlongs, length="mm"), option="--unit", column="X [furlong]")
    assert targets(mapped(tmp_path, furlongs.replace("furlong", "deg")))[6] == "-"
    problem = refusal(tmp_path, furlongs.replace("furlong", "m"), {"X [m]": "x_mm"})
    assert_fields(problem, option="--map", column="X [m]", value="mm")


def test_a_position_is_in_one_unit(tmp_path: Path):
    text = "j1 [deg],j2 [deg],X [m],Y [mm],Z [mm]\n1,2,3,4,5\n"
    assert_fields(refusal(tmp_path, text), line=1, column="Y [mm]", value="mm")
    angles = text.replace("j2 [deg]", "j2 [rad]").replace("[m]", "[mm]")
    assert_fields(refusal(tmp_path, angles), line=1, column="j2 [rad]", value="rad")


def test_stated_columns(tmp_path: Path):
    text = f"a,b,c,d,e,f,u,v,w,note\n{ROW},warm\n{ROW},\n"
    stated = {str(i + 1): name for i, name in enumerate([*DEGREES_MM, "-"])}
    mapping = mapped(tmp_path, text, stated)
    assert targets(mapping) == [*DEGREES_MM, "-"]
    assert all(column.is_stated for column in mapping.columns)
    with refused(MeasurementError, option="--map", value="q1_degg") as caught:
        mapped(tmp_path, text, {"a": "q1_degg"})
    assert "'q1_deg'" in caught.value.remedy
    assert_fields(refusal(tmp_path, text, stated | {"2": "q1_deg"}), line=1, value="q1")


@pytest.mark.parametrize(
    "stated",
    [
        {"A1": "q1_deg"},
        {"A1": "q1_deg", "X": "x_mm", "note": "-"},
        {"A6": "q6_deg", "Y": "y_mm", "Z": "z_mm"},
    ],
)
def test_other_columns_are_proposed_with_stated_ones(tmp_path: Path, stated: dict[str, str]):
    text = f"A1,A2,A3,A4,A5,A6,X,Y,Z,note\n{ROW},warm\n{ROW},\n"
    assert targets(mapped(tmp_path, text, stated, length="mm", angle="deg")) == [*DEGREES_MM, "-"]
    from_zero = text.replace("A1,A2,A3,A4,A5,A6", "axis0,axis1,axis2,axis3,axis4,axis5")
    mapping = mapped(tmp_path, from_zero, {"axis0": "q1_deg"}, length="mm", angle="deg")
    assert targets(mapping) == [*DEGREES_MM, "-"]


def test_equal_headings_are_distinguished_by_their_numbers(tmp_path: Path):
    text = "j1 [deg],j2 [deg],X [mm],Y [mm],Z [mm],X [mm]\n1,2,3,4,5,6\n"
    problem = refusal(tmp_path, text)
    assert_fields(problem, column="X [mm]", value="x")
    assert "'3=-'" in problem.remedy
    assert targets(mapped(tmp_path, text, {"3": "-"}))[2:] == ["-", "y_mm", "z_mm", "x_mm"]


def test_a_name_is_a_better_point_than_a_number(tmp_path: Path):
    text = "No,Name,X [mm],Y [mm],Z [mm]\n1,p7,3,4,5\n2,p8,3,4,6\n"
    assert targets(mapped(tmp_path, text))[:2] == ["-", "point"]


def test_commanded_values_are_not_measurements(tmp_path: Path):
    header = "j1 [deg],j2 [deg],x nom [mm],y nom [mm],z nom [mm],x [mm],y [mm],z [mm]"
    assert targets(mapped(tmp_path, f"{header}\n1,2,3,4,5,6,7,8\n"))[2:] == [
        "-",
        "-",
        "-",
        "x_mm",
        "y_mm",
        "z_mm",
    ]
    header = (
        "Robot.J1 [deg],Robot.J2 [deg],Robot.X,Robot.Y,Robot.Z,Tracker.X [mm],Tracker.Y [mm],Tracker.Z [mm]"
    )
    assert targets(mapped(tmp_path, f"{header}\n1,2,3,4,5,6,7,8\n"))[2:] == [
        "-",
        "-",
        "-",
        "x_mm",
        "y_mm",
        "z_mm",
    ]
    assert not mapped(tmp_path, "j1 [deg],j2 [deg],x nom,y nom,z nom\n1,2,3,4,5\n").has_measured_values


@pytest.mark.parametrize("joints", [6, 7])
def test_files_without_headings(tmp_path: Path, joints: int):
    rows = [" ".join(map(str, [*range(10, 10 + joints), 500.5 + i, 2, 3])) for i in range(3)]
    names = [*(f"q{i + 1}" for i in range(joints)), "x", "y", "z"]
    assert targets(mapped(tmp_path, "\n".join(rows))) == names
    counted = "\n".join(f"{i} {row}" for i, row in enumerate(rows, start=1))
    assert targets(mapped(tmp_path, counted)) == ["point", *names]
    with_quaternion = "\n".join(f"{row} 1 0 0 0" for row in rows)
    assert targets(mapped(tmp_path, with_quaternion, rotation="abb")) == [*names, "qw", "qx", "qy", "qz"]
    with refused(MeasurementError, value=f"{joints + 7} columns without headings"):
        mapped(tmp_path, with_quaternion)


def test_rotations_of_several_makers(tmp_path: Path):
    text = "J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm],A [deg],B [deg],C [deg]\n1,2,3,4,5,6,7,8\n"
    assert_fields(refusal(tmp_path, text), option="--rotation", value="kuka, mitsubishi, doosan")
    assert targets(mapped(tmp_path, text, rotation="mitsubishi"))[5:] == ["yaw_deg", "pitch_deg", "roll_deg"]
    assert targets(mapped(tmp_path, text, rotation="none"))[5:] == ["-", "-", "-"]
    assert targets(mapped(tmp_path, text.replace("J", "A"), length="mm"))[5:] == [
        "roll_deg",
        "pitch_deg",
        "yaw_deg",
    ]
    with refused(MeasurementError, option="--rotation", value="kuca") as caught:
        mapped(tmp_path, text, rotation="kuca")
    assert "'kuka'" in caught.value.remedy


ROTATED = {
    "roll_deg,pitch_deg,yaw_deg": {
        "rpy": ["yaw_deg", "pitch_deg", "roll_deg"],
        "omron": ["omron_roll_deg", "omron_pitch_deg", "omron_yaw_deg"],
    },
    "qx,qy,qz,qw": {"quaternion": ["qx", "qy", "qz", "qw"]},
    "Rx [deg],Ry [deg],Rz [deg]": {"yaskawa": ["yaw_deg", "pitch_deg", "roll_deg"]},
}


@pytest.mark.parametrize("columns", ROTATED)
def test_stated_rotation_is_used_or_refused(tmp_path: Path, columns: str):
    numbers = ",".join(["0"] * columns.count(",") + ["1"])
    for others in ("q1_deg,q2_deg,x_mm,y_mm,z_mm", "J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm]"):
        text = f"{others},{columns}\n1,2,3,4,5,{numbers}\n"
        expected = {**ROTATED[columns], "none": ["-"] * (columns.count(",") + 1)}
        for rotation, names in expected.items():
            assert targets(mapped(tmp_path, text, rotation=rotation))[5:] == names
        with refused(MeasurementError, option="--rotation", value="kuka"):
            mapped(tmp_path, text, rotation="kuka")


def test_roll_has_the_meaning_of_measurement_files_only_in_such_files(tmp_path: Path):
    names = ["roll_deg", "pitch_deg", "yaw_deg"]
    text = f"q1_deg,q2_deg,x_mm,y_mm,z_mm,{','.join(names)}\n1,2,3,4,5,6,7,8\n"
    assert targets(mapped(tmp_path, text))[5:] == names
    for foreign in (text.replace("q", "J"), text.replace("x_mm,y_mm,z_mm", "X mm,Y mm,Z mm")):
        assert_fields(refusal(tmp_path, foreign), option="--rotation", value="rpy, omron")
        assert targets(mapped(tmp_path, foreign, dict(zip(names, names, strict=True))))[5:] == names


def test_rows_that_are_not_a_rotation_are_refused(tmp_path: Path):
    names = ",".join(f"r{i}{k}" for i in (1, 2, 3) for k in (1, 2, 3))
    text = f"q1_deg,q2_deg,x_mm,y_mm,z_mm,{names}\n1,2,3,4,5,1,0,0,0,1,0,0,0,1\n1,2,3,4,5,1,0,0,0,1,0,0,0,2\n"
    assert_fields(refusal(tmp_path, text), line=3, column="r11", value="1, 0, 0, 0, 1, 0, 0, 0, 2")
    rows = convert_rows(mapped(tmp_path, text.replace("1,0,0,0,1,0,0,0,2", ",,,,,,,,")))
    assert rows.cells["qw"] == ("1.0", "")


def test_cells_that_are_not_numbers_are_refused(tmp_path: Path):
    text = f"A1,A2,A3,A4,A5,A6,X,Y,Z\n{ROW}\n{ROW}\n{ROW.replace('30.5', '30.5.1')}\n"
    assert_fields(refusal(tmp_path, text), line=4, column="A3", value="30.5.1")


def test_warnings_of_units_and_external_axes(tmp_path: Path):
    rows = "".join(f"{170 - i},-20,{i}.5,1200.5,{i},400\n" for i in range(8))
    found = mapping_warnings(mapped(tmp_path, f"J1 [rad],J2 [rad],E1 [mm],X [m],Y [m],Z [m]\n{rows}"))
    assert len(found) == 3
    assert "line 1, column 'E1 [mm]': " in found[0]
    assert " 0.5 to 7.5 " in found[0]
    assert "line 2, column 'J1 [rad]': " in found[1]
    assert " 170 rad" in found[1]
    assert " 1200.5 m" in found[2]
    assert not mapping_warnings(mapped(tmp_path, f"J1 [deg],J2 [deg],-,X [mm],Y [mm],Z [mm]\n{rows}"))


@pytest.mark.parametrize(
    ("heading", "cells", "target"),
    [
        ("Bezeichnung", "ab", "point"),
        ("target", "ab", "point"),
        ("Bezeichnung", "aa", "-"),
        ("target", "aa", "target"),
    ],
)
def test_different_names_in_all_rows_are_those_of_points(tmp_path: Path, heading, cells, target):
    rows = "\n".join(f"{cell},{ROW}" for cell in cells)
    assert targets(mapped(tmp_path, f"{heading},{','.join(DEGREES_MM)}\n{rows}"))[0] == target


def test_other_joints_are_named_by_the_maker(tmp_path: Path):
    file = mapped(tmp_path, f"A1,A2,A3,A4,A5,A6,X,Y,Z\n{ROW}", {"A1": "q1_deg", "X": "x_mm"})
    assert targets(file) == DEGREES_MM


@pytest.mark.parametrize(
    "headings",
    [
        "north [mm],east [mm],Z [mm]",
        "north [mm],east [mm],height [mm]",
        "north,east,up",
        "north,east,up,quality",
    ],
)
@pytest.mark.parametrize("left", [0, 1, 2])
def test_of_two_stated_coordinates_the_third_is_proposed(tmp_path: Path, headings: str, left: int):
    text = f"A1 [deg],A2 [deg],{headings}\n" + "1,2,100,200,300,0.1\n2,3,110,210,310,0.2\n"
    text = text if "quality" in headings else text.replace(",0.1", "").replace(",0.2", "")
    names = dict(zip(headings.split(","), ["x_mm", "y_mm", "z_mm"], strict=False))
    stated = {name: one for i, (name, one) in enumerate(names.items()) if i != left}
    assert targets(mapped(tmp_path, text, stated))[2:5] == ["x_mm", "y_mm", "z_mm"]


@pytest.mark.parametrize(
    "stated", [{"7": "x_mm", "8": "y_mm"}, {"7": "x_mm", "9": "z_mm"}, {"2": "q2_deg"}, {"10": "-"}]
)
def test_without_headings_other_columns_follow_the_order(tmp_path: Path, stated: dict[str, str]):
    more = [",0.1", ",0.3"] if "10" in stated else ["", ""]
    text = "".join(f"{ROW}{end}\n" for end in more)
    assert targets(mapped(tmp_path, text, stated, length="mm", angle="deg"))[:9] == DEGREES_MM
    against = mapped(tmp_path, text, {"7": "y_mm", "8": "x_mm"}, length="mm", angle="deg")
    assert not against.has_joints
