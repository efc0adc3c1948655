"""A lifecycle node that answers desired poses with corrected joint values, as topics and as a MoveIt service."""

import time
from collections import Counter, deque
from dataclasses import replace

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from pisigma_ros.messages import Arm, answer, near_of, solution
from pisigma_ros.server import Server

try:
    from moveit_msgs.srv import GetPositionIK
except ImportError:  # without MoveIt there is no service of its type
    GetPositionIK = None

REQUESTS = QoSProfile(depth=100)
"""Reliable quality of service, so that no request is lost; the depth is sufficient for a short burst."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Quality of service with which robot_state_publisher publishes robot_description."""
PARAMETERS = {
    "host": ("127.0.0.1", "Host of the server."),
    "port": (5006, "Port of the server for binary frames."),
    "json_port": (5005, "Port of the server for lines of JSON."),
    "token": ("", "Token of the server, if it needs one."),
    "timeout": (0.5, "Longest wait for an answer of the server [s]."),
    "model": (0, "Index of the model on the server."),
    "joints": ([""], "Names of the joints in ROS, in the order of the model; by default those of the model."),
    "base_frame": ("", "Frame of the poses; by default that of the calibrated robot_description."),
    "tip_link": ("", "Link that the poses are of; by default the tool of the calibrated robot_description."),
    "accept_outside_domain": (False, "Whether to accept joint values with an extrapolated correction."),
    "joint_states_max_age": (
        1.0,
        "Longest age [s] of the joint_states that solutions of the topic are near to; 0 for solutions near to none.",
    ),
    "diagnostics_period": (1.0, "Time between two diagnostics [s]."),
    "autostart": (True, "Whether to configure and activate the node when it starts."),
}
DYNAMIC = ("accept_outside_domain", "joint_states_max_age")
"""Parameters that may be changed at any time; the others are read when the node is configured."""
CALM_STATES = ("up_to_date", "not_in_cell")
"""States of a cell that need no attention."""


class CorrectedIk(LifecycleNode):
    """The topics `~/desired_pose` and `~/corrected_joints`, and the service `~/compute_ik`."""

    def __init__(self):
        super().__init__("corrected_ik")
        for name, (value, meaning) in PARAMETERS.items():
            self.declare_parameter(name, value, ParameterDescriptor(description=meaning))
        self._server, self._made, self._is_active = None, [], False
        self.add_on_set_parameters_callback(self._on_parameters)

    def _on_parameters(self, changed):
        """Take over parameters that may be changed at any time; refuse the others while the node is configured."""
        values = {one.name: one.value for one in changed}
        fixed = sorted(values.keys() & PARAMETERS.keys() - set(DYNAMIC))
        if self._server is not None and fixed:
            return SetParametersResult(
                successful=False, reason=f"{fixed[0]} is read when the node is configured: clean it up first"
            )
        if self._server is not None:
            accepts = values.get("accept_outside_domain", self._arm.accept_outside_domain)
            self._arm = replace(self._arm, accept_outside_domain=accepts)
            self._max_age = values.get("joint_states_max_age", self._max_age)
        return SetParametersResult(successful=True)

    def on_configure(self, state):
        """Connect to the server, and create topics and services."""
        try:
            self._server = Server(
                *map(self._value, ("host", "port", "json_port")),
                self._value("token") or None,
                self._value("model"),
                self._value("timeout"),
            )
        except (OSError, RuntimeError, LookupError, ValueError) as problem:
            self.get_logger().error(f"The server cannot be used: {problem}")
            return TransitionCallbackReturn.FAILURE
        frames = [
            self._value(name) or found
            for name, found in zip(("base_frame", "tip_link"), self._server.links, strict=True)
        ]
        if not all(frames):
            self.get_logger().error("A URDF cannot describe the model: set base_frame and tip_link")
            self._server.close()
            self._server = None
            return TransitionCallbackReturn.FAILURE
        joints = tuple(filter(None, self._value("joints"))) or tuple(self._server.joints)
        self._arm = Arm(joints, *frames, self._value("model"), self._value("accept_outside_domain"))
        self._max_age = self._value("joint_states_max_age")
        self._joint_states, self._counts, self._durations = None, Counter(), deque(maxlen=1024)
        self._shown = None
        self._create()
        self._server.follow(self._value("diagnostics_period"))
        self.get_logger().info(f"Poses of '{frames[1]}' in '{frames[0]}', joints {', '.join(joints)}")
        return TransitionCallbackReturn.SUCCESS

    def _create(self):
        overriding = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
        self._corrected = self.create_lifecycle_publisher(
            JointState, "~/corrected_joints", REQUESTS, **overriding
        )
        self._description = self.create_lifecycle_publisher(String, "robot_description", LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._made = [
            (self.destroy_lifecycle_publisher, self._corrected),
            (self.destroy_lifecycle_publisher, self._description),
            (self.destroy_publisher, self._diagnostics),
            (
                self.destroy_subscription,
                self.create_subscription(
                    PoseStamped, "~/desired_pose", self._on_pose, REQUESTS, **overriding
                ),
            ),
            (
                self.destroy_subscription,
                self.create_subscription(
                    JointState, "joint_states", self._on_joint_states, qos_profile_sensor_data, **overriding
                ),
            ),
            (self.destroy_timer, self.create_timer(self._value("diagnostics_period"), self._report)),
        ]
        if GetPositionIK is not None:
            service = self.create_service(GetPositionIK, "~/compute_ik", self._on_request)
            self._made.append((self.destroy_service, service))

    def on_activate(self, state):
        """Start to answer requests."""
        self._is_active = True
        result = super().on_activate(state)
        self._report()
        return result

    def on_deactivate(self, state):
        """Stop answering requests."""
        self._is_active, self._shown = False, None
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        """End the connection, and remove topics and services."""
        for destroy, entity in self._made:
            destroy(entity)
        if self._server is not None:
            self._server.close()
        self._server, self._made, self._is_active = None, [], False
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

    def _value(self, name):
        return self.get_parameter(name).value

    def _on_joint_states(self, message):
        self._joint_states = time.monotonic(), message

    def _on_pose(self, wanted):
        """Publish one message for every request, with its time stamp; without positions if there is no solution."""
        if not self._is_active:
            return
        begun = time.perf_counter()
        near, why = self._near()
        name, q = (why, []) if why else solution(wanted, near, self._arm, self._server.solve)
        message = JointState(name=self._arm.joints, position=q)
        message.header.stamp, message.header.frame_id = wanted.header.stamp, self._arm.base_frame
        self._corrected.publish(message)
        self._count(name, begun)

    def _near(self):
        """Return the joint values of joint_states in the order of the model, and why they cannot be used."""
        longest = self._max_age
        if longest <= 0:
            return None, ""
        if self._joint_states is None or time.monotonic() - self._joint_states[0] > longest:
            return None, "START_STATE_INVALID"
        near = near_of(self._joint_states[1], self._arm.joints)
        return near, "" if near is not None else "START_STATE_INVALID"

    def _on_request(self, request, response):
        begun = time.perf_counter()
        if not self._is_active:
            response.error_code.val = response.error_code.FAILURE
            return response
        codes = response.error_code
        answer(request, response, self._arm, self._server.solve)
        self._count("SUCCESS" if codes.val == codes.SUCCESS else f"code {codes.val}", begun)
        return response

    def _count(self, name, begun):
        self._counts[name] += 1
        self._durations.append(time.perf_counter() - begun)
        if name != "SUCCESS":
            self.get_logger().warning(f"A request was refused: {name}", throttle_duration_sec=1.0)

    def _report(self):
        """Publish diagnostics, and the robot_description if it has changed."""
        server = self._server
        if self._is_active and server.urdf and server.urdf != self._shown:
            self._description.publish(String(data=server.urdf))
            self._shown = server.urdf
        status, level = server.status, DiagnosticStatus.OK
        if server.problem:
            level = DiagnosticStatus.ERROR
        elif status["state"] not in CALM_STATES or not self._is_active:
            level = DiagnosticStatus.WARN
        ordered = sorted(self._durations) or [0.0]
        values = {
            **status,
            "active": self._is_active,
            "requests": sum(self._counts.values()),
            **self._counts,
            "p50_us": round(ordered[len(ordered) // 2] * 1e6, 1),
            "p99_us": round(ordered[int(0.99 * (len(ordered) - 1))] * 1e6, 1),
        }
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status.append(
            DiagnosticStatus(
                level=level,
                name=f"{self.get_name()}: corrected joint values",
                message=server.problem or status["reason"] or status["state"],
                hardware_id=status["model"],
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
            )
        )
        self._diagnostics.publish(message)


def main():
    """Run the node until it is shut down."""
    rclpy.init()
    node = CorrectedIk()
    try:
        if node._value("autostart") and node.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            node.trigger_activate()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.on_cleanup(None)
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
