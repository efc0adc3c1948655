import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.simulated_arm import BASE, simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import (
    start_from_poses,
)
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import IdentificationError, PoseError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import (
    invert,
    nearest_rotation,
    rotation_from_vector,
    rotation_from_zyx,
    transform_from_xyz_zyx,
)


@pytest.mark.parametrize("name", ["ur10", "kiro4", "panda", "kiro3"])
@pytest.mark.parametrize("poses", [True, False])
def test_exact_data_are_met_exactly(name: str, poses: bool) -> None:
    arm = simulate(name, rows=40, length=0, angle=0, turn_noise=0.0 if poses else None)
    fit = fit_base_and_tool(arm.nominal, arm.measurements)
    assert fit.rms_position < 1e-13
    assert fit.status.startswith("converged")
    if name != "kiro3":  # parallel axes leave a shift along them open
        assert_close(fit.robot.base, arm.true.base, atol=1e-12)
        assert_close(fit.robot.tool[: 6 if poses else 3], arm.true.tool[: 6 if poses else 3], atol=1e-12)


def test_parallel_axes_leave_unknowns_undetermined() -> None:
    arm = simulate("kiro3", rows=40, length=0, angle=0, turn_noise=0.0)
    fit = fit_base_and_tool(arm.nominal, arm.measurements)
    assert re.findall(r"\b1\d\b", fit.status) == ["11", "12"]  # determined and all unknowns
    assert_close(
        forward_kinematics(fit.robot, arm.measurements.q),
        forward_kinematics(arm.true, arm.measurements.q),
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", range(6))
def test_poses_of_a_robot_with_parallel_axes_start_well_wherever_base_and_tool_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base, tool = (np.concatenate([rng.normal(size=3), rng.uniform(-1.5, 1.5, 3)]) for _ in range(2))
    arm = simulate("kiro3", seed, rows=40, noise=5e-5, turn_noise=5e-5, base=base, tool=tool)
    robot = fit_base_and_tool(arm.nominal, arm.measurements, maximum_iterations=2).robot
    errors = forward_kinematics(robot, arm.measurements.q)[:, :3, 3] - arm.measurements.position
    assert float(errors.norm(dim=1).mean()) < 0.02  # 0.3 to 1 m from starts that are wrong
    result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    assert result.noise[0].sigma < 8e-5


def test_no_orientation_is_special() -> None:
    rng = np.random.default_rng(1)
    for pitch in (np.pi / 2, -np.pi / 2, 0.0):
        base = np.concatenate([rng.normal(size=3), [rng.uniform(-3, 3), pitch, rng.uniform(-3, 3)]])
        arm = simulate("ur5", rows=30, length=0, angle=0, base=base)
        fit = fit_base_and_tool(arm.nominal, arm.measurements)
        assert_close(
            transform_from_xyz_zyx(torch.tensor(fit.robot.base)),
            transform_from_xyz_zyx(torch.from_numpy(base)),
            atol=1e-10,
        )


def test_few_positions_suffice() -> None:
    arm = simulate("ur10", rows=5, length=0, angle=0)
    assert fit_base_and_tool(arm.nominal, arm.measurements).rms_position < 1e-12


def test_several_targets_have_their_own_points() -> None:
    arm = simulate("panda", rows=60, length=0, angle=0)
    points = {"A": [0.1, 0.0, 0.05], "B": [-0.05, 0.08, 0.1], "C": [0.0, -0.1, 0.2]}
    target = tuple("ABC"[row % 3] for row in range(60))
    tools = torch.tensor([[*points[name], 0.0, 0.0, 0.0] for name in target], dtype=torch.float64)
    still = arm.true.with_geometry(tool=np.zeros(6))
    T = forward_kinematics(still, arm.measurements.q) @ transform_from_xyz_zyx(tools)
    fit = fit_base_and_tool(
        arm.nominal, Measurements(q=arm.measurements.q, position=T[:, :3, 3].contiguous(), target=target)
    )
    for name, point in points.items():
        assert_close(fit.tools[name][:3], np.array(point), atol=1e-12)
    assert_close(fit.robot.tool, fit.tools["A"])


def test_missing_values_are_left_out() -> None:
    arm = simulate("ur10", rows=40, length=0, angle=0, turn_noise=0.0)
    assert arm.measurements.position is not None
    assert arm.measurements.rotation is not None
    position, rotation = arm.measurements.position.clone(), arm.measurements.rotation.clone()
    position[:5], rotation[3:15] = torch.nan, torch.nan
    fit = fit_base_and_tool(arm.nominal, replace(arm.measurements, position=position, rotation=rotation))
    assert_close(fit.robot.tool, arm.true.tool, atol=1e-12)


@pytest.mark.parametrize("poses", [True, False])
def test_a_fixed_base_or_tool_remains_unchanged(poses: bool) -> None:
    arm = simulate("ur10", rows=30, length=0, angle=0, turn_noise=0.0 if poses else None)
    known = 6 if poses else 3
    with_base = arm.nominal.with_geometry(base=arm.true.base)
    fit = fit_base_and_tool(with_base, arm.measurements, free_base=False)
    assert_close(fit.robot.tool[:known], arm.true.tool[:known], atol=1e-12)
    assert_close(fit.robot.base, arm.true.base)
    with_tool = arm.nominal.with_geometry(tool=arm.true.tool)
    fit = fit_base_and_tool(with_tool, arm.measurements, free_tool=False)
    assert_close(fit.robot.base, arm.true.base, atol=1e-12)
    assert_close(fit.robot.tool, arm.true.tool)


def test_the_closed_form_of_poses_is_exact_without_polish(generator: torch.Generator) -> None:
    X, Y = (rotation_from_zyx(torch.randn(3, generator=generator, dtype=torch.float64)) for _ in range(2))
    x, y = (torch.randn(3, generator=generator, dtype=torch.float64) for _ in range(2))
    R = rotation_from_zyx(torch.randn(8, 3, generator=generator, dtype=torch.float64))
    p = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    position = (p + R @ y) @ X.mT + x
    nominal = torch.zeros(3, dtype=torch.float64)
    found = start_from_poses(R, p, position, X @ R @ Y, torch.eye(3, dtype=torch.float64), nominal)
    for actual, expected in zip(found, (X, x, Y, y), strict=True):
        assert_close(actual, expected, atol=1e-10)


def test_nearest_rotation_is_a_rotation_and_the_nearest(generator: torch.Generator) -> None:
    M = torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    R = nearest_rotation(M)
    assert_close(R @ R.mT, torch.eye(3).double().expand(20, 3, 3), atol=1e-13)
    assert_close(torch.linalg.det(R), torch.ones(20), atol=1e-13)
    near = R @ rotation_from_vector(0.1 * torch.randn(20, 3, generator=generator, dtype=torch.float64))
    assert ((M - R).square().sum((-1, -2)) <= (M - near).square().sum((-1, -2))).all()


def test_too_few_rows_are_refused() -> None:
    arm = simulate("ur10", rows=2)
    with refused(IdentificationError, expected="at least 9 values", value=6):
        fit_base_and_tool(arm.nominal, arm.measurements)


def test_several_frames_are_refused() -> None:
    arm = simulate("ur10", rows=20)
    with refused(IdentificationError, expected="one measuring frame", value=2):
        fit_base_and_tool(arm.nominal, replace(arm.measurements, frame=("left", "right") * 10))


def test_no_positions_are_refused() -> None:
    with refused(IdentificationError, expected="measured positions or poses for base and tool"):
        fit_base_and_tool(Robot.load("ur10"), Measurements(q=torch.zeros(5, 6, dtype=torch.float64)))


def test_joint_values_of_another_robot_are_refused() -> None:
    with pytest.raises(PoseError, match="7 joints"):
        fit_base_and_tool(Robot.load("panda"), simulate("ur10", rows=20).measurements)


def in_second_frame(few: int, seed: int) -> tuple[Measurements, Measurements]:
    """60 positions in the frame F and a few in G; and 100 exact ones in G at other joint values."""
    arm = simulate("ur10", seed, rows=160 + few, noise=5e-5)
    base = transform_from_xyz_zyx(torch.tensor([1.0, -0.2, 0.5, 0.3, -0.4, 0.6], dtype=torch.float64))
    T = base @ invert(transform_from_xyz_zyx(torch.from_numpy(BASE)))
    q, position = arm.measurements.q, arm.measurements.position.clone()
    position[60:] = position[60:] @ T[:3, :3].mT + T[:3, 3]
    position[-100:] = (T @ forward_kinematics(arm.true, q[-100:]))[:, :3, 3]
    frame = ("F",) * 60 + ("G",) * (100 + few)
    rows = Measurements(q=q, position=position, frame=frame)
    return rows.select(torch.arange(60 + few)), rows.select(torch.arange(60 + few, 160 + few))


@pytest.mark.parametrize("few", [3, 4, 6])
def test_few_positions_in_a_second_frame_are_no_outliers(few: int) -> None:
    for seed in range(3):
        measurements, others = in_second_frame(few, seed)
        result = GeometricCalibrator(Robot.load("ur10")).fit(measurements)
        assert not [outlier for outlier in result.outliers if outlier.row >= 60]
        assert float(result.errors_of(others)["position"].norm(dim=1).mean()) < 3e-4
        assert result.parameter("base_G_x").standard_error > 1e-5


@pytest.mark.parametrize("seed", [97, 98])  # all three rows of G are outliers, or all but one
def test_a_base_that_only_outliers_show_has_no_standard_error(seed: int) -> None:
    measurements, _ = in_second_frame(3, 0)
    position = measurements.position.clone()
    position[60:] += 0.05 * torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)).double()
    result = GeometricCalibrator(Robot.load("ur10")).fit(replace(measurements, position=position))
    assert len(result.outliers) >= 2
    row = result.parameter("base_G_x")
    assert not row.free
    assert row.short_remark == "outliers"
    assert result.parameter("base_F_x").free


def test_a_base_that_no_row_determines_does_not_cause_outliers() -> None:
    arm = simulate("ur10", rows=60, noise=5e-5)
    result = GeometricCalibrator(arm.nominal, prior=None, elimination="none", loss=SquaredLoss()).fit(
        arm.measurements
    )
    assert not [row.name for row in result.parameters if "outliers" in row.remark]
    assert result.parameter("base_x").free
