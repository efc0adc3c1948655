"""A joint zero that differs between leader and follower is named with sign and arm, and nothing else is."""

import functools
import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.lerobot_arm import MOTORS, so101_model
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.lifetime.comparison.paired_arms import compare_paired_arms, estimate_zero_changes

SERVO, ROWS = math.radians(0.5), 60
NAMES = MOTORS[:5]
MODEL = functools.cache(so101_model)


def session(seed, moved=None, joint=0, degrees=(0.0, 0.0), positions=("leader", "follower"), servo=SERVO):
    """Compare arms in the same true postures; servos repeat to 0.5 deg, and positions are measured to 1 mm.

    `degrees` is the change of the arm `moved`, or a pair of changes of leader and follower.
    """
    random = np.random.default_rng(seed)
    low, high = np.clip(MODEL().robot.limits, -1.5, 1.5).T
    true = random.uniform(low, high, (ROWS, 5))
    logs, zeros = {}, {}
    for index, arm in enumerate(("leader", "follower")):
        offset = np.zeros(5)
        offset[joint] = math.radians(degrees[index] if moved is None else degrees if arm == moved else 0.0)
        logs[arm] = true - offset + servo * random.normal(size=true.shape)
        measured = MODEL().forward(torch.from_numpy(true))[:, :3, 3].numpy()
        if arm in positions:
            noisy = measured + 1e-3 * random.normal(size=measured.shape)
            zeros[f"{arm}_zeros"] = estimate_zero_changes(MODEL(), logs[arm], noisy)
    return compare_paired_arms(logs["leader"], logs["follower"], NAMES, **zeros)


@pytest.mark.parametrize("seed", range(20))
def test_a_difference_of_2_deg_is_named_with_its_sign_and_arm(seed):
    joint, sign, moved = seed % 4, (-1) ** (seed // 2), ("leader", "follower")[seed % 2]
    for positions in (("leader", "follower"), ("follower",)):
        found = session(seed, moved, joint, 2.0 * sign, positions)
        named = [(one.joint, one.moved_arm) for one in found if one.verdict == "different"]
        assert named == [(NAMES[joint], moved)]
        expected = 2.0 * sign * (1 if moved == "leader" else -1)
        error = math.degrees(found[joint].follower_minus_leader) - expected
        assert abs(error) < 5 * math.degrees(found[joint].standard_error)


def test_arms_that_agree_raise_no_alarm():
    found = [one.verdict for seed in range(40) for one in session(100 + seed, positions=())]
    assert "different" not in found
    assert found.count("same") > 0.8 * len(found)


def test_rows_that_are_too_few_or_too_noisy_show_neither_a_difference_nor_agreement():
    noisy = session(0, positions=(), servo=math.radians(5.0))
    assert {one.verdict for one in noisy} == {"unknown"}
    assert {one.moved_arm for one in noisy} == {None}


@pytest.mark.parametrize(
    ("changes", "positions", "moved"),
    [
        ((2.0, -2.0), ("leader", "follower"), "both"),
        ((2.0, -2.0), ("follower",), "both"),
        ((-3.0, 3.0), ("leader",), "both"),
    ],
)
def test_an_arm_that_the_measurement_excludes_is_not_named(changes, positions, moved):
    one = session(5, None, 1, changes, positions)[1]
    assert (one.verdict, one.moved_arm) == ("different", moved)


def test_full_turns_are_no_difference():
    random = np.random.default_rng(0)
    leader = random.uniform(2.9, 3.3, (ROWS, 1))
    follower = leader + math.radians(2.0) + SERVO * random.normal(size=leader.shape)
    for turns in (0.0, 2 * math.pi, -2 * math.pi * random.integers(0, 2, leader.shape)):
        (one,) = compare_paired_arms(leader, follower + turns, ("roll",))
        assert one.verdict == "different"
        assert_close(one.follower_minus_leader, math.radians(2.0), atol=math.radians(0.5))


def test_without_positions_the_arm_is_unknown():
    """Positions on the axis of the last joint do not show its zero."""
    assert session(3, "leader", 1, 2.0, ())[1].moved_arm == "unknown"
    assert [one.moved_arm for one in session(3, "leader", 4, 2.0)][4] in ("unknown", "leader")


def test_rows_that_do_not_fit_are_refused():
    rows = np.zeros((20, 5))
    with refused(MeasurementError, option="leader, follower"):
        compare_paired_arms(rows, rows[:, :4], NAMES)
    with refused(MeasurementError, option="leader"):
        compare_paired_arms(rows[:9], rows[:9], NAMES)
    same = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    with refused(MeasurementError, option="leader, follower"):
        compare_paired_arms(same, same.copy(), ("q1", "q2"))


def test_positions_that_the_arm_cannot_have_are_refused():
    random = np.random.default_rng(0)
    q = random.uniform(-1, 1, (20, 5))
    position = MODEL().forward(torch.from_numpy(q))[:, :3, 3].numpy()
    exact = estimate_zero_changes(MODEL(), q - math.radians(2.0), position)
    assert_close(exact.values, np.full(5, math.radians(2.0)), atol=1e-6)
    for wrong in (position * 1e3, position + 0.1, position[::-1]):
        with refused(MeasurementError, option="position"):
            estimate_zero_changes(MODEL(), q, wrong)
    with refused(MeasurementError, option="q, position"):
        estimate_zero_changes(MODEL(), q[:, :4], position)
    with refused(MeasurementError, option="q, position"):
        estimate_zero_changes(MODEL(), q, position[:9])
    position[3, 1] = np.nan
    with refused(MeasurementError, option="position"):
        estimate_zero_changes(MODEL(), q, position)
