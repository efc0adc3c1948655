"""Conversion between MoveIt messages and the server, without ROS.

Messages are those of moveit_msgs/srv/GetPositionIK, or any objects with the same fields.
"""

import math
from dataclasses import dataclass

REACHED, OUTSIDE_JOINT_LIMITS, OUTSIDE_DOMAIN, INVALID_POSE = 0, 2, 3, 6
"""Statuses of the server, see its protocol."""
CONSTRAINTS = ("joint", "position", "orientation", "visibility")
"""Kinds of constraints of a moveit_msgs/Constraints."""


@dataclass(frozen=True)
class Arm:
    """The arm that the messages refer to.

    Attributes:
        joints: Names of the joints in ROS, in the order of the model.
        base_frame: Name in ROS of the frame of the model's poses.
        tip_link: Name in ROS of the link that the poses are of.
        model: Index of the model on the server.
        accept_outside_domain: Whether to accept joint values with an extrapolated correction.
    """

    joints: tuple[str, ...]
    base_frame: str
    tip_link: str = ""
    model: int = 0
    accept_outside_domain: bool = False


def matrix_of(pose):
    """Return the 16 numbers, row by row, of a geometry_msgs/Pose; NaN if its quaternion is invalid."""
    q, p = pose.orientation, pose.position
    norm = math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
    if not 0.99 < norm < 1.01:
        return [math.nan] * 16
    x, y, z, w = q.x / norm, q.y / norm, q.z / norm, q.w / norm
    return [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), p.x),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), p.y),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), p.z),
        *(0.0, 0.0, 0.0, 1.0),
    ]


def near_of(joint_state, joints):
    """Return joint values of a sensor_msgs/JointState in the order of `joints`; None if one is missing."""
    stated = dict(zip(joint_state.name, joint_state.position, strict=False))
    return [stated[name] for name in joints] if all(name in stated for name in joints) else None


def solution(stamped, near, arm, solve):
    """Request the joint values of a geometry_msgs/PoseStamped.

    Args:
        stamped: desired pose of the tool in `arm.base_frame`.
        near: joint values to stay close to, in the order of the model; None for none.
        arm: The arm.
        solve: Function that asks the server, such as `FrameClient.solve`; an OSError becomes COMMUNICATION_FAILURE.

    Returns:
        Name of an error code of moveit_msgs/MoveItErrorCodes, and the joint values; none unless it is SUCCESS.
    """
    if stamped.header.frame_id.lstrip("/") != arm.base_frame:
        return "FRAME_TRANSFORM_FAILURE", []
    try:
        status, q, _ = solve(matrix_of(stamped.pose), near, arm.model)
    except OSError:
        return "COMMUNICATION_FAILURE", []
    if len(q) == len(arm.joints) and (
        status == REACHED or (status == OUTSIDE_DOMAIN and arm.accept_outside_domain)
    ):
        return "SUCCESS", list(q)
    return ("INVALID_GOAL_CONSTRAINTS" if status == INVALID_POSE else "NO_IK_SOLUTION"), []


def _refusal(wanted, arm):
    """Return the error code for unsupported parts of a moveit_msgs/PositionIKRequest; "" if there are none."""
    if wanted.ik_link_name not in ("", arm.tip_link) or wanted.pose_stamped_vector:
        return "INVALID_LINK_NAME"
    if wanted.avoid_collisions:
        return "COLLISION_CHECKING_UNAVAILABLE"
    is_constrained = any(getattr(wanted.constraints, f"{kind}_constraints") for kind in CONSTRAINTS)
    return "INVALID_GOAL_CONSTRAINTS" if is_constrained else ""


def answer(request, response, arm, solve):
    """Fill the response of a GetPositionIK service, and return it.

    Args:
        request: Request with `ik_request.pose_stamped` and, for joint values to stay close to,
            `ik_request.robot_state`.
        response: Response that gets `solution.joint_state` and `error_code`; only an error code if the pose is not
            reached.
        arm: The arm.
        solve: See `solution`.
    """
    wanted, code = request.ik_request, response.error_code
    near = near_of(wanted.robot_state.joint_state, arm.joints)
    name, q = _refusal(wanted, arm), []
    if not name:
        name, q = solution(wanted.pose_stamped, near, arm, solve)
    code.val = getattr(code, name)
    if q:
        response.solution.joint_state.name = list(arm.joints)
        response.solution.joint_state.position = q
    return response
