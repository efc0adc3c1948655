"""URDF files that pisigma writes, loaded by MuJoCo, pinocchio and Drake."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.deployment.export.urdf import CALIBRATED_FRAME, CALIBRATED_TOOL, update_urdf
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import BASE_LINK, TOOL_LINK, robot_to_urdf

MODULES = {"mujoco": "mujoco", "pinocchio": "pinocchio", "drake": "pydrake"}


@pytest.mark.parametrize("in_template", [False, True], ids=["a new file", "the file that it was loaded from"])
@pytest.mark.parametrize("peer", MODULES)
@pytest.mark.parametrize("name", ["ur5e", "panda", "kiro3", "fanuc_r2000"])
def test_peers_compute_the_same_tool_pose(peer, name, in_template, tmp_path, repository):
    """They run in the interpreter of PISIGMA_PEERS, so that they need not be compatible with pisigma's packages."""
    python = os.environ.get("PISIGMA_PEERS", sys.executable)
    if subprocess.run([python, "-c", f"import {MODULES[peer]}"], capture_output=True, check=False).returncode:
        pytest.skip(f"{peer} is not installed for {python}; name a Python that has it in PISIGMA_PEERS")
    nominal, file, random = Robot.load(name), tmp_path / "arm.urdf", np.random.default_rng(2)
    if in_template:  # as many files are: links without masses, joints without effort and velocity
        text = re.sub(r"(?s)<inertial>.*?</inertial>", "", robot_to_urdf(nominal))
        file.write_text(text.replace('effort="1000" velocity="10"', 'effort="0" velocity="0"'))
        nominal = Robot.load(file)
    robot = nominal.with_geometry(
        nominal.dh + random.normal(0, 1e-3, nominal.dh.shape),
        random.normal(0, 0.5, 6),
        random.normal(0, 0.2, 6),
    )
    low, high = np.clip(robot.limits, -3.0, 3.0).T
    q = random.uniform(low, high, (100, robot.dof))
    links = (CALIBRATED_FRAME, CALIBRATED_TOOL) if in_template else (BASE_LINK, TOOL_LINK)
    file.write_text(update_urdf(robot, nominal, file) if in_template else robot_to_urdf(robot))
    script = Path(repository) / "benchmarks" / "urdf_peers.py"
    run = subprocess.run(
        [python, str(script), peer, str(file), *links],
        input=json.dumps(q.tolist()),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert_close(np.array(json.loads(run.stdout)), forward_kinematics(robot, torch.from_numpy(q)), atol=1e-9)
