"""A node that answers moveit_msgs/srv/GetPositionIK with corrected joint values."""

import rclpy
from moveit_msgs.srv import GetPositionIK
from rclpy.node import Node

from pisigma_ros.messages import Arm, answer
from pisigma_ros.pisigma_client import FrameClient


class CorrectedIk(Node):
    """The service `~/compute_ik`."""

    def __init__(self):
        super().__init__("corrected_ik")
        self.declare_parameter("host", "127.0.0.1")
        self.declare_parameter("port", 5006)
        self.declare_parameter("token", "")
        self.declare_parameter("joints", [f"joint_{number}" for number in range(1, 7)])
        self.declare_parameter("base_frame", "base_link")
        self.declare_parameter("model", 0)
        self.declare_parameter("accept_outside_domain", False)
        self.arm = Arm(
            tuple(self._value("joints")),
            self._value("base_frame"),
            self._value("model"),
            self._value("accept_outside_domain"),
        )
        self.client = None
        self.create_service(GetPositionIK, "~/compute_ik", self._serve)

    def _value(self, name):
        return self.get_parameter(name).value

    def _serve(self, request, response):
        return answer(request, response, self.arm, self._solve)

    def _solve(self, *arguments):
        """Ask the server; after a failure, the next request opens a new connection."""
        if self.client is None:
            self.client = FrameClient(self._value("port"), self._value("host"), self._value("token") or None)
        try:
            return self.client.solve(*arguments)
        except OSError:
            self.client.close()
            self.client = None
            raise


def main():
    """Run the node until it is shut down."""
    rclpy.init()
    try:
        rclpy.spin(CorrectedIk())
    finally:
        rclpy.try_shutdown()
