"""Rotations and transforms against identities, finite differences and scipy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close
from testing.refusals import refused
from torch.func import jacfwd, jacrev, vmap

from pisigma.files.errors import PoseError
from pisigma.robot import se3

# torch's own forward-mode differentiation still scripts its rules, and warns about that.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

BATCHES = [(), (1,), (3, 1, 2), (0,)]
ANGLES_FROM_PI = [0.0, 1e-12, 1e-9, 5e-8, 1e-6, 1e-3, 0.1]

angles = st.floats(-10.0, 10.0, allow_nan=False)
vectors = st.tuples(*[st.floats(-3.0, 3.0, allow_nan=False)] * 3)


def random_transforms(
    generator: torch.Generator, *batch: int, dtype: torch.dtype = torch.float64
) -> torch.Tensor:
    xyz_zyx = 2 * torch.rand((*batch, 6), generator=generator, dtype=torch.float64) - 1
    return se3.transform_from_xyz_zyx(xyz_zyx.to(dtype))


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
def test_inverse_and_dtype_and_batch(generator, batch, dtype, atol):
    T = random_transforms(generator, *batch, dtype=dtype)
    product = T @ se3.invert(T)
    assert product.dtype == dtype
    assert_close(product, torch.eye(4).expand(*batch, 4, 4), atol=atol)
    assert_close(se3.transform_from_xyz_zyx(se3.xyz_zyx_from_transform(T)), T, atol=atol)


@given(st.tuples(angles, st.floats(-1.57, 1.57), angles))
def test_angles_are_about_z_y_x_and_are_restored(zyx):
    R = se3.rotation_from_zyx(torch.tensor(zyx, dtype=torch.float64))
    assert_close(R, Rotation.from_euler("ZYX", zyx).as_matrix(), atol=1e-14)
    assert_close(se3.rotation_from_zyx(se3.zyx_from_rotation(R)), R, atol=1e-13)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_angles_at_gimbal_lock_reproduce_rotation_with_finite_gradient(pitch):
    zyx = torch.tensor([0.4, pitch, -0.3], dtype=torch.float64)
    R = se3.rotation_from_zyx(zyx)
    again = se3.zyx_from_rotation(R)
    assert again[2] == 0
    assert_close(se3.rotation_from_zyx(again), R, atol=1e-12)
    assert torch.isfinite(jacrev(se3.zyx_from_rotation)(R)).all()
    assert torch.isfinite(jacrev(se3.zyx_from_rotation)(torch.eye(3, dtype=torch.float64))).all()


@given(vectors)
def test_rotation_vector_agrees_with_scipy(vector):
    R = se3.rotation_from_vector(torch.tensor(vector, dtype=torch.float64))
    assert_close(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
    assert_close(se3.rotation_from_vector(se3.rotation_vector(R)), R, atol=1e-14)


@pytest.mark.parametrize("distance", ANGLES_FROM_PI)
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, -1), (1, 2, -3), (-1e-4, 1, 1e-9)])
def test_rotation_vector_near_zero_and_near_pi(axis, distance):
    direction = torch.tensor(axis, dtype=torch.float64) / np.linalg.norm(axis)
    for angle in (distance, math.pi - distance):
        R = se3.rotation_from_vector(angle * direction)
        vector = se3.rotation_vector(R)
        assert_close(vector.norm(), angle, atol=2e-15, rtol=1e-14)
        assert_close(se3.rotation_from_vector(vector), R, atol=1e-14)
        for derivative in (jacfwd(se3.rotation_vector)(R), jacrev(se3.rotation_vector)(R)):
            assert torch.isfinite(derivative).all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 2.0, math.pi - 0.05, math.pi - 1e-5])
def test_gradients_of_rotation_and_rotation_vector_are_inverse(angle):
    vector = angle * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    derivative = jacfwd(lambda v: se3.rotation_vector(se3.rotation_from_vector(v)))(vector)
    assert_close(derivative, torch.eye(3), atol=1e-8)


def test_pose_error_moves_the_actual_to_the_desired_pose(generator):
    wanted, actual = random_transforms(generator, 50), random_transforms(generator, 50)
    error = se3.pose_error(wanted, actual)
    R = se3.rotation_from_vector(error[:, 3:]) @ actual[:, :3, :3]
    assert_close(se3.transform(R, actual[:, :3, 3] + error[:, :3]), wanted, atol=1e-13)
    assert torch.count_nonzero(se3.pose_error(actual, actual)[:, :3]) == 0


def test_pose_error_vmapped_equals_batched(generator):
    wanted, actual = random_transforms(generator, 5), random_transforms(generator, 5)
    assert_close(vmap(se3.pose_error)(wanted, actual), se3.pose_error(wanted, actual), atol=1e-15)
    assert_close(
        vmap(se3.transform, in_dims=(None, 0))(wanted[0, :3, :3], actual[:, :3, 3])[:, :3, 3],
        actual[:, :3, 3],
    )


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_quaternions_of_any_length_agree_with_scipy(quaternion):
    R = se3.rotation_from_quaternion(torch.tensor(quaternion, dtype=torch.float64))
    assert_close(R, Rotation.from_quat(quaternion).as_matrix(), atol=1e-14)


def test_skew_is_the_cross_product(generator):
    a, b = torch.rand((2, 7, 3), generator=generator, dtype=torch.float64)
    assert_close((se3.skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b), atol=1e-16)


@given(st.floats(-math.pi, math.pi, exclude_min=True))
def test_wrap_does_not_change_an_angle_inside(angle):
    assert se3.wrap_to_pi(torch.tensor(angle, dtype=torch.float64)).item() == angle


@settings(max_examples=200)
@given(st.floats(-1e3, 1e3))
def test_wrap_returns_the_equivalent_angle_inside(angle):
    wrapped = se3.wrap_to_pi(torch.tensor(angle, dtype=torch.float64)).item()
    assert -math.pi < wrapped <= math.pi
    assert_close([math.cos(wrapped), math.sin(wrapped)], [math.cos(angle), math.sin(angle)], atol=1e-12)


def test_wrap_of_minus_pi_is_pi():
    assert se3.wrap_to_pi(torch.tensor([-math.pi, 3 * math.pi], dtype=torch.float64)).tolist() == [
        math.pi,
        math.pi,
    ]


def _spoilt(change) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    change(T[1])
    return T


@pytest.mark.parametrize(
    ("T", "expected", "value"),
    [
        (_spoilt(lambda T: T[0, 3].fill_(math.nan)), "finite entries", (1,)),
        (_spoilt(lambda T: T[0, 0].fill_(math.inf)), "finite entries", (1,)),
        (_spoilt(lambda T: T[3, 0].fill_(1.0)), "the last row 0 0 0 1", (1,)),
        (_spoilt(lambda T: T[:3, :3].mul_(1.001)), "an orthonormal rotation part", (1,)),
        (_spoilt(lambda T: T[2, 2].fill_(-1.0)), "a right-handed rotation part (determinant +1)", (1,)),
        (torch.zeros(3, 3, dtype=torch.float64), "homogeneous transforms of shape (*batch, 4, 4)", (3, 3)),
        (torch.zeros(4, dtype=torch.float64), "homogeneous transforms of shape (*batch, 4, 4)", (4,)),
        (torch.eye(4, dtype=torch.int64), "float64 or float32 values with lengths in metres", torch.int64),
    ],
)
def test_invalid_transforms_are_rejected_with_their_index(T, expected, value):
    with refused(PoseError, option="wanted pose", expected=expected, value=value):
        se3.check_transforms(T, "wanted pose")


def test_valid_transforms_pass_the_check(generator):
    for batch in BATCHES:
        se3.check_transforms(random_transforms(generator, *batch), "T")
    with refused(PoseError, expected="finite entries", value=(1, 0)):
        se3.check_transforms(torch.stack([torch.eye(4), torch.full((4, 4), math.nan)])[:, None], "T")
