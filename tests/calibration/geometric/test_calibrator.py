from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.simulated_arm import draw_joints, mean_error, simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.least_squares import SolutionStatus
from pisigma.calibration.geometric.problem.parameters import Prior, row_labels
from pisigma.estimation.loss import SquaredLoss
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx

# Park et al. 2022, Tables 9 and 10.
ELIMINATED = {
    "rb5": (
        "a_6 d_2 d_3 d_6 theta_1 theta_4 theta_5",
        "a_6 d_2 d_4 d_6 beta_1 theta_4 beta_5",
        "a_EE d_3 d_4 d_EE theta_1 beta_4 theta_5",
        "a_EE d_2 d_3 d_EE beta_1 beta_4 beta_5",
        "",
    ),
    "panda": (
        "a_7 d_7 theta_1 theta_2 theta_5",
        "a_7 d_EE theta_1 beta_2 beta_5",
        "a_EE d_7 beta_1 theta_2 theta_5",
        "a_EE d_EE beta_1 beta_2 beta_5",
        "",
    ),
}


def paper_data(name: str, seed: int) -> tuple[Robot, Robot, Measurements]:
    """Nominal and true robot, 40 positions: errors uniform in ±1 mm and ±1 deg, no noise (section 4.1)."""
    rng = np.random.default_rng(seed)
    robot = Robot.load(name)
    size = np.array([np.deg2rad(1), 1e-3, 1e-3, np.deg2rad(1), np.deg2rad(1)])
    true = robot.with_geometry(dh=robot.dh + rng.uniform(-1, 1, robot.dh.shape) * size)
    q = torch.from_numpy(rng.uniform(*robot.limits.T, (40, robot.dof)))
    return robot, true, Measurements(q=q, position=forward_kinematics(true, q)[:, :3, 3].contiguous())


@pytest.mark.parametrize("name", sorted(ELIMINATED))
@pytest.mark.parametrize("seed", range(2))
def test_exact_data_are_met_whatever_is_eliminated(name: str, seed: int) -> None:
    robot, true, data = paper_data(name, seed)
    names = [
        f"{column}_{row}" for row in row_labels(robot) for column in ("theta", "d", "a", "alpha", "beta")
    ]
    sums = []
    for case in ELIMINATED[name]:
        result = GeometricCalibrator(
            robot,
            free=[parameter for parameter in names if parameter not in case.split()],
            base="fixed",
            tool="fixed",
            elimination="none",
            prior=None,
            loss=SquaredLoss(),
        ).fit(data)
        assert result.status is SolutionStatus.EXACT
        assert result.rms_path[-1] < 1e-15
        assert result.iterations <= 10
        changed = {parameter.name: parameter.estimated for parameter in result.parameters}
        group = ("d_2", "d_3", "d_4") if name == "rb5" else ("theta_1", "beta_1")
        sums.append(sum(changed[parameter] for parameter in group))
    # Equal to first order in errors of 1 deg: 0.02 mm and 1e-5 rad.
    truth = float(true.dh[1:4, 1].sum() if name == "rb5" else true.dh[0, 0] + true.dh[0, 4])
    assert_close(np.array(sums), truth, atol=2e-5)


@pytest.mark.parametrize("elimination", ["exact", "pairwise", "none"])
@pytest.mark.parametrize("name", ["ur10", "panda", "kiro3"])
def test_all_ways_of_elimination_predict_the_same(name: str, elimination: str) -> None:
    arm = simulate(name, seed=4, rows=80)
    result = GeometricCalibrator(arm.nominal, elimination=elimination, prior=None).fit(arm.measurements)
    assert result.status is SolutionStatus.EXACT
    assert mean_error(result.robot, arm.true, 200) < 1e-12


def test_default_settings_meet_exact_data_with_errors_far_beyond_the_prior() -> None:
    robot, true, data = paper_data("rb5", 0)
    result = GeometricCalibrator(robot, base="fixed", tool="fixed").fit(data)
    assert result.rms_path[-1] < 1e-15
    assert mean_error(result.robot, true, 200) < 1e-12
    assert {ratio.kind for ratio in result.prior_ratios if ratio.lower_bound > 4.0} >= {"angle"}
    assert result.added_parameters


def test_new_poses_are_predicted_as_well_as_the_noise_allows() -> None:
    plain, clean, spoilt = [], [], []
    for seed in range(8):
        arm = simulate("ur10", seed=seed, noise=5e-5)
        least_squares = GeometricCalibrator(arm.nominal, prior=None, loss=SquaredLoss())
        plain.append(mean_error(least_squares.fit(arm.measurements).robot, arm.true))
        clean.append(mean_error(GeometricCalibrator(arm.nominal).fit(arm.measurements).robot, arm.true))
        arm = simulate("ur10", seed=seed, noise=5e-5, wrong=0.05)
        result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
        spoilt.append(mean_error(result.robot, arm.true))
        assert len(result.outliers) == 5
        assert_close(result.noise[0].sigma, 5e-5, rtol=0.2)
    # 27 parameters from 300 values: 0.05 mm · sqrt(3 · 27 / 300) · 0.92 = 0.024 mm, more on new poses.
    assert np.mean(plain) < 0.028e-3
    assert np.mean(clean) < 1.02 * np.mean(plain)
    assert np.mean(spoilt) < 1.1 * np.mean(plain)


def test_outliers_are_listed_with_their_rows() -> None:
    arm = simulate("ur5", rows=60, noise=2e-5)
    assert arm.measurements.position is not None
    position = arm.measurements.position.clone()
    position[7, 0] += 4e-3
    position[31, 2] -= 9e-3
    result = GeometricCalibrator(arm.nominal).fit(replace(arm.measurements, position=position))
    assert [outlier.row for outlier in result.outliers] == [31, 7]
    assert_close(result.outliers[0].residual, 9e-3, rtol=0.02)
    assert result.outliers[0].place == "memory, row 31"
    assert result.outliers[0].residual_in_sigmas > 100


def test_poses_reflectors_and_missing_rows_go_together() -> None:
    arm = simulate("panda", rows=90)
    rng = np.random.default_rng(5)
    points = {"A": rng.normal(size=6) * 0.1, "B": rng.normal(size=6) * 0.1, "C": rng.normal(size=6) * 0.1}
    target = tuple("ABC"[row % 3] for row in range(90))
    still = arm.true.with_geometry(tool=np.zeros(6))
    tools = torch.from_numpy(np.stack([points[name] for name in target]))
    T = forward_kinematics(still, arm.measurements.q) @ transform_from_xyz_zyx(tools)
    position, rotation = T[:, :3, 3].clone(), T[:, :3, :3].clone()
    position[4], position[17], rotation[17], rotation[20:40] = (torch.nan,) * 4
    data = Measurements(q=arm.measurements.q, position=position, rotation=rotation, target=target)
    result = GeometricCalibrator(arm.nominal, prior=None).fit(data)
    assert result.status is SolutionStatus.EXACT
    assert result.noise[0].values == 3 * 88
    assert result.noise[1].values == 3 * 69
    assert np.isnan(result.residuals["position"][[4, 17]]).all()
    for name, point in points.items():
        expected = transform_from_xyz_zyx(torch.from_numpy(point))
        at_flange = torch.from_numpy(result.tools[name])
        other = transform_from_xyz_zyx(torch.from_numpy(result.tools["A"]))
        first = transform_from_xyz_zyx(torch.from_numpy(points["A"]))
        # Only where the targets are to each other is seen: the last axis' errors are shared with the tool.
        between = (
            torch.linalg.solve(first, expected),
            torch.linalg.solve(other, transform_from_xyz_zyx(at_flange)),
        )
        assert_close(between[1], between[0], atol=1e-9)
    errors = result.errors_of(data)
    assert_close(
        np.nan_to_num(errors["position"].numpy()), np.nan_to_num(result.residuals["position"]), atol=1e-12
    )
    assert_close(
        np.nan_to_num(errors["rotation"].numpy()), np.nan_to_num(result.residuals["rotation"]), atol=1e-12
    )


def test_repeats_of_a_pose_do_not_count_as_new_poses() -> None:
    arm = simulate("ur5", rows=40, noise=3e-4)
    assert arm.measurements.position is not None
    once = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    repeated = Measurements(
        q=arm.measurements.q.repeat_interleave(5, 0),
        position=arm.measurements.position.repeat_interleave(5, 0)
        + 1e-6 * torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)),
    )
    often = GeometricCalibrator(arm.nominal).fit(repeated)
    for a, b in zip(once.parameters, often.parameters, strict=True):
        if a.free:
            assert_close(b.standard_error, a.standard_error, rtol=0.15)


@pytest.mark.parametrize(("shared", "own"), [(3e-4, 1e-5), (0.0, 3e-4)])
def test_standard_errors_include_the_common_error_of_targets_on_one_tool(shared: float, own: float) -> None:
    """Three targets whose errors are the same tell as much as one, three with errors of their own three times as much.

    Args:
        shared: standard deviation of the error that the targets share at a pose [m].
        own: of every target's own error [m].
    """
    arm, generator = simulate("ur5", rows=60), torch.Generator().manual_seed(5)
    T = forward_kinematics(arm.true, arm.measurements.q)
    points = torch.tensor([[0.0, 0.0, 0.1], [0.1, 0.0, 0.1], [0.0, 0.1, 0.15]], dtype=torch.float64)
    exact = T[:, :3, :3] @ points[:, None, :, None] + T[:, :3, 3:]
    q, target = arm.measurements.q.repeat(3, 1), tuple("A" * 60 + "B" * 60 + "C" * 60)
    names = ("a_2", "a_3", "theta_3", "theta_4", "d_5", "alpha_1")
    found = []
    for _ in range(12):
        noise = shared * torch.randn(60, 3, dtype=torch.float64, generator=generator)
        noise = noise + own * torch.randn(3, 60, 3, dtype=torch.float64, generator=generator)
        measured = Measurements(q=q, position=(exact[..., 0] + noise).reshape(-1, 3), target=target)
        result = GeometricCalibrator(arm.nominal, prior=None).fit(measured)
        found.append([(row.estimated, row.standard_error) for row in map(result.parameter, names)])
    estimated, predicted = np.array(found).transpose(2, 0, 1)
    ratio = estimated.var(0, ddof=1) / np.square(predicted).mean(0)
    assert (
        0.5 < ratio.mean() < 1.6
    )  # of 6 variances of 12 draws each; 3.7 for shared errors taken for three targets' own


def test_undetermined_parameters_remain_nominal_and_are_reported() -> None:
    on_axis = np.array([1e-4, 2e-4, 0.1, 0.0, 0.0, 0.0])
    arm = simulate("ur10", rows=200, noise=5e-5, tool=on_axis)
    result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    T_true, T_found = (forward_kinematics(robot, arm.measurements.q) for robot in (arm.true, result.robot))
    turn = T_true[:, :3, :3].mT @ T_found[:, :3, :3]
    spread = turn @ turn[0].mT  # the tool's own turn is not seen by positions
    angle = torch.arccos(((spread.diagonal(dim1=-1, dim2=-2).sum(-1) - 1) / 2).clamp(-1, 1))
    assert float(angle.max()) < np.deg2rad(0.5)
    assert len(result.weak_directions) == 2
    assert all("theta_5" in sentence or "alpha_5" in sentence for sentence in result.weak_directions)
    assert "target_on_axis" in [warning.kind for warning in result.warning_details]
    assert "prior" in result.parameter("alpha_5").short_remark
    assert (
        result.redundancy.dependency_sentence_of("d_2")
        == "d_2 + d_3 + d_4 is identified; the individual values are not"
    )


def test_joint_offsets_alone() -> None:
    arm = simulate("kiro3", rows=60, length=0, angle=0, turn_noise=0.0)
    dh = arm.nominal.dh.copy()
    dh[1, 0] += 2e-3
    true = arm.true.with_geometry(dh=dh)
    T = forward_kinematics(true, arm.measurements.q)
    data = Measurements(q=arm.measurements.q, position=T[:, :3, 3].contiguous())
    result = GeometricCalibrator(arm.nominal, free="joint_offsets").fit(data)
    assert_close(result.parameter("theta_2").change, 2e-3, atol=1e-9)
    assert {name for name in result.free_parameters if not name.startswith(("base", "tool"))} == {"theta_2"}
    assert result.parameter("a_2").remark == "fixed"


def test_a_list_of_parameters_with_a_fixed_base() -> None:
    arm = simulate("ur10", rows=30, length=0, angle=0)
    dh = arm.nominal.dh.copy()
    dh[1, 2] += 1e-3
    dh[2, 3] += 2e-3
    true = arm.true.with_geometry(dh=dh)
    data = Measurements(
        q=arm.measurements.q, position=forward_kinematics(true, arm.measurements.q)[:, :3, 3].contiguous()
    )
    known = arm.nominal.with_geometry(base=arm.true.base, tool=arm.true.tool)
    result = GeometricCalibrator(known, free=["a_2", "alpha_3"], base="fixed", tool="fixed").fit(data)
    assert result.free_parameters == ("a_2", "alpha_3")
    assert_close(result.parameter("a_2").change, 1e-3, atol=1e-12)
    assert_close(result.parameter("alpha_3").change, 2e-3, atol=1e-12)
    assert_close(result.robot.base, arm.true.base)


def test_given_standard_deviations_weight_the_rows() -> None:
    arm = simulate("ur5", rows=120, noise=0.0)
    assert arm.measurements.position is not None
    rng = np.random.default_rng(0)
    sigma = torch.from_numpy(np.where(rng.random(120) < 0.5, 1e-5, 1e-3))
    position = arm.measurements.position + sigma[:, None] * torch.from_numpy(rng.normal(size=(120, 3)))
    weighted = replace(arm.measurements, position=position, sigma_position=sigma)
    unweighted = replace(arm.measurements, position=position)
    good = GeometricCalibrator(arm.nominal).fit(weighted)
    plain = GeometricCalibrator(arm.nominal).fit(unweighted)
    assert mean_error(good.robot, arm.true) < 0.3 * mean_error(plain.robot, arm.true)
    assert good.noise[0].unit == "stated"
    assert_close(good.noise[0].sigma, 1.0, atol=0.2)


def test_the_tighter_the_prior_the_smaller_the_changes() -> None:
    arm = simulate("ur5", rows=40, noise=1e-3)
    tight = GeometricCalibrator(arm.nominal, prior=Prior(*[1e-6] * 5)).fit(arm.measurements)
    wide = GeometricCalibrator(arm.nominal).fit(arm.measurements)

    def size(result: object) -> float:
        return float(np.abs(result.robot.dh - arm.nominal.dh).sum())  # type: ignore[attr-defined]

    assert size(tight) < size(wide)


def test_many_rows_are_summed_over_chunks() -> None:
    arm = simulate("ur5", rows=9_000, noise=5e-5)
    result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    assert_close(result.noise[0].sigma, 5e-5, rtol=0.02)
    assert mean_error(result.robot, arm.true) < 4e-6


def test_joint_values_outside_one_turn_are_the_same_robot() -> None:
    q = draw_joints(Robot.load("ur5"), 3, np.random.default_rng(0))
    T = forward_kinematics(Robot.load("ur5"), q)
    assert_close(forward_kinematics(Robot.load("ur5"), q + 2 * np.pi), T, atol=1e-12)
