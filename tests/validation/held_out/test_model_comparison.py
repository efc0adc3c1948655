"""Models compared on the same rows: errors, domain, references, and figures against numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.refusals import refused
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.files.errors import IdentificationError, MeasurementError, ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import nominal_poses_of_rows, poses_of_rows
from pisigma.model.geometric_model import model_of_calibration, model_of_hybrid
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, rotation_vector, transform_from_xyz_zyx
from pisigma.validation.held_out.model_comparison import compare_models, inside_domain
from pisigma.validation.held_out.reference_models import geometric_model, nominal_model
from pisigma.validation.resampling import Bootstrap

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module")
def arm():
    """A simulated UR5 with poses measured, and the model of its geometric calibration."""
    with no_type_checker():
        found = simulate("ur5", rows=90, noise=5e-5, turn_noise=1e-4)
        result = GeometricCalibrator(found.nominal).fit(found.measurements)
    return found, model_of_calibration("ur5", found.nominal, result, found.measurements)


@pytest.fixture(scope="module")
def unseen():
    """Other rows of the same robot, every configuration measured twice, some without orientation or position."""
    found = simulate("ur5", rows=90, noise=5e-5, turn_noise=1e-4).true
    q = joints_in(found, 60, seed=3).repeat(2, 1)
    rng = np.random.default_rng(4)
    T = forward_kinematics(found, q)
    position = T[:, :3, 3] + 1e-4 * torch.from_numpy(rng.normal(size=(120, 3)))
    rotation = T[:, :3, :3].clone()
    rotation[:7], position[10:12] = torch.nan, torch.nan
    return Measurements(q=q, position=position, rotation=rotation)


def test_figures_agree_with_numpy(arm, unseen):
    _, model = arm
    models = {"nominal": nominal_model(model, True), "own": model}
    report = compare_models(models, unseen, Bootstrap(50)).to_json()
    assert (report["rows_compared"], report["rows_without_position"]) == (118, 2)
    assert report["configurations"] == 60
    for found, one in zip(report["models"], models.values(), strict=True):
        T = poses_of_rows(one, unseen)
        vectors = 1e3 * (unseen.position - T[:, :3, 3]).numpy()
        vectors = vectors[np.isfinite(vectors).all(1)]
        sizes = np.linalg.norm(vectors, axis=1)
        assert_close(found["rms_mm"], np.sqrt((sizes**2).mean()), rtol=1e-12)
        assert_close(found["mean_mm"], sizes.mean(), rtol=1e-12)
        assert_close(found["p95_mm"], np.quantile(sizes, 0.95), rtol=1e-12)
        assert_close(found["max_mm"], sizes.max(), rtol=1e-12)
        for index, axis in enumerate("xyz"):
            assert_close(found["axes"][axis]["mean_mm"], vectors[:, index].mean(), atol=1e-12)
            assert_close(found["axes"][axis]["rms_mm"], np.sqrt((vectors[:, index] ** 2).mean()), rtol=1e-12)
        turned = torch.isfinite(unseen.rotation).flatten(1).all(1) & torch.isfinite(unseen.position).all(1)
        R = (unseen.rotation @ T[:, :3, :3].mT)[turned]
        angles = np.rad2deg(rotation_vector(R).norm(dim=-1).numpy())
        assert_close(found["mean_deg"], angles.mean(), rtol=1e-12)
        assert_close(found["max_deg"], angles.max(), rtol=1e-12)
        low, high = found["intervals"]["rms_mm"]
        assert low < found["rms_mm"] < high
    first, second = report["models"]
    difference = second["difference_to_first"]["position"]
    assert "difference_to_first" not in first
    assert_close(difference["rms_mm"], second["rms_mm"] - first["rms_mm"], rtol=1e-12)
    assert difference["rms_mm_interval"][1] < 0


def rms_of(model, rows: Measurements) -> float:
    """Root mean square of the position errors [m]."""
    return float((rows.position - poses_of_rows(model, rows)[:, :3, 3]).square().sum(-1).mean().sqrt())


def test_the_nominal_model_is_the_nominal_arm_with_base_and_tool_that_suit_it():
    """Fitted through the model at its training rows it is what a fit to these rows themselves gives, nearly."""
    true = simulate("ur5", rows=1, length=1e-3, angle=2e-3).true
    robot = Robot.load("ur5")
    q = joints_in(true, 80, seed=1, share=0.25)
    noise = 5e-5 * torch.from_numpy(np.random.default_rng(2).normal(size=(80, 3)))
    rows = Measurements(q=q, position=forward_kinematics(true, q)[:, :3, 3] + noise)
    model = model_of_calibration("ur5", robot, GeometricCalibrator(robot).fit(rows), rows)
    nominal = nominal_model(model, False)
    assert np.array_equal(nominal.calibrated.dh, robot.dh)
    best = float(
        (rows.position - forward_kinematics(fit_base_and_tool(robot, rows).robot, q)[:, :3, 3])
        .square()
        .sum(-1)
        .mean()
        .sqrt()
    )
    assert best <= rms_of(nominal, rows) < 1.02 * best
    theirs = (rows.position - nominal_poses_of_rows(model, rows)[:, :3, 3]).square().sum(-1).mean().sqrt()
    assert float(theirs) > 1.2 * best  # base and tool that go with the other geometry


def test_nominal_of_several_frames_and_targets():
    true, robot = simulate("kiro4", rows=1).true, Robot.load("kiro4")
    q = joints_in(true, 90, seed=1)
    T_wall, T_ball = transform_from_xyz_zyx(
        torch.tensor([[0.5, -0.3, 0.2, 0.4, -0.2, 1.0], [0.05, 0.1, -0.04, 0, 0, 0]]).double()
    )
    number = torch.arange(90)
    T = forward_kinematics(true, q)
    T = torch.where((number % 2 == 1)[:, None, None], invert(T_wall) @ T, T)
    T = torch.where((number // 2 % 2 == 1)[:, None, None], T @ T_ball, T)
    rows = Measurements(
        q=q,
        position=T[:, :3, 3].clone(),
        frame=tuple(("floor", "wall")[k] for k in (number % 2).tolist()),
        target=tuple(("A", "B")[k] for k in (number // 2 % 2).tolist()),
    )
    model = model_of_calibration("kiro4", robot, GeometricCalibrator(robot).fit(rows), rows)
    nominal = nominal_model(model, False)
    assert (set(nominal.bases), set(nominal.tools)) == ({"floor", "wall"}, {"A", "B"})
    found = compare_models({"nominal": nominal, "geometric": model}, rows, Bootstrap(20))
    sizes = [figures.position.statistics["rms"] for figures in found.models]
    assert 0.1 < sizes[0] < 10
    assert sizes[1] < 0.01


def test_a_model_with_nominal_geometry_has_its_base_and_tool():
    model = hand_made_model("kiro4")
    q = joints_around("kiro4", 5)
    assert_close(nominal_model(model, True).forward(q), forward_kinematics(model.robot, q))
    with refused(ModelError, value=model.kind):
        geometric_model(model)


def test_a_model_without_joint_values_has_no_nominal(arm):
    with refused(ModelError, value=1):
        nominal_model(replace(arm[1], starts=arm[1].starts[:1]), False)


def test_inside_and_outside_of_a_hybrid():
    arm = hybrid_of("kiro4", share=0.5)
    model = model_of_hybrid("kiro4", arm.true.nominal, arm.result, arm.measurements)
    q = joints_in(arm.true.nominal, 200, seed=7)
    rows = Measurements(q=q, position=arm.true.forward(q)[:, :3, 3])
    inside = inside_domain(model, rows)
    assert torch.equal(inside, model.hybrid.coverage.contains(q))
    assert 0 < int(inside.sum()) < 200
    report = compare_models({"kiro4": model}, rows, Bootstrap(20)).to_json()["models"][0]
    errors = 1e3 * (rows.position - model.forward(q)[:, :3, 3]).norm(dim=-1).numpy()
    for name, part in (("inside_domain", inside.numpy()), ("outside_domain", ~inside.numpy())):
        assert report[name]["rows"] == part.sum()
        assert_close(report[name]["rms_mm"], np.sqrt((errors[part] ** 2).mean()), rtol=1e-12)


def test_inside_and_outside_of_a_network():
    """Commanded joint values are in the domain where the nominal ones are that are corrected to them."""
    model = hand_made_model("kiro4")
    near, far = joints_around("kiro4", 30, seed=5, spread=0.1), joints_around("kiro4", 30, seed=6, spread=2.0)
    q_nominal = torch.cat([near, far])
    T = forward_kinematics(model.robot, q_nominal)
    commanded = q_nominal + model.correction(T, q_nominal)
    wanted = model.domain.contains(model.network.scaled_inputs(T, q_nominal))
    rows = Measurements(q=commanded, position=T[:, :3, 3].clone())
    assert torch.equal(inside_domain(model, rows), wanted)
    assert 0 < int(wanted.sum()) < 60
    assert inside_domain(replace(model, domain=None), rows) is None


def test_rows_that_one_model_does_not_predict_are_excluded_for_all():
    model, steep = hand_made_model("kiro3"), hand_made_model("kiro3")
    steep.network.networks[0].output_scale.fill_(3.0)
    q = joints_around("kiro3", 80, spread=1.0)
    rows = Measurements(q=q, position=model.forward(q)[:, :3, 3])
    found = compare_models({"good": model, "steep": steep}, rows, Bootstrap(20))
    good, bad = found.models
    assert good.rows_not_predicted == 0
    assert 0 < bad.rows_not_predicted < 80
    assert found.rows == 80 - bad.rows_not_predicted
    errors = (rows.position - poses_of_rows(model, rows)[:, :3, 3]).norm(dim=-1)
    predicted = poses_of_rows(steep, rows).isfinite().all(-1).all(-1)
    assert_close(good.position.statistics["mean"], 1e3 * float(errors[predicted].mean()), atol=1e-12)


def test_rows_without_comparable_values_are_refused(arm):
    _, model = arm
    q = joints_around("ur10", 3)
    with pytest.raises(IdentificationError):
        compare_models(
            {"m": model},
            Measurements(q=q, distance=torch.ones(3).double(), anchor=("a", "a", "a")),
        )
    with refused(MeasurementError, expected="positions, balls in sockets, wires, pairs or touches"):
        compare_models({"m": model}, Measurements(q=q, position=torch.full((3, 3), torch.nan).double()))


def compared(better: np.ndarray, worse: np.ndarray, bootstrap: Bootstrap, repeats: int = 1):
    """Compare two models whose position errors along x are these [m]; configurations are measured several times."""
    count = len(worse)
    still = hand_made_model("kiro4", scale=0.0)
    q = joints_around("kiro4", count // repeats, seed=1).repeat_interleave(repeats, 0)
    T = forward_kinematics(still.robot, q)
    rows = Measurements(
        q=q, position=T[:, :3, 3] + torch.from_numpy(worse)[:, None] * torch.tensor([1.0, 0, 0])
    )
    shift = float(worse[0] - better[0])
    base = still.robot.base.copy()
    base[0] += shift
    shifted = replace(still, robot=still.robot.with_geometry(base=base))
    return compare_models({"first": still, "second": shifted}, rows, bootstrap)


def test_differences_are_paired():
    """A micrometre less on every row shows, however much rows differ; and equal models differ by nothing."""
    worse = np.random.default_rng(0).gamma(3.0, 1e-4, 100) + 1e-5
    found = compared(worse - 1e-6, worse, Bootstrap(100), repeats=2)
    assert found.configurations == 50
    difference = found.models[1].position.difference
    assert_close(difference.statistics["mean"], -1e-3, rtol=1e-6)
    assert difference.intervals["mean"][1] < 0
    assert difference.better_share == 1.0
    assert difference.test.pairs == 50
    assert difference.test.p < 1e-8
    same = compared(worse, worse, Bootstrap(100)).models[1].position.difference
    assert same.intervals["rms"] == (0.0, 0.0)
    assert (same.better_share, same.test.p) == (0.0, 1.0)
    assert same.to_json("mm")["mean_mm_interval"] == (0.0, 0.0)


def test_one_configuration_has_no_interval():
    worse = np.random.default_rng(0).gamma(3.0, 1e-4, 6)
    found = compared(worse, worse, Bootstrap(10), repeats=6)
    assert found.models[0].position.intervals == {"mean": None, "rms": None, "p95": None}
    assert found.to_json()["models"][1]["difference_to_first"]["position"]["mean_mm_interval"] is None
