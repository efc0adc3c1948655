"""Files of Universal Robots agree with the maker's formula for published values."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.identified import hybrid_model
from testing.published_arms import (
    CALIBRATIONS,
    DRIVERS_UR5,
    DRIVERS_UR5_HASH,
    NOMINAL,
    USERS_DH,
    USERS_DH_HASH,
)
from testing.refusals import refused

from pisigma.deployment.export.controllers import universal_robots, ur_ros
from pisigma.deployment.export.controllers.controller_file import FileContent, read_controller_file
from pisigma.deployment.export.controllers.ur_models import controller_geometry
from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_model
from pisigma.files.errors import PisigmaError, RobotError
from pisigma.files.yaml_writing import yaml_text
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.urdf_frames import frame_of

REQUEST = ExportRequest(Path("model"), Path("file"))
ALPHA = np.array([1, 0, 0, 1, -1, 0]) * np.pi / 2
DELTAS = ("delta_theta", "delta_d", "delta_a", "delta_alpha")


def makers_formula(q: np.ndarray, theta, d, a, alpha) -> np.ndarray:
    """Flange in `base` by the maker's formula: the product of RotZ(q + theta) TransZ(d) TransX(a) RotX(alpha)."""
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for joint in range(6):
        c, s = np.cos(q[:, joint] + theta[joint]), np.sin(q[:, joint] + theta[joint])
        ca, sa = np.full(len(q), np.cos(alpha[joint])), np.full(len(q), np.sin(alpha[joint]))
        zero, one = np.zeros(len(q)), np.ones(len(q))
        rows = (
            (c, -s * ca, s * sa, a[joint] * c),
            (s, c * ca, -c * sa, a[joint] * s),
            (zero, sa, ca, d[joint] * one),
            (zero, zero, zero, one),
        )
        T = T @ np.moveaxis(np.array(rows), -1, 0)
    return T


def with_deltas(name: str, deltas) -> tuple[np.ndarray, ...]:
    """theta, d, a, alpha of a robot with its calibration."""
    d, a, _ = NOMINAL[name]
    theta, *rest = (np.array(deltas[key]) for key in DELTAS)
    return theta, rest[0] + d, rest[1] + a, rest[2] + ALPHA


def deltas_of(text: str) -> dict[str, list[float]]:
    """The four lines of a calibration.conf."""
    return {key: [float(v) for v in re.search(rf"{key} = \[(.*)\]", text)[1].split(",")] for key in DELTAS}


def joint_values(count: int = 1000) -> np.ndarray:
    """Over the whole range of the joints."""
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (count, 6))


def conf(deltas) -> str:
    """The text of a calibration.conf."""
    return "[mounting]\n" + "".join(f"{key} = {list(deltas[key])}\n" for key in DELTAS)


def everything_off(name: str) -> Robot:
    """A nominal arm with errors in all parameters, another base and another tool."""
    nominal, random = Robot.load(name), np.random.default_rng(3)
    dh = nominal.dh + random.normal(0, 1e-3, nominal.dh.shape)
    return nominal.with_geometry(dh, random.normal(0, 0.5, 6), random.normal(0, 0.2, 6))


@pytest.mark.parametrize("case", CALIBRATIONS)
def test_published_calibrations_agree_with_the_makers_formula(case, tmp_path):
    name, deltas = CALIBRATIONS[case]
    path = tmp_path / "calibration.conf"
    path.write_text(conf(deltas))
    reading = read_controller_file(path, Robot.load(name))
    q = joint_values()
    wanted = makers_formula(q, *with_deltas(name, deltas))
    assert_close(forward_kinematics(reading.robot, torch.from_numpy(q)), wanted, atol=1e-9)
    assert 0.5 < reading.deviation_from_nominal.mean_mm < 5
    text = universal_robots.FILE.text(FileContent(reading.robot, reading.robot, REQUEST))
    assert_close(makers_formula(q, *with_deltas(name, deltas_of(text))), wanted, atol=1e-9)


@pytest.mark.parametrize("name", NOMINAL)
def test_written_files_agree_with_the_makers_formula(name):
    """With the base and tool of the file, without fitting a frame."""
    robot, nominal = everything_off(name), Robot.load(name)
    text = universal_robots.FILE.text(FileContent(robot, nominal, REQUEST))
    q = joint_values()
    number = r"(-?[\d.]+(?:e-?\d+)?)"
    frames = []
    for part in ("base", "tool"):
        values = re.search(
            rf"{part}: x_mm {number}, y_mm {number}, z_mm {number}, roll_deg {number}, pitch_deg {number}, "
            rf"yaw_deg {number}",
            text,
        )
        x = np.array([float(v) for v in values.groups()])
        frames.append(frame_of([*x[:3] / 1e3, *np.deg2rad(x[3:])]))
    flange = makers_formula(q, *with_deltas(name, deltas_of(text)))
    assert_close(frames[0] @ flange @ frames[1], forward_kinematics(robot, torch.from_numpy(q)), atol=1e-9)


@pytest.mark.parametrize("file", [universal_robots.FILE, ur_ros.FILE], ids=lambda file: file.name)
@pytest.mark.parametrize("name", NOMINAL)
def test_described_arms_agree_with_the_maker_in_its_frames(name, file):
    """A file of zeros, or the default kinematics, yields the maker's nominal arm in `base` for any description."""
    described, own = Robot.load(name), controller_geometry(Robot.load(name))
    d, a, calib = NOMINAL[name]
    q = joint_values()
    wanted = makers_formula(q, np.zeros(6), d, a, ALPHA)
    text = file.text(FileContent(described, described, REQUEST))
    assert_close(
        forward_kinematics(file.read(text, "file", described), torch.from_numpy(q)),
        forward_kinematics(described, torch.from_numpy(q)),
        atol=1e-9,
    )
    bare = re.sub(r"(?m)^# .*\n", "", text)
    assert_close(
        forward_kinematics(file.read(bare, "file", described), torch.from_numpy(q)), wanted, atol=1e-9
    )
    assert own.model.lower() == name
    turned = name in ("ur3", "ur3e", "ur5e")
    assert_close(own.frames().base_in_pose_frame, [0, 0, 0, np.pi if turned else 0, 0, 0], atol=1e-12)
    assert file is universal_robots.FILE or f"calib_{calib}" in text


def test_the_factory_calibration_meets_the_controllers_poses(shared_data):
    """Poses of weijieyong/UR_kinematics_calib, rounded to 0.01 mm, agree with the maker's formula to 0.080 mm."""
    folder = shared_data / "ur5e_factory"
    robot = read_controller_file(folder / "calibration.conf", Robot.load("ur5e")).robot
    with open(folder / "poses.csv", newline="") as file:
        rows = np.array([[float(cell) for cell in line] for line in list(csv.reader(file))[1:]])
    T = forward_kinematics(robot, torch.from_numpy(np.deg2rad(rows[:, :6]))).numpy()
    off = np.linalg.norm(T[:, :3, 3] * 1e3 - rows[:, 6:9], axis=1)
    assert len(off) == 18
    assert off.max() < 0.085
    assert off.mean() < 0.045
    factory = (folder / "calibration.conf").read_text()
    request = replace(REQUEST, like=folder / "calibration.conf")
    exported = universal_robots.FILE.text(FileContent(robot, robot, request))
    assert re.findall(r"(?m)^joint_.*", exported) == re.findall(r"(?m)^joint_.*", factory)
    for key, values in deltas_of(exported).items():
        # d of joints 2 to 4 is the distance to a point where nearly parallel axes meet: 200 m, with fewer digits
        off = np.array(values) - deltas_of(factory)[key]
        off = np.angle(np.exp(1j * off)) if key == "delta_theta" else off  # a whole turn is no difference
        assert_close(off, np.zeros(6), atol=1e-6 if key == "delta_d" else 1e-9)


def test_a_calibrated_robot_is_written_against_the_makers_nominal_one():
    """A robot read from a file is written with all of its differences from the nominal robot."""
    name, deltas = CALIBRATIONS["ur5 179"]
    read = universal_robots.read_calibration(conf(deltas), "file", Robot.load(name))
    again = universal_robots.FILE.text(FileContent(read, read, REQUEST))
    q = joint_values(100)
    assert_close(
        makers_formula(q, *with_deltas(name, deltas_of(again))),
        makers_formula(q, *with_deltas(name, deltas)),
        atol=1e-9,
    )
    assert_close(deltas_of(again)["delta_d"], deltas["delta_d"], atol=1e-6)


def test_the_hash_equals_that_of_the_driver():
    """Hash of the DH parameters of a user's robot, and of a user's links converted to DH parameters."""
    robot = Robot.load("ur5")
    dh = np.column_stack([*USERS_DH.values(), np.zeros(6)])
    assert ur_ros.calibration_hash(robot.with_geometry(dh)) == USERS_DH_HASH
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    links = {link: dict(zip(keys, values, strict=True)) for link, values in DRIVERS_UR5.items()}
    stated = yaml_text({"kinematics": {**links, "hash": DRIVERS_UR5_HASH}})
    read = ur_ros.read_kinematics(stated, "file", robot)
    written = ur_ros.FILE.text(FileContent(read, robot, REQUEST))
    assert DRIVERS_UR5_HASH in written
    assert_close(
        forward_kinematics(
            ur_ros.read_kinematics(written, "file", robot), torch.from_numpy(joint_values(100))
        ),
        forward_kinematics(read, torch.from_numpy(joint_values(100))),
        atol=1e-9,
    )


def test_positions_of_the_simulated_controller():
    """Two positions of a UR10 in the driver's tests, ur_calibration/test/calibration_test.cpp."""
    q = [
        [
            -1.6007002035724,
            -1.7271001974689,
            -2.202999893819,
            -0.8079999128925,
            1.5951000452042,
            -0.0309999624835,
        ],
        [
            1.3264502286911,
            2.4260077476501,
            5.951572895050,
            1.2740904092789,
            -0.5410521666156,
            0.1221730485559,
        ],
    ]
    wanted = [
        [-0.179925914147547, -0.606869755162764, 0.230789102067257],
        [0.39922988003280424, 0.5968836506534057, -0.6677819040276375],
    ]
    zero = dict.fromkeys(DELTAS, [0.0] * 6)
    robot = universal_robots.read_calibration(conf(zero), "file", Robot.load("ur10"))
    assert_close(forward_kinematics(robot, torch.tensor(q).double())[:, :3, 3], wanted, atol=1e-7)


def test_a_robot_far_from_the_nominal_one_is_refused(tmp_path):
    name, deltas = CALIBRATIONS["ur3 145"]
    path = tmp_path / "calibration.conf"
    path.write_text(conf(deltas | {"delta_a": [0, 0.02, 0, 0, 0, 0]}))
    with refused(RobotError, file="calibration.conf", expected="a mean change of at most 5 mm"):
        read_controller_file(path, Robot.load(name))
    assert read_controller_file(path, Robot.load(name), 50.0).deviation_from_nominal.mean_mm > 5


@pytest.mark.parametrize(
    ("key", "joint", "by"),
    [("delta_theta", 0, 0.1), ("delta_theta", 5, 0.1), ("delta_d", 0, 0.01), ("delta_a", 5, 0.01)],
)
def test_errors_that_a_base_or_tool_could_absorb_are_refused(key, joint, by, tmp_path):
    """Poses are those of the flange in the controller's `base`: no frame is fitted before they are compared."""
    name, deltas = CALIBRATIONS["ur5 179"]
    path, wrong = tmp_path / "calibration.conf", list(deltas[key])
    wrong[joint] += by
    path.write_text(conf(deltas | {key: wrong}))
    with refused(RobotError, file="calibration.conf", expected="a mean change of at most 5 mm"):
        read_controller_file(path, Robot.load(name))


def test_frames_of_a_models_file_are_those_of_the_description(tmp_path):
    """They are not those of the calibration, whose base and tool are stated separately."""
    described = Robot.load("ur5e")
    model = hybrid_model("ur10", [FourierSeries(described, 8)], robot=described)
    base, tool = np.array([1.5, -0.8, 0.2, 0.7, 0.1, 0.2]), np.array([0.03, 0.05, 0.1, 0.3, 0.2, 0.1])
    moved = replace(model, robot=model.robot.with_geometry(base=base, tool=tool))
    folder = tmp_path / "arm"
    folder.mkdir()
    save_model(replace(moved, calibrated=moved.calibrated.with_geometry(base=base, tool=tool)), folder)
    done = export_model("ur-calibration", ExportRequest(folder, tmp_path / "calibration.conf"))
    assert_close(list(done.facts["frames"]["base"].values()), [0, 0, 0, 180, 0, 0], atol=1e-9)
    assert_close(list(done.facts["frames"]["tool"].values()), np.zeros(6), atol=1e-9)


@pytest.mark.parametrize("name", ["rb5", "fanuc_r2000", "kiro4"])
def test_arms_of_other_makers_are_refused(name):
    with pytest.raises(PisigmaError):
        controller_geometry(Robot.load(name))
