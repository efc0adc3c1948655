"""Sessions over months: drift with time and temperature, and forecasts."""

import math
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close

from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.monitoring.session import JointZeros, SessionResult
from pisigma.lifetime.monitoring.trends import charts_of, forecast_of, jumps_of, trends_of
from pisigma.robot.row import Row

JOINTS = (Row("theta_1", "revolute"), Row("d_2", "prismatic"))
DEVIATION = 4e-5


def records(months, per_month=0.0, per_kelvin=0.0, rms=lambda month: 1e-4, warm=lambda month: None):
    noise = torch.randn(months, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    made = []
    for month in range(months):
        temperature = warm(month)
        shift = DEVIATION * noise[month]
        shift[0] += math.radians(per_month) * month + math.radians(per_kelvin) * (temperature or 0.0)
        session = SessionResult(10, 0.9, (), (), rms(month), rms(month), 1.0, 1.0, 30, (), (True, month != 1))
        zeros = JointZeros(
            shift,
            torch.full((2,), DEVIATION).double(),
            torch.zeros(2, 3).double(),
            DEVIATION**2 * torch.eye(2).double(),
        )
        made.append(
            Record(f"{month}.csv", f"2026-{month + 1:02d}-01", str(month), temperature, session, zeros)
        )
    return made


def test_a_drift_is_charted_and_measured():
    drifting = records(8, per_month=0.01)
    joint, other, error = charts_of(JOINTS, drifting)
    assert (joint.quantity, joint.unit, other.unit, error.unit) == ("joint 1", "deg", "mm", "mm")
    assert joint.alarm is not None
    assert joint.alarm <= 4
    assert other.alarm is error.alarm is None
    assert bool(other.values[1].isnan())
    clear = [one for one in trends_of(JOINTS, drifting) if one.is_significant]
    assert [(one.quantity, one.per) for one in clear] == [("joint 1", "month")]
    low, high = clear[0].interval
    assert low < 0.01 < high


def test_zeros_count_in_the_direction_of_the_joint():
    reversed_joints = (replace(JOINTS[0], direction=-1), JOINTS[1])
    drifting, jumped = records(8, per_month=0.01), records(10)
    for record in jumped[6:]:
        record.zeros.shift[0] += math.radians(0.05)
    plain, turned = ([charts_of(j, drifting), trends_of(j, drifting)] for j in (JOINTS, reversed_joints))
    assert_close(turned[0][0].values, -plain[0][0].values)
    assert turned[0][0].alarm == plain[0][0].alarm
    assert turned[1][0].slope == pytest.approx(-plain[1][0].slope)
    assert jumps_of(reversed_joints, jumped)[0].size == pytest.approx(-jumps_of(JOINTS, jumped)[0].size)


def test_a_jump_is_not_a_drift():
    made = records(10)
    for record in made[6:]:
        record.zeros.shift[0] += math.radians(0.05)
    (jump,) = jumps_of(JOINTS, made)
    assert (jump.quantity, jump.before, jump.after) == ("joint 1", "2026-06-01", "2026-07-01")
    assert_close(jump.size, 0.05, atol=0.005)
    assert not [one for one in trends_of(JOINTS, made) if one.is_significant]
    assert jumps_of(JOINTS, records(8, per_month=0.01)) == jumps_of(JOINTS, records(8)) == ()


@pytest.mark.parametrize(
    ("off", "changes"),
    [
        ({4: 0.05}, [("2026-05-01", True, 0.05)]),
        ({9: 0.05}, [("2026-10-01", False, 0.05)]),
        ({3: 0.05, 4: 0.05, 5: 0.05}, [("2026-04-01", False, 0.05), ("2026-07-01", False, -0.05)]),
        (
            {3: 0.05, 4: 0.05, 5: 0.05, 6: 0.05, 7: 0.1, 8: 0.1, 9: 0.1},
            [("2026-04-01", False, 0.05), ("2026-08-01", False, 0.05)],
        ),
    ],
    ids=["one session", "last session", "three sessions", "twice"],
)
@pytest.mark.parametrize("per_month", [0.0, 0.01])
def test_jumps_and_outliers_are_distinguished_from_a_drift(off, changes, per_month):
    made = records(10, per_month=per_month)
    for month, size in off.items():
        made[month].zeros.shift[0] += math.radians(size)
    found = jumps_of(JOINTS, made)
    assert [(one.quantity, one.after, one.has_reverted) for one in found] == [
        ("joint 1", *one[:2]) for one in changes
    ]
    for one, (_, _, size) in zip(found, changes, strict=True):
        assert_close(one.size, size, atol=0.012)
    clear = [one for one in trends_of(JOINTS, made) if one.is_significant]
    assert len(clear) == (per_month > 0)


def test_a_jump_of_the_error_is_not_extrapolated():
    made = records(10, rms=lambda month: 1e-4 * (1 + 0.1 * math.sin(9 * month)) + 4e-4 * (month >= 7))
    assert forecast_of(made, 1.0).date is None


def test_warming_is_not_a_drift_with_time():
    warmed = records(10, per_kelvin=0.002, warm=lambda month: 20.0 + 8.0 * math.sin(month))
    clear = [one for one in trends_of(JOINTS, warmed) if one.is_significant]
    assert [(one.quantity, one.per) for one in clear] == [("joint 1", "kelvin")]
    assert_close(clear[0].slope, 0.002, rtol=0.3)


def test_few_sessions_do_not_determine_a_drift():
    assert trends_of(JOINTS, records(3, per_month=0.1)) == ()


@pytest.mark.parametrize(
    ("slope", "limit", "exceeded", "date"),
    [(0.0, 0.5, False, None), (2e-5, 0.5, False, "2026-1"), (2e-5, 0.2, True, None)],
)
def test_a_limit_is_forecast(slope, limit, exceeded, date):
    forecast = forecast_of(records(10, rms=lambda month: 3e-4 + slope * month), limit)
    if date is None:
        assert forecast.date is None
    else:
        assert forecast.date.startswith(date)
        assert forecast.earliest <= forecast.date
    assert forecast.limit_exceeded is exceeded
    assert forecast.sentence.endswith(".")
