"""Features of joint corrections: values compared with formulas and peers, and restoration from descriptions."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.joint_correction.backlash import Backlash
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.feature import (
    FeatureOptions,
    angle_per_joint_value,
    product_unit_inputs,
    scaled_joints,
)
from pisigma.joint_correction.fourier_series import (
    BAND_SIZES,
    BAND_STARTS,
    FINE_BAND_STARTS,
    MANY_CONFIGURATIONS,
    FourierSeries,
)
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.registry import FEATURES, feature_from, feature_section
from pisigma.joint_correction.shared_features import NominalPose, ScaledJoints, SinesCosines
from pisigma.measurement.conditions import APPROACH, JointState
from pisigma.robot import Robot, Row
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import zyx_from_rotation
from pisigma.simulation.errors.joint_compliance import LinkMass, gravity_load

GRAVITY = (1.0, -2.0, -9.0)
CONDITIONS = ("payload_kg", "temperature_c")
MEASURED = ((0.0, 6.0), (12.0, 28.0))
SHARED = ("joints", "sin_cos", "pose")
ROBOTS = ("kiro3", "rb5", "panda")


def arm() -> Robot:
    """A robot with rows of every kind, two with direction -1, and one joint without limits."""
    rows = (
        Row("j1", "revolute", 1, -2.0, 1.0),
        Row("j2", "revolute", direction=-1),
        Row("bracket", "fixed"),
        Row("slide", "prismatic", -1, 0.1, 0.5),
        Row("j5", "revolute"),
    )
    rng = np.random.default_rng(3)
    return Robot("arm", "", "", rows, rng.normal(size=(5, 5)), rng.normal(size=6), rng.normal(size=6))


def joints(robot: Robot, *batch: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(*batch, robot.dof, generator=generator, dtype=torch.float64) - 1


def every_kind(robot: Robot) -> list:
    return [
        FourierSeries(robot, 5),
        GravityTorques(robot, GRAVITY),
        ConditionFeatures(robot, CONDITIONS, (3.0, 20.0), (1.5, 4.0), MEASURED, GRAVITY),
        *(FEATURES[name](robot) for name in SHARED),
        Backlash(robot),
        GearLines(robot, [(40, 7), *[()] * (robot.dof - 2), (21,)]),
    ]


def test_the_series_is_sines_and_cosines_of_the_joints_own_value():
    robot = arm()
    q = joints(robot, 7)
    columns = FourierSeries(robot, 3).columns(JointState(q))
    assert columns.shape == (7, 4, 6)
    for joint in (0, 1, 3):
        for k in (1, 2, 3):
            assert_close(columns[:, joint, k - 1], torch.sin(k * q[:, joint]), atol=1e-14)
            assert_close(columns[:, joint, 2 + k], torch.cos(k * q[:, joint]), atol=1e-14)
    assert_close(columns[:, 2, 0], torch.sin(torch.pi / 0.4 * q[:, 2]), atol=1e-13)  # travel of 0.4 m


def test_lines_are_sines_and_cosines_of_the_orders_of_each_joint():
    robot = arm()
    q = joints(robot, 7)
    lines = GearLines(robot, [(2_020,), (), (3, 405), ()])
    columns = lines.columns(JointState(q))
    assert lines.used.tolist() == [[True, False] * 2, [False] * 4, [True] * 4, [False] * 4]
    assert lines.highest_harmonic == 2_020
    assert_close(columns[:, 0, 0], torch.sin(2_020 * q[:, 0]), atol=1e-12)
    assert_close(columns[:, 0, 2], torch.cos(2_020 * q[:, 0]), atol=1e-12)
    angle = torch.pi / 0.4 * q[:, 2]  # travel of 0.4 m
    for place, values in enumerate(
        ((3 * angle).sin(), (405 * angle).sin(), (3 * angle).cos(), (405 * angle).cos())
    ):
        assert_close(columns[:, 2, place], values, atol=1e-11)


def test_the_period_of_an_unlimited_prismatic_joint_is_twice_the_reach():
    rows = (Row("slide", "prismatic"), Row("turn", "revolute"))
    robot = Robot("r", "", "", rows, np.array([[0, 0.3, 0.4, 0, 0], [0, 0, 1.5, 0, 0]]))
    assert_close(
        torch.from_numpy(angle_per_joint_value(robot)),
        torch.tensor([math.pi / 2.0, 1.0], dtype=torch.float64),
    )


@pytest.mark.parametrize(("fine", "starts"), [(False, BAND_STARTS), (True, FINE_BAND_STARTS)])
@pytest.mark.parametrize("harmonics", [1, 2, 5, 30])
def test_harmonics_share_prior_scales_in_bands(harmonics, fine, starts):
    series = FourierSeries(Robot.load("rb5"), harmonics, fine)
    assert series.column_count == 2 * harmonics
    assert bool(series.used.all())
    assert len(series.group_names) == int(series.group.max()) + 1
    bands = series.group[0, :harmonics]
    assert torch.equal(bands, series.group[3, harmonics:])
    for k in range(1, harmonics + 1):
        band = max(i for i, start in enumerate(starts) if start <= k)
        assert int(bands[k - 1]) == band
        assert series.usual_sizes[band] == BAND_SIZES[sum(start <= starts[band] for start in BAND_STARTS) - 1]
        first, last = (int(word) for word in series.group_names[band].split()[1::2])
        assert first <= k <= last <= harmonics


@pytest.mark.parametrize("more", [-1, 0])
def test_bands_are_fine_for_many_configurations(more):
    robot = Robot.load("rb5")
    options = FeatureOptions((8, 16), GRAVITY, MANY_CONFIGURATIONS + more)
    tried = FourierSeries.candidates(robot, options, JointState(torch.zeros(1, robot.dof)))
    expected = [FourierSeries(robot, k, fine=more == 0).group_names for k in (8, 16)]
    assert [series.group_names for series in tried] == expected


def test_gravity_columns_express_the_load_of_any_masses():
    robot = arm()
    features = GravityTorques(robot, GRAVITY)
    masses = {
        0: LinkMass(mass_kg=4, centre_mm=(100, -50, 30)),
        1: LinkMass(mass_kg=0.5, centre_mm=(10, 20, -30)),
        3: LinkMass(mass_kg=2, centre_mm=(-70, 0, 200)),
        4: LinkMass(mass_kg=1, centre_mm=(0, 300, 10)),
    }
    q = joints(robot, 3, 5)
    load = gravity_load(robot, q, masses, LinkMass(mass_kg=0), GRAVITY)
    weights = torch.zeros(4, 4, dtype=torch.float64)
    for place, row in enumerate(robot.joint_rows):
        centre = torch.tensor(masses[row].centre_mm, dtype=torch.float64) / 1e3
        weights[place] = masses[row].mass_kg * torch.cat(
            [torch.tensor([robot.reach], dtype=torch.float64), centre / features.ARM]
        )
    scale = float(np.linalg.norm(GRAVITY))
    columns = features.columns(JointState(q))
    turning = torch.tensor(robot.revolute)
    found = scale * (columns * weights.flatten()).sum(-1)
    assert_close(found[..., turning], load[..., turning], atol=1e-10)
    forces = torch.tensor([masses[row].mass_kg for row in robot.joint_rows]).double()
    found = scale * (columns[..., 2, ::4] * forces).sum(-1)
    assert_close(found, load[..., 2], atol=1e-10)
    assert float(load.abs().amax((0, 1)).min()) > 1.0


def test_masses_before_a_joint_have_no_weight():
    robot = arm()
    features = GravityTorques(robot, GRAVITY)
    columns = features.columns(JointState(joints(robot, 6)))
    assert_close(columns[:, ~features.used], 0.0)
    assert features.used[0].all()
    assert int(features.used[3].sum()) == 4


def test_columns_of_the_same_rows_are_computed_once():
    robot = arm()
    q, known = joints(robot, 5), []
    for gravity in (GRAVITY, (0.0, 1.0, 0.0)):
        feature = GravityTorques(robot, gravity)
        for values in (q, q[:3], q.flip(0)):
            known.append(feature.columns_of_rows(JointState(values)))
            assert torch.equal(known[-1], feature.columns(JointState(values)))
            assert GravityTorques(robot, gravity).columns_of_rows(JointState(values.clone())) is known[-1]
    assert len({one.data_ptr() for one in known}) == len(known)
    single = q[:4].float()  # half as many bytes
    assert torch.equal(feature.columns_of_rows(JointState(single)), feature.columns(JointState(single)))


def test_gravity_torques_do_not_depend_on_base_and_tool():
    robot = arm()
    bare = robot.with_geometry(base=np.zeros(6))
    q = joints(robot, 4)
    assert_close(
        GravityTorques(robot, GRAVITY).columns(JointState(q)),
        GravityTorques(bare, GRAVITY).columns(JointState(q)),
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_shared_features_are_the_same_for_every_joint(name):
    robot = Robot.load(name)
    q = joints(robot, 6)
    for choice in SHARED:
        columns = FEATURES[choice](robot).columns(JointState(q))
        assert_close(columns, columns[:, :1].expand_as(columns))
    assert_close(ScaledJoints(robot).columns(JointState(q))[:, 0], scaled_joints(robot, q))
    assert_close(SinesCosines(robot).columns(JointState(q))[:, 0], product_unit_inputs(robot, q))
    T = forward_kinematics(robot, q)
    pose = torch.cat([T[:, :3, 3] / robot.reach, zyx_from_rotation(T[:, :3, :3])], -1)
    assert_close(NominalPose(robot).columns(JointState(q))[:, 0], pose, atol=1e-14)


def test_unit_inputs_are_sines_cosines_and_prismatic_joints():
    robot = arm()
    q = joints(robot, 5)
    turning = q[:, [0, 1, 3]]
    slide = (q[:, 2:3] - 0.3) / 0.2
    assert_close(
        product_unit_inputs(robot, q), torch.cat([turning.sin(), turning.cos(), slide], -1), atol=1e-14
    )


def test_joints_are_scaled_to_their_limits():
    robot = arm()
    limits = torch.tensor([[-2.0, 0.0, 0.1, 0.0], [1.0, math.pi, 0.5, -math.pi]], dtype=torch.float64)
    ends = torch.tensor([[-1.0, 0.0, -1.0, 0.0], [1.0, 1.0, 1.0, -1.0]]).double()
    assert_close(scaled_joints(robot, limits), ends, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (3, 1, 2)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_and_types(batch, dtype):
    robot = arm()
    q = joints(robot, *batch).to(dtype)
    for features in every_kind(robot):
        columns = features.columns(JointState(q))
        assert columns.shape == (*batch, 4, features.column_count)
        assert columns.dtype == dtype
        flat = q.reshape(-1, 4)
        looped = [features.columns(JointState(one)) for one in flat]
        if looped:
            assert_close(columns.reshape(-1, 4, features.column_count), torch.stack(looped), atol=1e-5)


@pytest.mark.parametrize("name", [None, *ROBOTS])
def test_features_are_restored_from_their_descriptions(name):
    robot = arm() if name is None else Robot.load(name)
    stated = dict.fromkeys(CONDITIONS, torch.randn(9, dtype=torch.float64))
    state = JointState(joints(robot, 9), stated | {APPROACH: joints(robot, 9).sign()})
    for features in every_kind(robot):
        plain = features.describe().model_dump(mode="json")
        again = feature_from(robot, feature_section(plain))
        assert type(again) is type(features)
        assert torch.equal(again.columns(state), features.columns(state))
        assert torch.equal(again.used, features.used)
        assert torch.equal(again.group, features.group)
        assert again.describe() == features.describe()


def test_only_scaled_joints_change_with_full_turns():
    robot = arm()
    q = joints(robot, 5)
    turned = q + 2 * torch.pi * torch.tensor([1.0, -1.0, 0.0, 2.0]).double()
    for features in every_kind(robot):
        change = float((features.columns(JointState(turned)) - features.columns(JointState(q))).abs().max())
        assert (change < 1e-12) == features.is_periodic(np.ones(features.used.shape))


@pytest.mark.parametrize(
    ("description", "complaint"),
    [
        ({"name": "seris", "harmonics": 3}, "'seris'.*'series'"),
        ({}, "'None'"),
        ({"name": "series"}, r"harmonics\n.*type=missing"),
        ({"name": "gravity", "harmonics": 3}, r"harmonics\n.*type=extra_forbidden"),
        ({"name": "pose", "gravity": (0, 0, -1)}, r"gravity\n.*type=extra_forbidden"),
        (
            {
                "name": "conditions",
                "names": (),
                "mean": (),
                "spread": (),
                "measured": (),
                "gravity": (0.0, 0.0, 1.0),
            },
            r"names\n.*type=too_short",
        ),
        (
            {
                "name": "conditions",
                "names": ("temperature_c",),
                "mean": (20.0,),
                "spread": (2.0,),
                "measured": ((21.0, 25.0),),
                "gravity": (0.0, 0.0, 1.0),
            },
            r"\(21.0, 25.0\)",
        ),
        ({"name": "series", "harmonics": 0}, "type=greater_than_equal"),
        ({"name": "lines", "orders": ((),) * 6}, "6 joints"),
        ({"name": "lines", "orders": ((256,),)}, "6 joints"),
        ({"name": "lines", "orders": ((0,), *((),) * 5)}, "type=greater_than_equal"),
        ({"name": "gravity", "gravity": (0.0, 0.0, 0.0)}, r"got \(0.0, 0.0, 0.0\)"),
        ({"name": "gravity", "gravity": (0.0, math.nan, 0.0)}, "type=finite_number"),
    ],
)
def test_invalid_descriptions_are_rejected(description, complaint):
    with pytest.raises(ValueError, match=complaint):
        feature_from(Robot.load("rb5"), feature_section(description))


@pytest.mark.parametrize("orders", [(), (2,), (2, 3)])
def test_the_correction_agrees_with_its_formula(orders):
    robot = arm()
    features = (FourierSeries(robot, 2), GravityTorques(robot))
    correction = JointCorrection(robot, features, orders)
    q = joints(robot, 6)
    assert_close(correction(q), 0.0)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in correction.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    phi = product_unit_inputs(robot, q)
    for j in range(robot.dof):
        expected = torch.zeros(6, dtype=torch.float64)
        for chosen, weight in zip(features, correction.linear, strict=True):
            expected = expected + chosen.columns(JointState(q))[:, j] @ weight[j]
        start = 0
        for order in orders:
            product = torch.ones(6, dtype=torch.float64)
            for s in range(start, start + order):
                product = product * (correction.bias[j, s] + phi @ correction.weight[j, s])
            expected, start = expected + product, start + order
        assert_close(correction(q)[:, j], expected, atol=1e-12)


def test_units_of_one_factor_are_rejected():
    with pytest.raises(ValueError, match=r"\(2, 1\)"):
        JointCorrection(arm(), (), (2, 1))
