"""A correction prepared for many joint values gives what the correction itself does."""

import pytest
import torch
from testing.calibrated_arm import joints_of, random_correction
from testing.closeness import assert_close

from pisigma.joint_correction.batched_correction import BatchedCorrection
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.series_evaluation import SeriesTable
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot


@pytest.mark.parametrize("name", ["ur5", "kiro3", "panda"])
@pytest.mark.parametrize("shared", [(), ("sin_cos",), ("joints", "pose"), ("sin_cos", "joints")], ids=str)
@pytest.mark.parametrize("rows", [0, 1, 50])
def test_it_is_the_same_correction(name, shared, rows):
    robot = Robot.load(name)
    correction = random_correction(robot, shared)
    q = 3 * joints_of(robot, 50)[:rows]
    delta, slope = BatchedCorrection(correction)(q.T.contiguous(), slope=True)
    assert delta.shape == slope.shape == (robot.dof, rows)
    assert_close(delta.T, correction(q), atol=1e-14)
    if rows:
        assert float(delta.abs().max()) > 1e-4


@pytest.mark.parametrize(
    "gravity",
    [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.3, -0.5, -0.8), (-0.6, 0.0, 0.8)],
    ids=str,
)
@pytest.mark.parametrize("name", ["ur5", "kiro3"])
def test_gravity_may_fall_anywhere(name, gravity):
    robot = Robot.load(name)
    torques = GravityTorques(robot, gravity)
    correction = JointCorrection(robot, [torques])
    generator = torch.Generator().manual_seed(3)
    weight = torch.randn(torques.used.shape, generator=generator, dtype=torch.float64)
    weight[:, 5] = 0.0
    correction.linear[0].data.copy_(weight)
    q = 3 * joints_of(robot, 20)
    delta, _ = BatchedCorrection(correction)(q.T.contiguous())
    assert float(delta.abs().max()) > 0.1
    assert_close(delta.T, correction(q), atol=1e-13)


def test_the_slope_is_that_of_the_series():
    robot = Robot.load("kiro3")
    correction = random_correction(robot)
    series = next(features for features in correction.features if isinstance(features, FourierSeries))
    weight, q = correction.linear[0], joints_of(robot, 20)
    ends = [(series.columns(JointState(q + step)) * weight).sum(-1) for step in (1e-6, -1e-6)]
    _, slope = BatchedCorrection(correction)(q.T.contiguous(), slope=True)
    assert_close(slope.T, (ends[0] - ends[1]) / 2e-6, atol=1e-9)


@pytest.mark.parametrize("harmonics", [1, 7, 110, 256])
def test_a_table_is_as_good_as_the_sum(harmonics):
    generator = torch.Generator().manual_seed(harmonics)
    a, b = torch.randn(2, 3, harmonics, generator=generator, dtype=torch.float64) / harmonics
    angle = 20 * torch.randn(3, 500, generator=generator, dtype=torch.float64)
    angle[0, :4] = torch.tensor([0.0, torch.pi, -torch.pi, 2 * torch.pi])
    k = torch.arange(1, harmonics + 1, dtype=torch.float64)
    sine, cosine = (angle[..., None] * k).sin(), (angle[..., None] * k).cos()
    value = (a[:, None] * sine + b[:, None] * cosine).sum(-1)
    slope = (k * (a[:, None] * cosine - b[:, None] * sine)).sum(-1)
    table = SeriesTable(a, b)
    assert_close(table(angle), value, atol=2e-11)
    found, rise = table.with_slope(angle)
    assert_close(found, value, atol=2e-11)
    assert_close(rise, slope, atol=1e-8 * harmonics)
