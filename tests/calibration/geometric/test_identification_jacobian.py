import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.files.errors import PoseError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import Geometry, forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import JACOBIAN_CHUNK, identification_jacobian


def generic(name: str) -> Robot:
    """A catalogue robot with nothing special left: no zero, no right angle."""
    rng = np.random.default_rng(3)
    robot = Robot.load(name)
    return robot.with_geometry(
        dh=robot.dh + 0.1 * rng.normal(size=robot.dh.shape), base=rng.normal(size=6), tool=rng.normal(size=6)
    )


def geometry_of(robot: Robot, values: torch.Tensor) -> Geometry:
    rows = 5 * len(robot.rows)
    return Geometry.from_tensors(values[:rows].view(-1, 5), values[rows : rows + 6], values[rows + 6 :])


def values_of(robot: Robot) -> torch.Tensor:
    return torch.from_numpy(np.concatenate([robot.dh.ravel(), robot.base, robot.tool]))


def twist(dT: torch.Tensor, T: torch.Tensor) -> torch.Tensor:
    """Shift and turn `(*batch, 6, parameters)` of derivatives `(*batch, 4, 4, parameters)`."""
    spin = torch.einsum("...ijp,...kj->...ikp", dT[..., :3, :3, :], T[..., :3, :3])
    turn = torch.stack([spin[..., 2, 1, :], spin[..., 0, 2, :], spin[..., 1, 0, :]], -2)
    return torch.cat([dT[..., :3, 3, :], turn], -2)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")
@pytest.mark.parametrize("name", ["kiro3", "rb5", "panda", "fanuc_r2000"])
def test_jacobian_equals_forward_mode_differentiation(name: str, generator: torch.Generator) -> None:
    robot = generic(name)
    q = torch.randn(2, 3, robot.dof, generator=generator, dtype=torch.float64)
    T, J = identification_jacobian(robot, q)

    def pose(values: torch.Tensor) -> torch.Tensor:
        return forward_kinematics(robot, q, geometry_of(robot, values))

    expected = twist(torch.func.jacfwd(pose)(values_of(robot)), T)
    assert_close(T, forward_kinematics(robot, q), atol=1e-13)
    assert_close(J, expected, atol=1e-9 * float(expected.abs().max()), rtol=1e-9)


def test_jacobian_equals_finite_differences(generator: torch.Generator) -> None:
    robot = generic("kiro3")
    q = torch.randn(4, robot.dof, generator=generator, dtype=torch.float64)
    T, J = identification_jacobian(robot, q)
    values = values_of(robot)
    for index in range(len(values)):
        # Richardson's extrapolation of central differences: the error is of fourth order in the step.
        slopes = []
        for step in (2e-3, 1e-3):
            ends = []
            for sign in (1, -1):
                moved = values.clone()
                moved[index] += sign * step
                ends.append(forward_kinematics(robot, q, geometry_of(robot, moved)))
            slopes.append((ends[0] - ends[1]) / (2 * step))
        slope = (4 * slopes[1] - slopes[0]) / 3
        assert_close(J[..., index], twist(slope[..., None], T)[..., 0], atol=1e-9, rtol=1e-9)


def test_jacobian_of_a_nominal_robot_has_its_exact_zeros() -> None:
    robot = Robot.load("rb5")
    _, J = identification_jacobian(robot, torch.zeros(1, 6, dtype=torch.float64))
    names = [f"{column}_{row}" for row in range(7) for column in ("theta", "d", "a", "alpha", "beta")]
    for name in ("theta_6", "alpha_6", "beta_6"):  # the end effector's row turns the point about itself
        assert_close(J[0, :3, names.index(name)], 0.0, atol=1e-15)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batched_equals_looped(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    robot = generic("panda")
    q = torch.randn(*batch, 7, generator=generator, dtype=torch.float64).to(dtype)
    T, J = identification_jacobian(robot, q)
    assert J.shape == (*batch, 6, 52)
    assert J.dtype == T.dtype == dtype
    for row, T_row, J_row in zip(q.reshape(-1, 7), T.reshape(-1, 4, 4), J.reshape(-1, 6, 52), strict=True):
        T_one, J_one = identification_jacobian(robot, row)
        assert_close(T_row, T_one, atol=10 * torch.finfo(dtype).eps)
        assert_close(J_row, J_one, atol=100 * torch.finfo(dtype).eps)


def test_chunks_join_seamlessly(generator: torch.Generator) -> None:
    robot = generic("kiro3")
    q = torch.randn(JACOBIAN_CHUNK + 3, 4, generator=generator, dtype=torch.float64)
    T, J = identification_jacobian(robot, q)
    T_end, J_end = identification_jacobian(robot, q[JACOBIAN_CHUNK - 1 :])
    assert_close(T[JACOBIAN_CHUNK - 1 :], T_end, atol=1e-14)
    assert_close(J[JACOBIAN_CHUNK - 1 :], J_end, atol=1e-14)


def test_an_empty_batch_works() -> None:
    T, J = identification_jacobian(Robot.load("ur5"), torch.zeros(0, 6, dtype=torch.float64))
    assert T.shape == (0, 4, 4)
    assert J.shape == (0, 6, 42)


def test_wrong_joint_count_is_refused() -> None:
    with pytest.raises(PoseError, match="6 joints"):
        identification_jacobian(Robot.load("ur5"), torch.zeros(2, 7, dtype=torch.float64))
