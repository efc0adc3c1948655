"""Forward kinematics and Jacobian against products, the peer, finite differences and torch.func."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from torch.func import jacfwd, jacrev, vmap

from pisigma.files.errors import PoseError
from pisigma.robot import Robot
from pisigma.robot.kinematics.components import IDENTITY, as_transform, rotate_x, translate
from pisigma.robot.kinematics.forward import CHUNK, Geometry, forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import pose_error

# torch's own forward-mode differentiation still scripts its rules, and warns about that.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

BATCHES = [(), (1,), (3, 1, 2), (0,)]


def _turn(axis: int, angle: float) -> np.ndarray:
    T = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    T[i, i] = T[j, j] = np.cos(angle)
    T[i, j], T[j, i] = -np.sin(angle), np.sin(angle)
    return T


def _shift(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def _place(x, y, z, roll, pitch, yaw) -> np.ndarray:
    return _shift(x, y, z) @ _turn(2, roll) @ _turn(1, pitch) @ _turn(0, yaw)


def written_out(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Compute the definition by 4x4 products."""
    T, values = _place(*robot.base), iter(q)
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh, strict=True):
        moved = row.direction * next(values) if row.type != "fixed" else 0.0
        turn, slide = (moved, 0.0) if row.type == "revolute" else (0.0, moved)
        T = T @ _turn(2, theta + turn) @ _shift(a, 0, d + slide) @ _turn(0, alpha) @ _turn(1, beta)
    return T @ _place(*robot.tool)


def test_forward_is_the_product_of_its_rows(robot, robots, generator):
    q = robots.random_joints(robot, generator, 20)
    assert_close(
        forward_kinematics(robot, q), np.stack([written_out(robot, row) for row in q.numpy()]), atol=1e-14
    )


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "ur5", "ur10"])
def test_dressed_robots_are_the_product_of_their_rows(name, robots, generator):
    robot = robots.dress(robots.load(name))
    q = robots.random_joints(robot, generator, 20)
    assert_close(
        forward_kinematics(robot, q), np.stack([written_out(robot, row) for row in q.numpy()]), atol=1e-14
    )


def test_peer_agrees(robot, robots, generator, benchmark_module):
    chain = benchmark_module.build_peer(robot)
    q = robots.random_joints(robot, generator, 100)
    T, J = joint_jacobian(robot, q)
    J_peer, T_peer = chain.jacobian(q, ret_eef_pose=True)
    assert_close(T, T_peer, atol=1e-12)
    assert_close(forward_kinematics(robot, q), T_peer, atol=1e-12)
    assert_close(J, J_peer, atol=1e-12)


def test_jacobian_agrees_with_finite_differences(robot, robots, generator):
    q, h = robots.random_joints(robot, generator, 10), 1e-6
    T, J = joint_jacobian(robot, q)
    for joint in range(robot.dof):
        step = h * torch.eye(robot.dof, dtype=torch.float64)[joint]
        moved = pose_error(forward_kinematics(robot, q + step), forward_kinematics(robot, q - step))
        assert_close(J[:, :, joint], moved / (2 * h), atol=1e-9)
    assert_close(T, forward_kinematics(robot, q), atol=2e-15)


def test_jacobian_agrees_with_both_modes_of_autodiff(robot, robots, generator):
    q = robots.random_joints(robot, generator, 4)
    T, J = joint_jacobian(robot, q)
    for mode in (jacfwd, jacrev):
        dT = vmap(mode(lambda joints: forward_kinematics(robot, joints)))(q)
        spin = torch.einsum("brcj,bkc->brkj", dT[:, :3, :3], T[:, :3, :3])
        twist = torch.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], 1)
        assert_close(J, torch.cat([dT[:, :3, 3], twist], 1), atol=1e-13)


def test_pose_error_of_forward_kinematics_differentiates_at_its_minimum(robot, robots, generator):
    q = robots.random_joints(robot, generator)
    T, J = joint_jacobian(robot, q)
    derivative = jacfwd(lambda joints: pose_error(forward_kinematics(robot, joints), T))(q)
    assert_close(derivative, J, atol=1e-13)


def test_gradients_of_geometry_agree_with_finite_differences(robots, generator):
    robot = robots.load("odd")
    q = robots.random_joints(robot, generator, 3)
    weights = torch.rand((3, 4, 4), generator=generator, dtype=torch.float64)
    parameters = [torch.tensor(x) for x in (robot.dh, robot.base, robot.tool)]

    def value(dh, base, tool):
        return (weights * forward_kinematics(robot, q, Geometry.from_tensors(dh, base, tool))).sum()

    assert_close(value(*parameters), (weights * forward_kinematics(robot, q)).sum(), atol=1e-13)
    assert torch.autograd.gradcheck(value, [x.requires_grad_() for x in parameters], atol=1e-8)


def test_geometry_gradients_flow_through_more_than_one_chunk(robots, generator):
    robot = robots.load("kiro4")
    q = robots.random_joints(robot, generator, CHUNK + 3)
    tool = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    geometry = Geometry.from_tensors(torch.tensor(robot.dh), torch.tensor(robot.base), tool)
    forward_kinematics(robot, q, geometry)[..., :3, 3].square().sum().backward()
    R, p = forward_kinematics(robot, q)[:, :3, :3], forward_kinematics(robot, q)[:, :3, 3]
    assert_close(tool.grad[:3], 2 * (R.mT @ p[..., None]).sum(0)[:, 0], rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-14), (torch.float32, 2e-6)])
def test_batched_equals_looped_in_every_shape_and_dtype(robot, robots, generator, batch, dtype, atol):
    q = robots.random_joints(robot, generator, *batch)
    T, J = joint_jacobian(robot, q.to(dtype))
    forward = forward_kinematics(robot, q.to(dtype))
    assert (T.shape, J.shape, forward.shape) == ((*batch, 4, 4), (*batch, 6, robot.dof), (*batch, 4, 4))
    assert {T.dtype, J.dtype, forward.dtype} == {dtype}
    assert forward.is_contiguous()
    for index in np.ndindex(*batch):
        T_one, J_one = joint_jacobian(robot, q[index])
        for actual, expected in ((forward[index], T_one), (T[index], T_one), (J[index], J_one)):
            assert_close(actual, expected, atol=atol)


def test_chunks_are_joined_correctly(robots, generator):
    robot = robots.load("ur5")
    q = robots.random_joints(robot, generator, 2 * CHUNK + 1)
    rows = torch.tensor([0, CHUNK - 1, CHUNK, 2 * CHUNK - 1, 2 * CHUNK])
    T, J = joint_jacobian(robot, q)
    T_rows, J_rows = joint_jacobian(robot, q[rows])
    assert_close(forward_kinematics(robot, q)[rows], T_rows, atol=1e-14)
    assert_close(T[rows], T_rows, atol=1e-14)
    assert_close(J[rows], J_rows, atol=1e-14)


@pytest.mark.parametrize("function", [forward_kinematics, joint_jacobian])
def test_a_wrong_number_of_joint_values_is_rejected(robots, function):
    with refused(PoseError, expected="4 columns", value=5):
        function(robots.load("kiro3"), torch.zeros((2, 5), dtype=torch.float64))


def test_exact_zeros_of_a_nominal_robot_cost_nothing(generator):
    angle = torch.rand(3, generator=generator, dtype=torch.float64)
    frame = translate(rotate_x(IDENTITY, np.pi / 2), 0.0, 0.0, angle)
    assert [sum(isinstance(value, float) for value in vector) for vector in frame] == [3, 3, 3, 2]
    assert_close(as_transform(frame, angle)[:, 1, 3], -angle)
