"""Files of controllers are written and read back, and their loss of accuracy is stated."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.identified import geometric_model
from testing.models import joints_around
from testing.refusals import refused

from pisigma.deployment.export.controllers import counts, staubli, universal_robots, ur_ros
from pisigma.deployment.export.controllers.controller_file import (
    FileContent,
    read_controller_file,
    untested_sentence,
)
from pisigma.deployment.export.controllers.ur_models import controller_geometry, without_beta
from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_model
from pisigma.files.errors import OutputError, RobotError
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.robot import Robot
from pisigma.robot.chains import with_one_row_per_joint
from pisigma.robot.kinematics.forward import forward_kinematics

REQUEST = ExportRequest(Path("model"), Path("file"))
BESIDE = {
    "epson": ".csv",
    "fanuc-mastering": ".csv",
    "staubli": ".cfx",
    "ur-calibration": ".conf",
    "ur-ros": ".yaml",
}
COUNTS = {"counts_per_turn": "8388608,-8388608,4194304,1e6,2e6,1e6", "present_counts": "0,5,-7,100,3,9"}


def everything_off(name: str = "ur10", scale: float = 1e-3) -> Robot:
    """A robot with errors in all parameters, with a base and a tool."""
    nominal, random = Robot.load(name), np.random.default_rng(3)
    dh = nominal.dh + random.normal(0, scale, nominal.dh.shape)
    return nominal.with_geometry(dh, random.normal(0, 0.5, 6), random.normal(0, 0.2, 6))


def far_apart(one: Robot, other: Robot) -> float:
    """Largest distance between the tools [m] over the joint ranges."""
    random = np.random.default_rng(1)
    q = torch.from_numpy(random.uniform(-3, 3, (300, one.dof)))
    T, T_other = forward_kinematics(one, q), forward_kinematics(other, q)
    assert_close(T[:, :3, :3], T_other[:, :3, :3], atol=1e-9)
    return float((T - T_other)[:, :3, 3].norm(dim=-1).max())


@pytest.mark.parametrize(
    "file", [universal_robots.FILE, ur_ros.FILE, staubli.FILE], ids=lambda file: file.name
)
@pytest.mark.parametrize("scale", [3e-3, 1e-4, 1e-5])
def test_the_robot_is_read_back(file, scale):
    """The maker's rows have no beta: a tilt of nearly parallel axes makes d large without moving the tool."""
    robot, nominal = everything_off(scale=scale), Robot.load("ur10")
    text = file.text(FileContent(robot, nominal, REQUEST, ("said: a -- b",)))
    assert far_apart(file.read(text, "file", nominal), robot) <= 1e-9
    assert "said: a" in text


@pytest.mark.parametrize("name", ["ur10", "kiro3", "fanuc_r2000"])
def test_rows_are_rewritten_without_moving_the_tool(name):
    robot = everything_off(name)
    few = with_one_row_per_joint(robot)
    assert len(few.rows) == robot.dof
    assert far_apart(few, robot) < 1e-12
    assert few.limits.tolist() == robot.limits.tolist()


def test_a_published_calibration_is_read():
    """DH parameters of a real UR10e and the correction of large d, from the driver's documentation."""
    theta = [-2.4147806894359e-07, 1.60233952386695, -1.68607190752171, 0.0837331147700119]
    a = [
        2.12234865571206e-05,
        0.0193171326277006,
        -0.569251663611088,
        -4.61409023720934e-05,
        -6.39280053471802e-05,
        0,
    ]
    d = [
        0.180539811714259,
        439.140974079901,
        -446.027059806332,
        7.0603368964236,
        0.119811341150314,
        0.115670917257426,
    ]
    alpha = [
        1.57014608044242,
        0.0013941666682559,
        0.00693818880325995,
        1.56998468543761,
        -1.57038520649543,
        0,
    ]
    theta += [-1.01260355871158e-07, 3.91986209186124e-08]
    nominal = ur10e()
    real = np.column_stack([theta, d, a, alpha, np.zeros(6)])
    difference = real - nominal.dh
    text = "[mounting]\n" + "".join(
        f"{key} = {difference[:, column].tolist()} # a remark\n"
        for key, column in universal_robots.KEYS.items()
    )
    robot = universal_robots.read_calibration(text, "calibration.conf", nominal)
    assert far_apart(robot, nominal.with_geometry(real)) < 1e-9
    assert np.abs(robot.dh[:, 1:3]).max() < 0.7
    q = torch.from_numpy(np.random.default_rng(0).uniform(-3, 3, (100, 6)))
    off = (forward_kinematics(robot, q) - forward_kinematics(nominal, q))[:, :3, 3].norm(dim=-1)
    assert 1e-3 < float(off.max()) < 0.02
    again = without_beta(*controller_geometry(nominal).origins(robot))
    assert far_apart(again, robot) < 1e-9
    assert np.abs(again.dh[1:4, 1]).max() > 400


def ur10e() -> Robot:
    """The maker's nominal UR10e, as in the driver's default_kinematics.yaml."""
    nominal = Robot.load("ur10")
    dh = nominal.dh.copy()
    dh[:, 1], dh[:, 2] = (0.1807, 0, 0, 0.17415, 0.11985, 0.11655), (0, -0.6127, -0.57155, 0, 0, 0)
    return nominal.with_geometry(dh)


def test_the_hash_equals_that_of_the_driver():
    """Hash of the default kinematics of the UR10e; see test_universal_robots.py for others."""
    assert ur_ros.calibration_hash(ur10e()) == "calib_5119701370761913513"


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A geometric model of a UR10."""
    folder = tmp_path_factory.mktemp("models") / "arm"
    folder.mkdir()
    save_model(geometric_model("ur10"), folder)
    return folder


@pytest.mark.parametrize("name", BESIDE)
def test_the_loss_of_accuracy_is_stated(name, model, tmp_path):
    out = tmp_path / f"arm{BESIDE[name]}"
    options = COUNTS if out.suffix == ".csv" else {}
    exported = export_model(name, ExportRequest(model, out, **options))
    calibrated, nominal = load_model(model), Robot.load("ur10")
    lost = exported.facts["off_the_whole_model"]
    not_tried = untested_sentence("SOURCE").partition("SOURCE")[2]
    assert any(sentence.endswith(not_tried) for sentence in exported.remarks)
    assert f" {lost['mean_mm']:.4g} mm" in " ".join(out.read_text().split())
    held = read_controller_file(out, nominal, 50.0).robot
    q = joints_around("ur10", 50)
    off = (forward_kinematics(held, q) - calibrated.forward(q))[:, :3, 3].norm(dim=-1)
    if out.suffix == ".csv":  # joint offsets do not explain links
        assert 1e-3 < lost["mean_mm"] < exported.facts["robot_as_drawn"]["mean_mm"]
    else:
        assert lost["max_mm"] < 1e-6
        assert float(off.max()) < 1e-9


def test_counts_are_integers_with_the_stated_resolution(model, tmp_path):
    out = tmp_path / "counts.csv"
    export_model("epson", ExportRequest(model, out, **COUNTS))
    nominal = Robot.load("ur10")
    rows = [line.split(",") for line in out.read_text().splitlines() if line.startswith("joint")]
    per_turn, present, new = ([float(row[i]) for row in rows] for i in (4, 5, 6))
    held = read_controller_file(out, nominal, 50.0).robot
    turns = (held.dh - nominal.dh)[:, 0] / (2 * np.pi)
    assert all(float(count).is_integer() for count in new)
    assert_close(turns, (np.array(present) - new) / per_turn, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        (
            "ur-calibration",
            "[mounting]\n  delta_theta = [0]\ndelta_a = []\ndelta_d=[1]\ndelta_alpha = [2]\nkept = 0x3\n",
        ),
        (
            "staubli",
            '<Arm><Kept a="1"/><DhArray name="dhOffset"><DH index="0"/></DhArray><DhArray name="x"/></Arm>',
        ),
    ],
)
def test_other_content_of_a_controllers_file_is_kept(name, content, model, tmp_path):
    like, out = tmp_path / f"like{BESIDE[name]}", tmp_path / f"new{BESIDE[name]}"
    like.write_text(content)
    export_model(name, ExportRequest(model, out, like=like))
    held, nominal = read_controller_file(out, Robot.load("ur10")).robot, Robot.load("ur10")
    calibrated = load_model(model).calibrated
    assert far_apart(held, calibrated) < 1e-9
    assert ("kept = 0x3" if name == "ur-calibration" else '<Kept a="1"/>') in out.read_text()
    like.write_text("<Arm/>" if name == "staubli" else "[mounting]\n")
    with refused(RobotError, file=str(like)):
        export_model(name, ExportRequest(model, out, like=like))
    with refused(RobotError, file=str(like)):
        read_controller_file(like, nominal)


@pytest.mark.parametrize(
    ("name", "robot", "expected"),
    [
        ("ur-calibration", "kiro3", "6 revolute joints"),
        ("ur-ros", "panda", "6 revolute joints"),
        ("staubli", "panda", "one row per joint"),
    ],
)
def test_robots_that_a_file_cannot_describe(name, robot, expected):
    file = {"ur-calibration": universal_robots, "ur-ros": ur_ros, "staubli": staubli}[name].FILE
    with refused(RobotError, value=robot, expected=expected):
        file.check(Robot.load(robot))


@pytest.mark.parametrize(
    ("suffix", "text", "named"),
    [
        (".conf", "delta_theta = [1, 2, x]", "'delta_theta = .* 6 .*, got 1 "),
        (".conf", "delta_theta = [0, 0, 0, 0, 0, 0]\n" * 2, "'delta_theta = .* 6 .*, got 2 "),
        (".cfx", "<a>", "XML"),
        (".cfx", '<DhArray name="dhOffset"><DH b="1"/></DhArray>', " 6 .*'ur10'.* 1 "),
        (".csv", "part,name\njoint,theta_1\n", "theta_1, theta_2.*, got theta_1"),
        (".yaml", "kinematics:\n  shoulder: {x: 0}\n", "upper_arm"),
        (".yaml", "joints: 3\n", "'joints'"),
        (".txt", "", "'.txt'"),
    ],
)
def test_files_that_are_refused(suffix, text, named, tmp_path):
    path = tmp_path / f"file{suffix}"
    path.write_text(text)
    with pytest.raises(RobotError, match=named):
        read_controller_file(path, Robot.load("ur10"))


@pytest.mark.parametrize("suffix", [".csv", ".yaml"])
def test_tables_of_offsets_are_read(suffix, model, tmp_path):
    out = tmp_path / f"offsets{suffix}"
    exported = export_model("offsets", ExportRequest(model, out))
    held = read_controller_file(out, Robot.load("ur10")).robot
    again = export_model("offsets", ExportRequest(model, out))
    assert exported.facts == again.facts
    off = forward_kinematics(held, joints_around("ur10", 50)) - load_model(model).forward(
        joints_around("ur10", 50)
    )
    assert (
        float(off[:, :3, 3].norm(dim=-1).mean()) * 1e3 < 2 * exported.facts["off_the_whole_model"]["mean_mm"]
    )


@pytest.mark.parametrize(
    ("options", "option", "value"),
    [
        ({}, "--counts-per-turn", None),
        ({"counts_per_turn": "1,2", "present_counts": "1"}, "--counts-per-turn", "1,2"),
        ({**COUNTS, "present_counts": "1,2,3,4,5,x"}, "--present-counts", "1,2,3,4,5,x"),
        ({**COUNTS, "present_counts": "1,2,3,4,5,6.5"}, "--present-counts", "1,2,3,4,5,6.5"),
    ],
)
def test_counts_that_are_refused(options, option, value, model, tmp_path):
    with refused(OutputError, option=option, value=value):
        export_model("fanuc-mastering", ExportRequest(model, tmp_path / "counts.csv", **options))


def test_offsets_of_reversed_joints_are_in_the_controllers_direction():
    nominal = Robot.load("ur10")
    flipped = dataclasses.replace(
        nominal, rows=tuple(dataclasses.replace(row, direction=-1) for row in nominal.rows)
    )
    request = dataclasses.replace(
        REQUEST, counts_per_turn=",".join(["1e9"] * 6), present_counts="0,0,0,0,0,0"
    )
    dh = flipped.dh.copy()
    dh[:, 0] += 0.01
    text = counts.write_counts(FileContent(flipped.with_geometry(dh), flipped, request))
    assert text.splitlines()[1].startswith("joint,theta_1,-0.57")
    assert_close(counts.read_offsets(text, "counts.csv", flipped).dh, dh, atol=1e-8)
