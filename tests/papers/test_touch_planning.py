"""Planning of touches: linearisation, exchanges, and the quality of the plan."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.calibration.geometric.problem.parameters import ParameterSpace, Prior
from pisigma.files.errors import IdentificationError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector, transform, transform_from_xyz_zyx
from pisigma.simulation.touch_candidates import JigPlacement, TouchCandidatesSection
from touch_planning import (
    PlanningProblem,
    _best_exchange,
    build_planning_problem,
    plan_measurements,
)

FREE = ("a_1", "a_2", "a_3", "d_4", "theta_2", "theta_3", "theta_4", "theta_5")
PLACEMENTS = (
    JigPlacement(name="right", base={"x_mm": 445, "y_mm": 1000, "roll_deg": -90}),
    JigPlacement(name="left", base={"x_mm": 1000, "y_mm": 445, "roll_deg": 180}),
)
ROBOT = Robot.load("welding")


def candidates(count: int = 60, placements: tuple = PLACEMENTS):
    return TouchCandidatesSection(count=count, seed=2).find(ROBOT, placements)


def problem_of(count: int = 60, placements: tuple = PLACEMENTS, **options: object) -> PlanningProblem:
    found = candidates(count, placements)
    Ts = torch.stack([placement.T_jig_base for placement in placements])
    return build_planning_problem(ROBOT, found, Ts, found.q[::7], FREE, **options)


def random_problem(rows: int, parameters: int, seed: int) -> PlanningProblem:
    generator = torch.Generator().manual_seed(seed)
    A, W = (
        torch.randn(n, parameters, generator=generator, dtype=torch.float64) for n in (rows, parameters + 2)
    )
    return PlanningProblem(A, W.mT @ W, torch.full((parameters,), 1e-4, dtype=torch.float64))


def test_rows_are_derivatives_of_the_touched_coordinate():
    found = candidates(6)
    Ts = torch.stack([placement.T_jig_base for placement in PLACEMENTS])
    problem = problem_of(6, sigma=1e-3)
    assert problem.rows.shape == (12, len(FREE) + 3 + 12)
    space, step = ParameterSpace(ROBOT), 1e-6

    def coordinate(dh, tool, shift, turn) -> torch.Tensor:
        """Shift and turn are of every placement's robot, in the robot's frame."""
        T = forward_kinematics(ROBOT.with_geometry(dh=dh, tool=tool), found.q)
        moved = transform(rotation_from_vector(turn), shift)[found.placement]
        return (Ts[found.placement] @ moved @ T)[torch.arange(found.count), found.axis, 3]

    def changed(index: int, by: float) -> torch.Tensor:
        dh, tool = ROBOT.dh.copy(), ROBOT.tool.copy()
        shift, turn = torch.zeros(2, 3).double(), torch.zeros(2, 3).double()
        own = index - len(FREE) - 3
        if own >= 0:
            (shift if own % 6 < 3 else turn)[own // 6, own % 3] = by
        elif index >= len(FREE):
            tool[index - len(FREE)] += by
        else:
            flat = dh.reshape(-1)
            flat[space.index(FREE[index])] += by
        return coordinate(dh, tool, shift, turn)

    for index in range(problem.rows.shape[1]):
        slope = (changed(index, step) - changed(index, -step)) / (2 * step)
        assert_close(problem.rows[:, index], slope, atol=1e-8)


def test_the_criterion_is_the_mean_variance_of_the_tools_position():
    problem, chosen = problem_of(), torch.arange(0, 120, 3)
    generator = torch.Generator().manual_seed(0)
    L = torch.linalg.cholesky(problem.covariance(chosen))
    draws = torch.randn(40_000, len(L), generator=generator, dtype=torch.float64) @ L.mT
    squared = (draws @ problem.weight * draws).sum(-1).mean()
    assert_close(problem.criterion(chosen), squared, rtol=0.05)
    assert_close(problem.predicted_error(chosen), math.sqrt(problem.criterion(chosen)) / 1e3)


def test_more_touches_and_a_prior_never_predict_more():
    problem = problem_of()
    few, more = (problem.predicted_error(torch.arange(n)) for n in (100, 120))
    assert more <= few
    known = problem_of(prior=Prior(theta=1e-3, a=1e-3, d=1e-3))
    assert known.predicted_error(torch.arange(100)) < few


@pytest.mark.parametrize("seed", range(4))
def test_the_best_exchange_is_that_of_trying_them_all(seed: int):
    problem = random_problem(14, 4, seed)
    chosen = torch.tensor([1, 4, 6, 7, 11, 13])
    before = problem.criterion(chosen)
    tried = {}
    for out in range(len(chosen)):
        for into in set(range(14)) - set(chosen.tolist()):
            trial = chosen.clone()
            trial[out] = into
            tried[out, into] = before - problem.criterion(trial)
    gain, out, into = _best_exchange(problem, chosen)
    assert (out, into) == max(tried, key=tried.__getitem__)
    assert_close(gain, tried[out, into], rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_no_single_exchange_betters_a_plan(seed: int):
    problem = random_problem(20, 4, seed)
    plan = plan_measurements(problem, 8)
    gain, _, _ = _best_exchange(problem, plan.chosen)
    assert gain < 1e-3 * problem.criterion(plan.chosen)
    assert list(plan.path) == sorted(plan.path, reverse=True)
    assert_close(plan.path[-1], plan.predicted_error)
    assert_close(plan.predicted_error, problem.predicted_error(plan.chosen), rtol=1e-12)


def test_planned_touches_predict_much_less_than_random_ones():
    problem = problem_of(200)
    plan, again = plan_measurements(problem, 80), plan_measurements(problem, 80)
    assert torch.equal(plan.chosen, again.chosen)
    assert len(set(plan.chosen.tolist())) == 80
    assert bool((plan.chosen.diff() > 0).all())
    rng = np.random.default_rng(0)
    drawn = [problem.predicted_error(torch.from_numpy(rng.permutation(400)[:80])) for _ in range(20)]
    assert plan.predicted_error < 0.75 * np.mean(drawn)
    assert set(candidates(200).select(plan.chosen).frame) == {"right", "left"}


def test_a_third_jig_is_six_parameters_more():
    third = JigPlacement(name="middle", base={"x_mm": 700, "y_mm": 250, "roll_deg": 180})
    problem = problem_of(30, (*PLACEMENTS, third))
    assert problem.rows.shape == (90, len(FREE) + 3 + 18)
    assert len(plan_measurements(problem, 40).chosen) == 40
    assert_close(problem.weight[len(FREE) + 3 :].abs().max(), 0.0)


def test_all_candidates_can_be_planned():
    plan = plan_measurements(problem_of(20), 40)
    assert_close(plan.chosen, torch.arange(40))
    assert len(plan.path) == 1


def test_impossible_plans_are_refused():
    problem, found = random_problem(5, 2, 0), candidates(3)
    Ts = torch.stack([placement.T_jig_base for placement in PLACEMENTS])
    for count in (0, 6):
        with refused(IdentificationError, option="count", value=count):
            plan_measurements(problem, count)
    with refused(IdentificationError, option="workspace"):
        build_planning_problem(ROBOT, found, Ts, found.q[:0], FREE)
    with refused(IdentificationError, option="free", value="tool_x"):
        build_planning_problem(ROBOT, found, Ts, found.q, ("a_1", "tool_x"))
    with refused(IdentificationError, value="a_9"):
        build_planning_problem(ROBOT, found, Ts, found.q, ("a_9",))


def test_the_robots_own_base_does_not_matter():
    moved = ROBOT.with_geometry(base=np.array([0.1, -0.2, 0.3, 0.4, 0.1, 0.2]))
    found = candidates(10)
    Ts = torch.stack([transform_from_xyz_zyx(torch.from_numpy(p.base.to_si())) for p in PLACEMENTS])
    one, other = (build_planning_problem(r, found, Ts, found.q, FREE) for r in (ROBOT, moved))
    assert_close(one.rows, other.rows)
    assert_close(one.weight, other.weight)
