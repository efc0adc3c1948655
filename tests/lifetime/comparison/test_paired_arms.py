"""A joint zero that differs between leader and follower is named with sign and arm, and nothing else is."""

import functools
import math

import numpy as np
import pytest
import torch
from testing.lerobot_arm import MOTORS, so101_model
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.lifetime.comparison.paired_arms import compare_paired_arms, estimate_zero_changes

SERVO, ROWS = math.radians(0.5), 60
NAMES = MOTORS[:5]
MODEL = functools.cache(so101_model)


def session(seed, moved=None, joint=0, degrees=0.0, positions=("leader", "follower")):
    """Compare arms in the same true postures; servos repeat to 0.5 deg, and positions are measured to 1 mm."""
    random = np.random.default_rng(seed)
    low, high = np.clip(MODEL().robot.limits, -1.5, 1.5).T
    true = random.uniform(low, high, (ROWS, 5))
    logs, zeros = {}, {}
    for arm in ("leader", "follower"):
        offset = np.zeros(5)
        offset[joint] = math.radians(degrees) if arm == moved else 0.0
        logs[arm] = true - offset + SERVO * random.normal(size=true.shape)
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
        named = [(one.joint, one.moved) for one in found if one.differs]
        assert named == [(NAMES[joint], moved)]
        expected = 2.0 * sign * (1 if moved == "leader" else -1)
        error = math.degrees(found[joint].value) - expected
        assert abs(error) < 5 * math.degrees(found[joint].standard_error)


def test_arms_that_agree_raise_no_alarm():
    assert not [one for seed in range(40) for one in session(100 + seed, positions=()) if one.differs]


def test_without_positions_the_arm_is_unknown():
    """Positions on the axis of the last joint do not show its zero."""
    assert session(3, "leader", 1, 2.0, ())[1].moved == "unknown"
    assert [one.moved for one in session(3, "leader", 4, 2.0)][4] in ("unknown", "leader")


def test_rows_that_do_not_fit_are_refused():
    rows = np.zeros((20, 5))
    with refused(MeasurementError, option="leader, follower"):
        compare_paired_arms(rows, rows[:, :4], NAMES)
    with refused(MeasurementError, option="leader"):
        compare_paired_arms(rows[:9], rows[:9], NAMES)
