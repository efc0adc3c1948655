"""Drives the ROS 2 node from a second process, in the environment of the ROS wheels.

It reads lines of JSON, `[name, arguments]`, calls the method of `Driver` with this name, and prints what it returns
as a line of JSON.
"""

import json
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

MAX_WAIT = 20.0
"""[s] Longest wait for a message or an answer."""


class Driver(Node):
    """A user of the node."""

    def __init__(self):
        super().__init__("driver")
        self.joints, self.diagnostics, self.urdf = [], [], []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(JointState, "/corrected_ik/corrected_joints", self.joints.append, 100)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)
        self.create_subscription(String, "/robot_description", self.urdf.append, latched)
        self.poses = self.create_publisher(PoseStamped, "/corrected_ik/desired_pose", 100)
        self.tracker = self.create_publisher(PoseStamped, "/tracker", 10)
        self.states = self.create_publisher(JointState, "/joint_states", 10)
        self.change = self.create_client(ChangeState, "/corrected_ik/change_state")
        self.get = self.create_client(GetState, "/corrected_ik/get_state")

    def until(self, found, longest=MAX_WAIT):
        end = time.monotonic() + longest
        while not found() and time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.05)
        return found()

    def connect(self):
        """Wait until the node is there in both directions, and return its URDF."""
        self.until(lambda: self.poses.get_subscription_count() and self.states.get_subscription_count())
        self.until(lambda: self.count_publishers("/corrected_ik/corrected_joints"))
        self.until(lambda: self.urdf)
        return self.urdf[-1].data if self.urdf else None

    def pose(self, frame, values, stamp, longest=MAX_WAIT):
        """Return the answer to x, y, z and a quaternion: stamp, frame, names and positions."""
        self.joints.clear()
        self.poses.publish(_stamped(frame, values, stamp))
        self.until(lambda: self.joints, longest)
        return [
            [one.header.stamp.sec, one.header.frame_id, list(one.name), list(one.position)]
            for one in self.joints
        ]

    def near(self, names, positions):
        """Publish joint_states for a moment."""
        for _ in range(5):
            self.states.publish(JointState(name=names, position=positions))
            self.until(lambda: False, 0.02)

    def service(self, frame, values, names, positions, link=""):
        """Return error code, names and positions of the service of MoveIt's type; None if it is not installed."""
        try:
            from moveit_msgs.srv import GetPositionIK
        except ImportError:
            return None
        request = GetPositionIK.Request()
        wanted = request.ik_request
        wanted.pose_stamped, wanted.ik_link_name = _stamped(frame, values, 0), link
        wanted.robot_state.joint_state = JointState(name=names, position=positions)
        done = self._call(self.create_client(GetPositionIK, "/corrected_ik/compute_ik"), request)
        state = done.solution.joint_state
        return [done.error_code.val, list(state.name), list(state.position)]

    def trigger(self, name):
        """Call a service of the recorder, and return whether it succeeded and its message."""
        done = self._call(self.create_client(Trigger, f"/record_session/{name}"), Trigger.Request())
        return [done.success, done.message]

    def measure(self, names, positions, reading):
        """Publish joint_states and a pose of the tracker until a row was recorded."""
        message = PoseStamped()
        message.pose.position.x, message.pose.position.y, message.pose.position.z = reading
        self.until(lambda: self.tracker.get_subscription_count() and self.states.get_subscription_count())
        end, done = time.monotonic() + MAX_WAIT, [False, ""]
        while not done[0] and time.monotonic() < end:
            for _ in range(10):
                self.states.publish(JointState(name=names, position=positions))
                self.tracker.publish(message)
                self.until(lambda: False, 0.01)
            done = self.trigger("take")
        return done

    def report(self, requests):
        """Return level, hardware and values of the first diagnostics after a number of requests."""
        self.diagnostics.clear()

        def last():
            found = [one.status[0] for one in self.diagnostics]
            return [one for one in found if {"requests": str(requests)}.items() <= _values(one).items()]

        status = self.until(last)[0]
        return [status.level[0], status.hardware_id, _values(status)]

    def transition(self, name):
        """Ask for a transition, and return the state afterwards."""
        request = ChangeState.Request()
        request.transition.label = name
        self._call(self.change, request)
        return self._call(self.get, GetState.Request()).current_state.label

    def parameter(self, name, value):
        """Set a parameter of the node, and return whether it was accepted."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        client = self.create_client(SetParameters, "/corrected_ik/set_parameters")
        return self._call(client, request).results[0].successful

    def _call(self, client, request):
        client.wait_for_service(MAX_WAIT)
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self, future, timeout_sec=MAX_WAIT)
        return future.result()


def _stamped(frame, values, stamp):
    message = PoseStamped()
    message.header.frame_id, message.header.stamp.sec = frame, stamp
    for part, names, numbers in (("position", "xyz", values[:3]), ("orientation", "xyzw", values[3:])):
        for name, number in zip(names, numbers, strict=True):
            setattr(getattr(message.pose, part), name, number)
    return message


def _values(status):
    return {one.key: one.value for one in status.values}


if __name__ == "__main__":
    rclpy.init()
    driver = Driver()
    for line in sys.stdin:
        method, arguments = json.loads(line)
        print(json.dumps(getattr(driver, method)(*arguments)), flush=True)
