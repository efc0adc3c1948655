"""The ROS 2 node, launched in the environment of the ROS wheels and driven over DDS by a second process."""

import json
import os
import subprocess
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close
from testing.serving import running

import pisigma

ROS = Path(os.environ.get("PISIGMA_ROS", "missing"))
"""A virtual environment with the wheels of integrations/ros2/requirements.txt."""
pytestmark = pytest.mark.skipif(
    not (ROS / "lib" / "librcl.so").exists(),
    reason="PISIGMA_ROS is not an environment with the wheels of ROS 2",
)
DRIVER = Path(__file__).parent / "ros_driver.py"
JOINTS = [f"theta_{number}" for number in range(1, 7)]


@contextmanager
def started(repository, *arguments):
    """Start Python with the ROS wheels, and end it."""
    environment = os.environ | {
        "LD_LIBRARY_PATH": str(ROS / "lib"),
        "PYTHONPATH": str(repository / "integrations" / "ros2" / "pisigma_ros"),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1),
    }
    command = [str(ROS / "bin" / "python"), *map(str, arguments)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, env=environment, text=True, **pipes) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.communicate(timeout=30)
            finally:
                process.kill()  # a node that does not end fails its test and does not block the others


def node(repository, server, **parameters):
    ports = {"port": server.binary_port, "json_port": server.json_port, "diagnostics_period": 0.2}
    words = [word for name, value in (ports | parameters).items() for word in ("-p", f"{name}:={value}")]
    return started(repository, "-m", "pisigma_ros.node", "--ros-args", *words)


@contextmanager
def driver(repository):
    with started(repository, DRIVER) as process:

        def ask(method, *arguments):
            process.stdin.write(json.dumps([method, arguments]) + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield ask


def test_a_session_is_recorded_into_a_cell(repository, tmp_path):
    cell = pisigma.Cell.create(tmp_path / "cell", "ur10")
    joints = [f"joint_{number}" for number in range(1, 7)]
    words = ["-p", f"cell:={cell.folder}", "-p", f"joints:=[{', '.join(joints)}]", "-p", "window:=0.3"]
    recorder = started(repository, "-m", "pisigma_ros.recorder", "--ros-args", *words)
    rows = [([0.1 * number + row for number in range(6)], [0.5, 0.1 * row, 0.7]) for row in range(2)]
    with recorder, driver(repository) as ask:
        assert ask("trigger", "finish")[0] is False
        assert ask("trigger", "take")[0] is False
        for q, reading in rows:
            assert ask("measure", joints[::-1], q[::-1], reading)[0] is True
        done, file = ask("trigger", "finish")
    data = pisigma.Measurements.read_csv(file)
    assert done
    assert Path(file).parent == cell.folder / "sessions"
    assert_close(data.q, [q for q, _ in rows], atol=1e-12)
    assert_close(data.position, [reading for _, reading in rows], atol=1e-12)
    assert cell.status().step.state == "not_taken_in"


def test_poses_are_answered_with_corrected_joints(repository):
    model = repository / "models" / "kiro4"
    ik = pisigma.load(model)
    near = ik.model.starts[3].double().numpy()
    T = ik.forward(near)
    pose = [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist()]
    far, skew = [9.0, *pose[1:]], [*pose[:3], 2.0, 2.0, 2.0, 2.0]
    with (
        running(model) as server,
        node(repository, server),
        driver(repository) as ask,
    ):
        joints = ElementTree.fromstring(ask("connect")).iterfind("joint")
        assert [one.get("name") for one in joints if one.get("type") != "fixed"] == JOINTS
        assert ask("pose", "base_link", pose, 1) == [[1, "base_link", JOINTS, []]]  # no joint_states yet
        assert ask("parameter", "joint_states_max_age", 60.0) is True
        assert ask("parameter", "port", 1) is False
        ask("near", JOINTS[::-1], near[::-1].tolist())
        ((stamp, frame, names, q),) = ask("pose", "base_link", pose, 2)
        assert (stamp, frame, names) == (2, "base_link", JOINTS)
        assert_close(q, ik(T, near=near).q, atol=1e-9)
        for number, (frame, values) in enumerate(
            (("world", pose), ("base_link", far), ("base_link", skew)), 3
        ):
            assert ask("pose", frame, values, number) == [[number, "base_link", JOINTS, []]]
        by_service = ask("service", "base_link", pose, JOINTS, near.tolist(), "tool0")
        if by_service is not None:  # tests/integrations/build_messages.py was run
            assert by_service == [1, JOINTS, q]
            assert ask("service", "base_link", pose, JOINTS, near.tolist(), "flange") == [-18, [], []]
        level, hardware, values = ask("report", 5 + 2 * (by_service is not None))
        assert (level, hardware, values["model"]) == (0, "kiro4", "kiro4")
        assert values["SUCCESS"] == ("1" if by_service is None else "2")
        assert [values[name] for name in ("FRAME_TRANSFORM_FAILURE", "INVALID_GOAL_CONSTRAINTS")] == [
            "1",
            "1",
        ]
        assert np.isfinite(float(values["p50_us"]))
        assert ask("transition", "deactivate") == "inactive"
        assert ask("pose", "base_link", pose, 9, 0.3) == []
        for transition, state in (
            ("cleanup", "unconfigured"),
            ("configure", "inactive"),
            ("activate", "active"),
        ):
            assert ask("transition", transition) == state
        ask("connect")
        ask("near", JOINTS, near.tolist())
        assert ask("pose", "base_link", pose, 9) == [[9, "base_link", JOINTS, q]]
        server.stop()
        ask("near", JOINTS, near.tolist())
        assert ask("pose", "base_link", pose, 10) == [[10, "base_link", JOINTS, []]]
        assert ask("report", 2)[0] == 2
