"""The message handling of the ROS 2 package, without ROS, against a server."""

import math
import sys
from types import SimpleNamespace as Message

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close
from testing.serving import frame_client, running

import pisigma

JOINTS = tuple(f"joint_{number}" for number in range(1, 7))
CODES = {
    "SUCCESS": 1,
    "INVALID_GOAL_CONSTRAINTS": -16,
    "INVALID_LINK_NAME": -18,
    "COLLISION_CHECKING_UNAVAILABLE": -22,
    "FRAME_TRANSFORM_FAILURE": -21,
    "COMMUNICATION_FAILURE": -25,
    "NO_IK_SOLUTION": -31,
}


@pytest.fixture(scope="module")
def messages(repository):
    folder = str(repository / "integrations" / "ros2" / "pisigma_ros")
    sys.path.insert(0, folder)
    try:
        from pisigma_ros import messages

        yield messages
    finally:
        sys.path.remove(folder)


def _request(T, near, frame="base_link"):
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    pose = Message(
        position=Message(**dict(zip("xyz", T[:3, 3], strict=True))), orientation=Message(x=x, y=y, z=z, w=w)
    )
    stated = Message(name=[*reversed(JOINTS), "gripper"], position=[*reversed(near), 0.1])
    stamped = Message(header=Message(frame_id=frame), pose=pose)
    constraints = Message(
        **{f"{kind}_constraints": [] for kind in ("joint", "position", "orientation", "visibility")}
    )
    return Message(
        ik_request=Message(
            pose_stamped=stamped,
            robot_state=Message(joint_state=stated),
            ik_link_name="",
            pose_stamped_vector=[],
            avoid_collisions=False,
            constraints=constraints,
        )
    )


def _response():
    return Message(
        solution=Message(joint_state=Message(name=[], position=[])), error_code=Message(val=0, **CODES)
    )


def test_a_service_call_returns_corrected_joint_values(messages, repository):
    ik, arm = pisigma.load(repository / "models" / "kiro4"), messages.Arm(JOINTS, "base_link")
    near = ik.model.starts[3].double().numpy()
    T = ik.forward(near)
    far, bent = T.copy(), _request(T, near)
    far[0, 3] = 9.0
    bent.ik_request.pose_stamped.pose.orientation.w = 3.0
    with running(repository / "models" / "kiro4") as server, frame_client(server) as client:

        def outcome(request, arm=arm):
            response = messages.answer(request, _response(), arm, client.solve)
            return response.error_code.val, response.solution.joint_state

        code, state = outcome(_request(T, near))
        assert (code, tuple(state.name)) == (1, JOINTS)
        assert_close(state.position, ik(T, near=near).q, atol=1e-9)
        for request, wanted in (
            (_request(far, near), -31),
            (_request(T, near, "world"), -21),
            (bent, -16),
            (_request(T, [math.inf] * 6), -16),
        ):
            code, state = outcome(request)
            assert (code, state.position) == (wanted, [])

    def gone(*arguments):
        raise ConnectionError("closed")

    assert messages.answer(_request(T, near), _response(), arm, gone).error_code.val == -25


def test_what_the_service_cannot_do_is_refused(messages):
    arm = messages.Arm(JOINTS, "base_link", "tool0")
    for field, value, wanted in (
        ("ik_link_name", "flange", -18),
        ("pose_stamped_vector", [None], -18),
        ("avoid_collisions", True, -22),
        ("constraints", None, -16),
    ):
        request = _request(np.eye(4), np.zeros(6))
        if value is None:
            request.ik_request.constraints.orientation_constraints.append("level")
        else:
            setattr(request.ik_request, field, value)
        assert messages.answer(request, _response(), arm, None).error_code.val == wanted


def test_joint_values_outside_the_domain_are_returned_if_accepted(messages):
    q = [0.1] * 6
    for accepts, wanted in ((False, -31), (True, 1)):
        arm = messages.Arm(JOINTS, "base_link", accept_outside_domain=accepts)
        request = _request(np.eye(4), np.zeros(6), "/base_link")
        request.ik_request.robot_state.joint_state.name.pop(0)
        asked = []

        def solve(T, near, model, asked=asked):
            asked.append((T, near, model))
            return 3, q, (0.0, 0.0)

        assert messages.answer(request, _response(), arm, solve).error_code.val == wanted
        assert asked == [(np.eye(4).ravel().tolist(), None, 0)]
        assert math.isfinite(sum(asked[0][0]))
