"""URDF, MJCF and DH tables of every robot in MuJoCo, pinocchio, placo, Drake and the Robotics Toolbox for Python."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.aged import original_model
from testing.closeness import assert_close
from testing.outside_arm import ARMS, SIMULATOR

import pisigma
from pisigma.deployment.export.dh_table import dh_csv, dh_json
from pisigma.deployment.export.mjcf import update_mjcf, urdf_to_mjcf
from pisigma.deployment.export.urdf import CALIBRATED_FRAME, CALIBRATED_TOOL, update_urdf
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.writing import BASE_LINK, TOOL_LINK, robot_to_urdf

MODULES = {
    "mujoco": "mujoco",
    "pinocchio": "pinocchio",
    "drake": "pydrake",
    "toolbox": "roboticstoolbox",
    "placo": "placo",
}
TABLES = ("dh", "json")
KINDS = {
    "mujoco": ("urdf", "urdf of a drawing", "mjcf", "mjcf of a drawing", *TABLES),
    "pinocchio": ("urdf", "urdf of a drawing", *TABLES),
    "drake": ("urdf", "urdf of a drawing", "mjcf", *TABLES),
    "toolbox": ("urdf", "urdf of a drawing", *TABLES, "dh without beta"),
    "placo": ("urdf", "urdf of a drawing"),
}
"""Kinds of files by reader; Drake's parser of MJCF leaves out sites, and a `DHRobot` of the toolbox has no beta."""
ENDS = {"urdf": (BASE_LINK, TOOL_LINK), **dict.fromkeys((*TABLES, "dh without beta"), ("base", "tool"))}
"""Names of base and tool by kind, if they are not those of a drawing."""
SUFFIXES = {"urdf": ".urdf", "mjcf": ".xml", "dh": ".csv", "json": ".json"}
POSES = 10


def drawings(folder: Path, repository: Path) -> dict[str, Path]:
    """Draw the catalogue as many files are: links without masses, joints without effort and velocity."""
    made = {}
    for name in sorted(path.stem for path in (repository / "pisigma" / "robot" / "catalogue").glob("*.yaml")):
        text = re.sub(r"(?s)<inertial>.*?</inertial>", "", robot_to_urdf(Robot.load(name)))
        made[name] = folder / f"{name}.urdf"
        made[name].write_text(text.replace('effort="1000" velocity="10"', 'effort="0" velocity="0"'))
    return made | {name: SIMULATOR.parent / f"{name}.urdf" for name in ARMS if SIMULATOR.exists()}


def calibrated(nominal: Robot, random: np.random.Generator) -> Robot:
    dh = nominal.dh + random.normal(0, 1e-3, nominal.dh.shape)
    return nominal.with_geometry(dh, random.normal(0, 0.5, 6), random.normal(0, 0.2, 6))


@pytest.fixture(scope="module")
def robots(tmp_path_factory, repository):
    """Kind of file, calibrated robot, file and joint values."""
    folder, random, made = tmp_path_factory.mktemp("peers"), np.random.default_rng(2), []
    for name, drawing in drawings(folder, repository).items():
        nominal = Robot.load(drawing)
        robot = calibrated(nominal, random)
        without_beta = robot.with_geometry(robot.dh * np.array([1, 1, 1, 1, 0]))
        in_drawing = update_urdf(robot, nominal, drawing)
        path = folder / f"{name}_drawing.xml"
        path.write_text(urdf_to_mjcf(update_urdf(nominal, nominal, drawing))[0])
        texts = {
            "urdf": robot_to_urdf(robot),
            "urdf of a drawing": in_drawing,
            "mjcf": urdf_to_mjcf(in_drawing)[0],
            "mjcf of a drawing": update_mjcf(robot, nominal, path),
            "dh": dh_csv(robot),
            "json": dh_json(robot),
            "dh without beta": dh_csv(without_beta),
        }
        low, high = np.clip(robot.limits, -3.0, 3.0).T
        q = random.uniform(low, high, (POSES, robot.dof))
        for kind, text in texts.items():
            file = folder / f"{name} {kind}{SUFFIXES[kind.split()[0]]}"
            file.write_text(text)
            made.append((kind, without_beta if kind == "dh without beta" else robot, file, q))
    return made


@pytest.mark.parametrize("peer", MODULES)
def test_peers_compute_the_same_poses_and_jacobians(peer, repository, request):
    """They run in the interpreter of PISIGMA_PEERS, so that they need not be compatible with pisigma's packages."""
    python = os.environ.get("PISIGMA_PEERS", sys.executable)
    if subprocess.run([python, "-c", f"import {MODULES[peer]}"], capture_output=True, check=False).returncode:
        pytest.skip(f"{peer} is not installed for {python}; name a Python that has it in PISIGMA_PEERS")
    requests, expected = [], []
    for kind, robot, file, q in request.getfixturevalue("robots"):
        if kind in KINDS[peer]:
            base, tool = ENDS.get(kind, (CALIBRATED_FRAME, CALIBRATED_TOOL))
            requests.append({"file": str(file), "base": base, "tool": tool, "q": q.tolist()})
            expected.append(joint_jacobian(robot, torch.from_numpy(q)))
    script = Path(repository) / "benchmarks" / "urdf_peers.py"
    run = subprocess.run(
        [python, str(script), peer], input=json.dumps(requests), capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    for answer, (T, J) in zip(json.loads(run.stdout), expected, strict=True):
        assert_close(np.array(answer["poses"]), T, atol=1e-9)
        assert_close(np.array(answer["jacobians"]), J, atol=1e-9)


@pytest.mark.parametrize("in_drawing", [False, True])
def test_a_model_in_pinocchio(in_drawing, tmp_path):
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed (pip install pin)")
    model, names = original_model(), (BASE_LINK, TOOL_LINK)
    if in_drawing:
        drawing = tmp_path / "arm.urdf"
        drawing.write_text(robot_to_urdf(model.robot))
        nominal, names = Robot.load(drawing), (CALIBRATED_FRAME, CALIBRATED_TOOL)
        model = replace(model, robot=nominal, calibrated=calibrated(nominal, np.random.default_rng(0)))
    made = pisigma.to_pinocchio(model)
    data, q = made.createData(), torch.from_numpy(np.random.default_rng(1).uniform(-1, 1, (5, 6)))
    base, tool = (made.getFrameId(name) for name in names)
    for values, T in zip(q.numpy(), forward_kinematics(model.calibrated, q), strict=True):
        pinocchio.framesForwardKinematics(made, data, values)
        assert_close((data.oMf[base].inverse() * data.oMf[tool]).homogeneous, T, atol=1e-9)


def test_an_srdf_of_the_drawing_applies_to_the_calibrated_file(tmp_path):
    """Named poses of MoveIt keep their joint values."""
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed (pip install pin)")
    drawing, q = tmp_path / "arm.urdf", np.linspace(-1, 1, 6)
    drawing.write_text(robot_to_urdf(Robot.load("ur10")))
    nominal = Robot.load(drawing)
    states = "".join(
        f'<joint name="{joint.name}" value="{value!r}"/>'
        for joint, value in zip(nominal.joints, q.tolist(), strict=True)
    )
    srdf = f"""<robot name="{nominal.name}"><group name="arm"><chain base_link="{BASE_LINK}" tip_link="{TOOL_LINK}"/>
    </group><group_state name="home" group="arm">{states}</group_state></robot>"""
    model = pinocchio.buildModelFromXML(
        update_urdf(calibrated(nominal, np.random.default_rng(0)), nominal, drawing)
    )
    pinocchio.loadReferenceConfigurationsFromXML(model, srdf)
    assert_close(model.referenceConfigurations["home"], q, atol=0)
