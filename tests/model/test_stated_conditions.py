"""Corrected inverse kinematics under a payload and temperature: as rows that state them are predicted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.identified import hybrid_model
from testing.models import joints_around

from pisigma.errors import ModelError
from pisigma.inverse.corrected_ik import CorrectedIK
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.shared_features import ScaledJoints
from pisigma.kinematics.status import Status
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import deviation_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.row_poses import poses_of_rows
from pisigma.model.stated_conditions import under_stated_conditions
from pisigma.robot.description import Robot

pytestmark = pytest.mark.usefixtures("without_type_checker")

SIDEWAYS = (0.6, 0.0, -0.8)
"""Gravity of a robot that is mounted on a slope."""
BESIDE = {
    "nothing": lambda robot: [],
    "all": lambda robot: [GravityTorques(robot), FourierSeries(robot, 5), ScaledJoints(robot)],
    "other gravity": lambda robot: [FourierSeries(robot, 1), GravityTorques(robot, SIDEWAYS)],
}


def model_with(name: str, beside: str, orders: tuple[int, ...] = ()) -> CalibratedModel:
    """A model with random weights, those of both conditions among them."""
    robot = Robot.load(name)
    learned = ConditionFeatures(robot, ("payload_kg", "temperature_c"), (2.0, 25.0), (1.5, 6.0))
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


def test_what_is_not_given_is_as_usual() -> None:
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


def test_the_accuracy_is_that_of_the_conditions() -> None:
    arm = hybrid_of("rb5", features=("gravity", "conditions", "series"), payloads=(0.0, 20.0))
    model = model_of_hybrid("hybrid", arm.true.nominal, arm.result, arm.measurements)
    q = joints_in(arm.true.nominal, 30, seed=7)
    rows = Measurements(q=q, payload=torch.full((30,), 20.0, dtype=torch.float64))
    expected = deviation_of_rows(model, rows).norm(dim=-1)
    solver = CorrectedIK(model)
    assert_close(solver.under(payload_kg=20.0).accuracy(q.numpy()), expected, rtol=1e-4)
    assert float(np.abs(solver.accuracy(q.numpy()) / expected.numpy() - 1).max()) > 1e-3
    true = replace(arm.measurements, payload=None)
    errors = [
        float((poses_of_rows(under, true)[::2, :3, 3] - arm.measurements.position[::2]).norm(dim=1).mean())
        for under in (model, solver.under(payload_kg=0.0).model)
    ]
    assert errors[1] < 0.9 * errors[0]  # every second row was measured without a payload


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        (
            {"payload_kg": 9.0},
            r"payload_kg=9 is not near the measured values, 2 on average .* give 0 to 6\.5",
        ),
        ({"payload_kg": -0.5}, "payload_kg=-0.5 is not near"),
        ({"temperature_c": float("nan")}, "temperature_c=nan is not near"),
    ],
)
def test_conditions_that_were_not_measured_are_refused(given: dict[str, float], complaint: str) -> None:
    with pytest.raises(ModelError, match=complaint):
        CorrectedIK(model_with("kiro4", "all")).under(**given)


def test_what_was_not_learned_is_refused(tmp_path) -> None:
    robot = Robot.load("kiro4")
    warm = hybrid_model("kiro4", [ConditionFeatures(robot, ("temperature_c",), (25.0,), (6.0,))])
    for model, knows in (
        (warm, "temperature_c"),
        (hybrid_model("kiro4", [FourierSeries(robot, 2)]), "joint values only"),
    ):
        with pytest.raises(ModelError, match=f"did not learn what payload_kg does; it knows {knows}"):
            under_stated_conditions(model, payload_kg=1.0)
    with pytest.raises(ModelError, match="which a folder does not keep"):
        save_model(under_stated_conditions(warm, temperature_c=20.0), tmp_path)
    assert not list(tmp_path.iterdir())
