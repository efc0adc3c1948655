"""Corrected inverse kinematics at a payload and temperature agrees with predictions of rows that state them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.identified import hybrid_model
from testing.models import joints_around
from testing.refusals import numbers_in, refused

from pisigma.files.errors import ModelError
from pisigma.joint_correction.conditions import ConditionFeatures, learned_conditions
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.shared_features import ScaledJoints
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.model.folder.model_folder import save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.stated_conditions import condition_warnings, mean_conditions, under_stated_conditions
from pisigma.reporting.page.content import report_content
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.verify import verify

pytestmark = pytest.mark.usefixtures("without_type_checker")

MEASURED = ((0.0, 5.0), (15.0, 35.0))
"""Measured payloads [kg] and temperatures [deg C]."""
SIDEWAYS = (0.6, 0.0, -0.8)
"""Direction of gravity of a robot that is mounted on a slope."""
BESIDE = {
    "nothing": lambda robot: [],
    "all": lambda robot: [GravityTorques(robot), FourierSeries(robot, 5), ScaledJoints(robot)],
    "other gravity": lambda robot: [FourierSeries(robot, 1), GravityTorques(robot, SIDEWAYS)],
}


def model_with(name: str, beside: str, orders: tuple[int, ...] = ()) -> CalibratedModel:
    """A model with random weights, including those of both conditions."""
    robot = Robot.load(name)
    learned = ConditionFeatures(robot, ("payload_kg", "temperature_c"), (2.0, 25.0), (1.5, 6.0), MEASURED)
    return hybrid_model(name, [*BESIDE[beside](robot), learned], orders=orders)


def rows_under(q: torch.Tensor, payload: float, temperature: float) -> Measurements:
    one = torch.ones(len(q), dtype=torch.float64)
    return Measurements(q=q, payload=payload * one, temperature=temperature * one)


@pytest.mark.parametrize("name", ["kiro4", "kiro3"])  # kiro3 has a joint that slides
@pytest.mark.parametrize("beside", BESIDE)
@pytest.mark.parametrize(("payload", "temperature"), [(5.0, 18.0), (2.0, 25.0), (0.0, 40.0)])
def test_poses_are_those_of_rows_that_state_the_conditions(
    name: str, beside: str, payload: float, temperature: float
) -> None:
    model = model_with(name, beside, orders=(2,) if beside == "all" else ())
    under = under_stated_conditions(model, payload, temperature)
    q = joints_around(name, 50, seed=3, spread=0.8)
    expected = poses_of_rows(model, rows_under(q, payload, temperature))
    assert_close(under.forward(q), expected, atol=1e-14)
    usual = (payload, temperature) == (2.0, 25.0)
    assert (float((expected - model.forward(q)).abs().max()) > 1e-6) is not usual


def test_conditions_that_are_not_given_are_the_mean_ones() -> None:
    model = model_with("kiro4", "all")
    q = joints_around("kiro4", 20, seed=3)
    under = under_stated_conditions(model, temperature_c=31.0)
    assert_close(under.forward(q), poses_of_rows(model, rows_under(q, 2.0, 31.0)), atol=1e-14)
    assert under.conditions == {"payload_kg": 2.0, "temperature_c": 31.0}
    assert under_stated_conditions(model) is model


@pytest.mark.parametrize("name", ["kiro4", "kiro3"])
def test_both_routes_reach_poses_under_the_conditions(name: str) -> None:
    model = model_with(name, "all")
    q = joints_around(name, 40, seed=5, spread=0.3)
    T = poses_of_rows(model, rows_under(q, 4.0, 20.0))
    solver = CorrectedIK(model).under(payload_kg=4.0, temperature_c=20.0)
    assert solver.compiled is not None
    for wanted, near in ((T, q), (T.numpy(), q.numpy())):
        found = solver(wanted, near=near)
        assert (np.asarray(found.status) == Status.REACHED).all()
        assert_close(torch.as_tensor(found.q), q, atol=1e-9)


def test_the_accuracy_is_that_of_the_conditions(loaded_arm) -> None:
    arm, model = loaded_arm
    q = joints_in(arm.true.nominal, 30, seed=7)
    rows = Measurements(q=q, payload=torch.full((30,), 20.0, dtype=torch.float64))
    expected = sigma_of_rows(model, rows).norm(dim=-1)
    solver, learned = CorrectedIK(model), learned_conditions(arm.result.learned.correction)
    assert learned is not None
    assert learned.measured == ((0.0, 20.0),)
    assert_close(solver.under(payload_kg=20.0).accuracy(q.numpy()), expected, rtol=1e-4)
    assert float(np.abs(solver.accuracy(q.numpy()) / expected.numpy() - 1).max()) > 1e-3
    true = replace(arm.measurements, payload=None)
    errors = [
        float((poses_of_rows(under, true)[::2, :3, 3] - arm.measurements.position[::2]).norm(dim=1).mean())
        for under in (model, solver.under(payload_kg=0.0).model)
    ]
    assert errors[1] < 0.9 * errors[0]  # every second row was measured without a payload


@pytest.mark.parametrize("name", ["kiro4", "kiro3"])
def test_temperature_is_clamped_and_payload_extrapolated(name: str) -> None:
    model, q = model_with(name, "all"), joints_around(name, 30, seed=3)
    for beyond, edge in ((60.0, 35.0), (-20.0, 15.0)):
        at_edge = under_stated_conditions(model, temperature_c=edge)
        under = under_stated_conditions(model, temperature_c=beyond)
        assert_close(under.forward(q), at_edge.forward(q), atol=1e-15)
        assert_close(poses_of_rows(model, rows_under(q, 2.0, beyond)), at_edge.forward(q), atol=1e-14)
        for kernels in (CorrectedIK(under).compiled, CorrectedIK(at_edge).compiled):
            assert kernels is not None
            assert_close(kernels.forward(q.numpy())[0], at_edge.forward(q), atol=1e-13)
    assert model.hybrid is not None
    usual, measured, beyond = (
        model.hybrid.correction.for_rows(rows_under(q, payload, 25.0)) for payload in (2.0, 5.0, 11.0)
    )
    assert_close(beyond - usual, 3 * (measured - usual), atol=1e-15)
    assert float((measured - usual).abs().max()) > 1e-5


def test_warnings_name_conditions_outside_the_measured_range() -> None:
    solver = CorrectedIK(model_with("kiro4", "all"))
    assert solver.warnings == ()
    assert solver.under(payload_kg=5.0, temperature_c=15.0).warnings == ()
    payload, temperature = solver.under(payload_kg=9.0, temperature_c=40.0).warnings
    for sentence, name, numbers in (
        (payload, "payload_kg", [9, 0, 5]),
        (temperature, "temperature_c", [40, 15, 35]),
    ):
        assert sentence.startswith(name)
        assert numbers_in(sentence.replace(solver.name, "")) == numbers


def test_rows_beyond_the_measured_conditions_are_counted_by_all_that_judge(tmp_path) -> None:
    model, q = model_with("kiro4", "all"), joints_around("kiro4", 30, seed=3)
    rows = rows_under(q, 2.0, 25.0)
    rows = replace(rows, position=poses_of_rows(model, rows)[:, :3, 3])
    assert rows.temperature is not None
    warm = replace(rows, temperature=rows.temperature + torch.arange(30) * 0.5)
    for judged, expected in ((warm, True), (rows, False), (replace(rows, temperature=None), False)):
        for warnings in (
            condition_warnings(model, judged),
            evaluate(model, judged).warnings,
            verify(model, judged).warnings,
            report_content(model, tmp_path, judged).advice,
        ):
            numbers = [
                numbers_in(sentence.replace(model.name, ""))
                for sentence in warnings
                if "temperature_c" in sentence
            ]
            assert ([9, 30, 35.5, 39.5, 15, 35] in numbers) is expected
            assert ([30, 30, 25] in numbers) is (judged.temperature is None)
    assert condition_warnings(hybrid_model("kiro4", [FourierSeries(model.robot, 2)]), warm) == ()


@pytest.mark.parametrize(
    ("name", "value"),
    [("payload_kg", -0.5), ("payload_kg", math.inf), ("temperature_c", math.nan), ("temperature_c", 293.0)],
)
def test_impossible_conditions_are_refused(name: str, value: float) -> None:
    with refused(ModelError, option=name) as caught:
        CorrectedIK(model_with("kiro4", "all")).under(**{name: value})
    assert str(caught.value.value) == str(value)
    assert caught.value.expected


@pytest.fixture(scope="module")
def loaded_arm():
    arm = hybrid_of("rb5", features=("gravity", "conditions", "series"), payloads=(0.0, 20.0))
    return arm, model_of_hybrid("hybrid", arm.true.nominal, arm.result, arm.measurements)


def test_the_accuracy_of_rows_without_a_condition_includes_its_effect(loaded_arm) -> None:
    arm, model = loaded_arm
    q = joints_in(arm.true.nominal, 30, seed=7)
    (mean,) = mean_conditions(model).values()
    learned = learned_conditions(model.hybrid.correction)
    at = [rows_under(q, mean + step * learned.spread[0], 20.0) for step in (0, 1)]
    effect = poses_of_rows(model, at[1])[:, :3, 3] - poses_of_rows(model, at[0])[:, :3, 3]
    unstated = replace(at[0], payload=None)
    assert_close(sigma_of_rows(model, unstated), sigma_of_rows(model, at[0]).hypot(effect), rtol=1e-2)
    assert float(effect.norm(dim=1).median()) > 0.3 * float(sigma_of_rows(model, at[0]).norm(dim=1).median())
    (sentence,) = condition_warnings(model, unstated)
    assert numbers_in(sentence)[:2] == [30, 30]
    assert_close(CorrectedIK(model).accuracy(q), sigma_of_rows(model, at[0]).norm(dim=-1))


def test_the_accuracy_beyond_the_measured_temperatures_includes_the_effect_that_is_held_constant() -> None:
    model = model_with("kiro4", "all")
    learned, q = learned_conditions(model.hybrid.correction), joints_around("kiro4", 20, seed=3)
    weight = model.hybrid.correction.linear[-1].detach()
    inside, edge, beyond = (
        learned.unstated_covariance_root(
            JointState(q, {"payload_kg": torch.full((20,), 9.0), "temperature_c": torch.full((20,), value)}),
            weight,
        )
        for value in (20.0, 35.0, 41.0)
    )
    assert_close(inside, torch.zeros_like(inside))
    assert_close(edge, torch.zeros_like(edge))
    one = [
        learned.columns(JointState(q, {"temperature_c": torch.full((20,), value)})) for value in (25.0, 31.0)
    ]
    assert_close(beyond.sum(-1), ((one[1] - one[0]) * weight).sum(-1), atol=1e-15)


def test_conditions_that_were_not_learned_are_refused(tmp_path) -> None:
    robot = Robot.load("kiro4")
    warm = hybrid_model(
        "kiro4", [ConditionFeatures(robot, ("temperature_c",), (25.0,), (6.0,), MEASURED[1:])]
    )
    for model in (warm, hybrid_model("kiro4", [FourierSeries(robot, 2)])):
        with refused(ModelError, option="payload_kg", value=1.0, expected="") as caught:
            under_stated_conditions(model, payload_kg=1.0)
        assert ("temperature_c" in str(caught.value)) is (model is warm)
    with refused(ModelError, value={"temperature_c": 20.0}):
        save_model(under_stated_conditions(warm, temperature_c=20.0), tmp_path)
    assert not list(tmp_path.iterdir())
