"""Selection of poses: greedy selection, exchange, order, and the predicted accuracy."""

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.planning.expected_accuracy import accuracy_curve, p95_of, remaining_errors, rms_of
from pisigma.planning.plan_settings import Criterion
from pisigma.planning.pose_selection import (
    PoseSelection,
    complete_selection,
    condense_derivatives,
    select_poses,
)
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.robot import Robot


def random_joints(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 6, generator=generator, dtype=torch.float64) * 2 - 1) * 2.5


@pytest.fixture(scope="module")
def posterior() -> RobotPosterior:
    return RobotPosterior.from_robot(Robot.load("ur5"), hybrid=False)


def log_det(B: torch.Tensor) -> float:
    rows = B.flatten(0, 1)
    return float(torch.logdet(torch.eye(len(rows)).double() + rows @ rows.t())) / 2


def variance(B: torch.Tensor, goal: torch.Tensor) -> float:
    rows = B.flatten(0, 1)
    C = torch.linalg.inv(torch.eye(B.shape[2]).double() + rows.t() @ rows)
    return float((goal @ C @ goal.t()).trace())


@pytest.mark.parametrize("criterion", ["D", "I"])
def test_gains_and_exchange_are_those_of_the_criterion(
    posterior: RobotPosterior, criterion: Criterion
) -> None:
    q, goal = random_joints(40, 0), condense_derivatives(posterior.tool_derivatives(random_joints(50, 1)))
    # Base and tool are known to a millimetre here, so that determinants are right to the last digits.
    B = posterior.sensitivities(q).clamp(-30, 30)
    choice = PoseSelection(B, goal, criterion)

    def value(chosen: list[int]) -> float:
        return log_det(B[chosen]) if criterion == "D" else -variance(B[chosen], goal)

    for number in (3, 17, 8):
        choice.add_candidate(number)
    before = value([3, 17, 8])
    gains = choice.gains()
    assert_close(gains[21], value([3, 17, 8, 21]) - before, rtol=1e-6)
    assert int(gains.argmax()) not in (3, 17, 8)
    choice.add_until(8)
    grown = value(choice.chosen)
    choice.exchange_candidates()
    assert len(set(choice.chosen)) == 8
    assert value(choice.chosen) >= grown - 1e-9 * abs(grown)


@pytest.mark.parametrize("hybrid", [False, True])
def test_condensed_rows_keep_the_variance_after_measuring(hybrid: bool) -> None:
    # before it is all where base and tool are, metres against tenths of a millimetre
    posterior, task = RobotPosterior.from_robot(Robot.load("ur5"), hybrid=hybrid), random_joints(50, 1)
    q, goal = random_joints(60, 0), condense_derivatives(posterior.tool_derivatives(task))
    for count in (5, 20, 60):
        left = rms_of(posterior.after_measuring(q[:count]).tool_derivatives(task)) ** 2
        assert_close(variance(posterior.sensitivities(q[:count]), goal), left, rtol=0.01)


def test_criterion_i_leaves_less_error_of_the_tool_than_criterion_d_and_random_poses() -> None:
    posterior, q, task = (
        RobotPosterior.from_robot(Robot.load("ur5")),
        random_joints(200, 4),
        random_joints(50, 5),
    )
    for count in (10, 25):
        chosen = [
            select_poses(posterior.sensitivities(q), posterior.tool_derivatives(task), count, "I"),
            select_poses(posterior.sensitivities(q), posterior.tool_derivatives(task), count, "D"),
            torch.arange(count),
        ]
        left, *others = (rms_of(posterior.after_measuring(q[rows]).tool_derivatives(task)) for rows in chosen)
        assert left < 0.9 * min(others)


def test_selected_poses_are_sorted_greedily(posterior: RobotPosterior) -> None:
    q, task = random_joints(60, 2), random_joints(40, 3)
    chosen = select_poses(posterior.sensitivities(q), posterior.tool_derivatives(task), 12, "I")
    assert len(set(chosen.tolist())) == 12
    choice = PoseSelection(
        posterior.sensitivities(q[chosen]), condense_derivatives(posterior.tool_derivatives(task)), "I"
    )
    choice.add_until(12)
    assert choice.chosen == list(range(12))


def test_a_completed_selection_keeps_poses_and_leaves_little_more_error(posterior: RobotPosterior) -> None:
    q, task = random_joints(150, 2), random_joints(40, 3)
    B, D = posterior.sensitivities(q), posterior.tool_derivatives(task)
    best = select_poses(B, D, 20)
    unreachable = best[::3]
    kept = best[~torch.isin(best, unreachable)]
    others = torch.arange(150)[~torch.isin(torch.arange(150), best)]
    chosen = complete_selection(B, D, kept, others, 20)
    assert len(set(chosen.tolist())) == 20
    assert not torch.isin(chosen, unreachable).any()
    assert torch.isin(kept, chosen).all()
    left, least, first, alone = (
        rms_of(posterior.after_measuring(q[rows]).tool_derivatives(task))
        for rows in (chosen, best, torch.cat([kept, others[: 20 - len(kept)]]), kept)
    )
    assert least < left < min(1.1 * least, first, alone)
    assert sorted(complete_selection(B, D, kept, others, len(kept)).tolist()) == sorted(kept.tolist())
    assert torch.equal(complete_selection(B, D, kept[:0], torch.arange(150), 20), best)


def test_the_curve_is_the_covariance_after_the_poses(posterior: RobotPosterior) -> None:
    q, task = random_joints(80, 4), random_joints(40, 5)
    chosen = select_poses(posterior.sensitivities(q), posterior.tool_derivatives(task), 20)
    B, D = posterior.sensitivities(q), posterior.tool_derivatives(task)
    points = accuracy_curve(B, D, chosen, (10, 20))
    (same,) = accuracy_curve(B, D, chosen, (20,), usable=chosen)
    assert_close(same.random_rms, same.rms, rtol=1e-9)
    for point in points:
        after = posterior.after_measuring(q[chosen[: point.poses]])
        assert_close(point.rms, float(after.sigma(task).square().mean().sqrt()), rtol=1e-6)
        assert point.rms < point.p95 < 3 * point.rms
        assert point.rms < point.random_rms
    assert points[1].rms < points[0].rms


def test_quantiles_are_those_of_one_normal_coordinate() -> None:
    D = torch.zeros(500, 3, 500).double()
    D[torch.arange(500), 0, torch.arange(500)] = 1e-3
    assert_close(rms_of(D), 1e-3, rtol=1e-9)
    assert_close(p95_of(D), 1.96e-3, rtol=0.03)


def test_remaining_errors_are_attributed_to_groups(posterior: RobotPosterior) -> None:
    task = random_joints(40, 6)
    errors = remaining_errors(posterior, task)
    assert {"base", "tool", "joint offsets"} <= {error.name for error in errors}
    assert errors[0].name == "base"
    hybrid = RobotPosterior.from_robot(Robot.load("ur5")).after_measuring(random_joints(300, 7))
    assert any(error.name.startswith("correction of joint") for error in remaining_errors(hybrid, task))


def test_impossible_selections_are_refused(posterior: RobotPosterior) -> None:
    q = random_joints(5, 0)
    with refused(PlanningError, option="count", value=6):
        select_poses(posterior.sensitivities(q), posterior.tool_derivatives(q), 6)
    with refused(PlanningError, option="task"):
        select_poses(posterior.sensitivities(q), posterior.tool_derivatives(q[:0]), 2)
