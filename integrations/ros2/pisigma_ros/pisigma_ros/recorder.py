"""A node that records joint_states and the poses of a tracker as a session of a cell."""

import csv
import datetime
import math
import os
import time
from collections import deque
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pisigma_ros.messages import near_of

PARAMETERS = {
    "cell": ("", "Folder of the cell; the session is written to its folder sessions."),
    "joints": ([""], "Names of the joints in ROS, in the order of the robot of the cell."),
    "prismatic": ([""], "Those of them that are prismatic."),
    "orientation": (False, "Whether the tracker also measures the orientation."),
    "window": (0.5, "Time over which a row is averaged [s]."),
    "still_joints": (1e-4, "Largest range of a joint within the window [rad or m]."),
    "still_tracker": (1e-4, "Largest range of a coordinate of the tracker within the window [m]."),
    "automatic": (False, "Whether a row is recorded whenever the arm stops at another pose."),
}
MIN_SAMPLES = 3
"""Minimum number of messages of each topic within a window."""
MIN_MOTION = 10.0
"""Multiple of `still_joints` by which a joint must differ for the arm to be at another pose."""


class Samples:
    """The latest values of a topic, with the times at which they arrived."""

    def __init__(self, window):
        self._window, self._values = window, deque()

    def add(self, values):
        """Add values that arrived now."""
        now = time.monotonic()
        self._values.append((now, values))
        while self._values[0][0] < now - 2 * self._window:
            self._values.popleft()

    def mean(self, largest, checked):
        """Return the means over the window; None if there are too few messages, or if one of the first values moves.

        Args:
            largest: Largest range of a value that counts as standstill.
            checked: Number of the first values whose range is checked.
        """
        begin = time.monotonic() - self._window
        rows = [values for arrived, values in self._values if arrived >= begin]
        if len(rows) < MIN_SAMPLES:
            return None
        columns = list(zip(*rows, strict=True))
        if any(max(column) - min(column) > largest for column in columns[:checked]):
            return None
        return [math.fsum(column) / len(column) for column in columns]


class Recorder(Node):
    """The services `~/take`, which records a row, and `~/finish`, which adds the session to the cell."""

    def __init__(self):
        super().__init__("record_session")
        for name, (value, meaning) in PARAMETERS.items():
            self.declare_parameter(name, value, ParameterDescriptor(description=meaning, read_only=True))
        self.joints = tuple(filter(None, self._value("joints")))
        cell = Path(self._value("cell"))
        if not (cell / "cell.yaml").is_file() or not self.joints:
            raise SystemExit("expected the parameters cell, a folder with a cell.yaml, and joints")
        self._columns = [
            f"q{number}_{'m' if name in self._value('prismatic') else 'rad'}"
            for number, name in enumerate(self.joints, 1)
        ] + ["x_m", "y_m", "z_m"]
        if self._value("orientation"):
            self._columns += ["qx", "qy", "qz", "qw"]
        self._folder = cell / "sessions"
        self._file, self._rows, self._last = None, 0, None
        self._arm, self._tracker = Samples(self._value("window")), Samples(self._value("window"))
        overriding = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
        qos = qos_profile_sensor_data
        self.create_subscription(JointState, "joint_states", self._on_joints, qos, **overriding)
        self.create_subscription(PoseStamped, "tracker", self._on_tracker, qos, **overriding)
        self.create_service(Trigger, "~/take", self._take)
        self.create_service(Trigger, "~/finish", self._finish)
        if self._value("automatic"):
            self.create_timer(self._value("window") / 2, self._look)

    def _value(self, name):
        return self.get_parameter(name).value

    def _on_joints(self, message):
        values = near_of(message, self.joints)
        if values is not None:
            self._arm.add(values)

    def _on_tracker(self, message):
        p, q = message.pose.position, message.pose.orientation
        sign = -1.0 if q.w < 0 else 1.0  # q and -q are the same rotation, so that they can be averaged
        self._tracker.add([p.x, p.y, p.z, *(sign * value for value in (q.x, q.y, q.z, q.w))])

    def _measured(self):
        """Return joint values and reading of an arm at rest, or the reason why there are none."""
        q = self._arm.mean(self._value("still_joints"), len(self.joints))
        if q is None:
            return None, None, "joint_states are missing or change: wait until the arm does not move"
        reading = self._tracker.mean(self._value("still_tracker"), 3)
        if reading is None:
            return None, None, "the poses of the tracker are missing or change: wait, or look at the tracker"
        length = math.sqrt(math.fsum(value * value for value in reading[3:]))
        if self._value("orientation") and not 0.99 < length < 1.01:
            return None, None, "the tracker states no valid orientation"
        return q, reading[:3] + [value / length for value in reading[3:] if self._value("orientation")], ""

    def _take(self, request, response):
        q, reading, response.message = self._measured()
        if q is not None:
            self._write(q, reading)
            response.success, response.message = True, f"row {self._rows}"
        return response

    def _look(self):
        q, reading, _ = self._measured()
        if q is not None and (
            self._last is None
            or max(abs(a - b) for a, b in zip(q, self._last, strict=True))
            > MIN_MOTION * self._value("still_joints")
        ):
            self._write(q, reading)
            self.get_logger().info(f"Row {self._rows} recorded")

    def _write(self, q, reading):
        """Add a row to the unfinished file, so that no row is lost if the machine fails."""
        if self._file is None:
            self._folder.mkdir(exist_ok=True)
            self._file = self._folder / f"{datetime.datetime.now():%Y-%m-%d-%H%M%S}.csv.unfinished"
        with self._file.open("a" if self._rows else "x", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            if not self._rows:
                table.writerow(self._columns)
            table.writerow([repr(value) for value in (*q, *reading)])
            file.flush()
            os.fsync(file.fileno())
        self._rows, self._last = self._rows + 1, q

    def _finish(self, request, response):
        if not self._rows:
            response.message = "no row was recorded"
            return response
        finished = self._file.with_suffix("")
        os.replace(self._file, finished)
        response.success, response.message = True, str(finished)
        self._file, self._rows, self._last = None, 0, None
        return response


def main():
    """Run the node until it is shut down."""
    rclpy.init()
    try:
        rclpy.spin(Recorder())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
