"""Times of round trips of the ROS 2 node over DDS on one machine, alternating with those of an empty node.

Run `python benchmarks/ros_node.py models/my_ur10 --ros ROS_ENVIRONMENT`, where ROS_ENVIRONMENT is a virtual environment
with the wheels of `integrations/ros2/requirements.txt`. Three processes run in it: the node of `pisigma_ros`, an empty
node that answers the same messages with stored joint values, and a client that sends requests to both nodes
alternately, with poses of the model's training rows. The program prints the number of answers that were lost or wrong
compared with Python, the medians of both nodes, and their ratio.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1] / "integrations" / "ros2" / "pisigma_ros"
MAX_WAIT = 2.0
"""[s] An answer that takes longer counts as lost."""
MAX_START = 60.0
"""[s] Longest wait for a node to start or to end."""


def empty_node() -> None:
    """Answer every pose with stored joint values."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.executors import ExternalShutdownException
    from rclpy.node import Node
    from sensor_msgs.msg import JointState

    rclpy.init()
    node = Node("empty")
    publisher = node.create_publisher(JointState, "~/corrected_joints", 100)
    names, stored = [f"joint_{number}" for number in range(1, 7)], [0.0] * 6

    def answer(desired: Any) -> None:
        message = JointState(name=names, position=stored)
        message.header.stamp, message.header.frame_id = desired.header.stamp, "base_link"
        publisher.publish(message)

    node.create_subscription(PoseStamped, "~/desired_pose", answer, 100)
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


class Client:
    """Client that sends a request to a node and waits for the answer with the same time stamp."""

    def __init__(self, node: Any, name: str) -> None:
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import JointState

        self.node, self.got, self.times, self.lost = node, [], [], 0  # type: ignore[var-annotated]
        self.publisher = node.create_publisher(PoseStamped, f"/{name}/desired_pose", 100)
        node.create_subscription(JointState, f"/{name}/corrected_joints", self.got.append, 100)
        self.message = PoseStamped()

    def wait(self) -> None:
        """Wait until the node is available."""
        import rclpy

        end = time.monotonic() + MAX_START
        while self.publisher.get_subscription_count() < 1:
            if time.monotonic() > end:
                raise TimeoutError("the node did not start")
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def ask(self, frame: str, pose: list[float], number: int) -> list[float]:
        """Return the joint values for x, y, z [m] and a quaternion; empty if there are none."""
        import rclpy

        message, place = self.message, self.message.pose
        message.header.frame_id, message.header.stamp.sec = frame, number
        place.position.x, place.position.y, place.position.z = pose[:3]
        turned = place.orientation
        turned.x, turned.y, turned.z, turned.w = pose[3:]
        self.got.clear()
        begun = time.perf_counter()
        self.publisher.publish(message)
        while not self.got and time.perf_counter() - begun < MAX_WAIT:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        self.times.append(time.perf_counter() - begun)
        if len(self.got) != 1 or self.got[0].header.stamp.sec != number:
            self.lost += 1
            return []
        return list(self.got[0].position)


def client(file: Path) -> None:
    """Send requests to both nodes alternately, and print the counts."""
    import rclpy
    from rclpy.node import Node

    work = json.loads(file.read_text())
    rclpy.init()
    node = Node("client")
    nodes = [Client(node, "corrected_ik"), Client(node, "empty")]
    for one in nodes:
        one.wait()
    time.sleep(1.0)
    wrong = 0
    for number in range(work["requests"]):
        index = number % len(work["poses"])
        for one in nodes:
            q = one.ask(work["frame"], work["poses"][index], number)
            if one is nodes[0] and q:
                wrong += max(abs(a - b) for a, b in zip(q, work["expected"][index], strict=True)) > 1e-9
    medians = [sorted(one.times)[len(one.times) // 2] * 1e6 for one in nodes]
    print(
        json.dumps(
            {
                "requests": work["requests"],
                "lost": nodes[0].lost,
                "wrong": wrong,
                "lost_by_empty_node": nodes[1].lost,
                "p50_us": round(medians[0], 1),
                "p50_of_empty_node_us": round(medians[1], 1),
                "ratio": round(medians[0] / medians[1], 3),
            }
        )
    )


def work_of(model: Path, requests: int) -> dict[str, Any]:
    """Return poses as x, y, z [m] and quaternions, and Python's joint values [rad or m] for them."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    import pisigma

    ik = pisigma.load(model)
    starts = ik.model.starts.double().numpy()
    q = starts[np.random.default_rng(0).integers(len(starts), size=1000)]
    T = ik.forward(q)
    solutions = ik(T)
    reached = np.asarray(solutions.status) == 0
    poses = np.concatenate([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()], -1)
    return {
        "requests": requests,
        "frame": "base_link",
        "poses": poses[reached].tolist(),
        "expected": np.asarray(solutions.q)[reached].tolist(),
    }


def main() -> None:
    """Start all processes and print the counts of the client."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path)
    parser.add_argument(
        "--ros", type=Path, required=True, help="Virtual environment with the wheels of ROS 2."
    )
    parser.add_argument("--requests", type=int, default=10000)
    options = parser.parse_args()

    environment = os.environ | {
        "LD_LIBRARY_PATH": str(options.ros / "lib"),
        "PYTHONPATH": str(PACKAGE),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1),
    }
    python = str(options.ros / "bin" / "python")
    command = [sys.executable, "-m", "pisigma", "serve", str(options.model)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True)]
    try:
        ports = json.loads(processes[0].stdout.readline())  # type: ignore[union-attr]
        parameters = {
            "port": ports["binary_port"],
            "json_port": ports["json_port"],
            "base_frame": "base_link",
            "joint_states_max_age": 0.0,
        }
        arguments = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        node = [python, "-m", "pisigma_ros.node", "--ros-args", *arguments]
        processes.append(subprocess.Popen(node, env=environment, text=True))
        processes.append(subprocess.Popen([python, __file__, "empty"], env=environment, text=True))
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "work.json"
            file.write_text(json.dumps(work_of(options.model, options.requests)))
            subprocess.run([python, __file__, "client", str(file)], env=environment, check=True)
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(MAX_START)
            process.kill()


if __name__ == "__main__":
    if sys.argv[1:2] == ["empty"]:
        empty_node()
    elif sys.argv[1:2] == ["client"]:
        client(Path(sys.argv[2]))
    else:
        main()
