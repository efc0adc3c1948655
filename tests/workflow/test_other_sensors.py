"""Evaluation on rows without positions: balls in sockets, touches, wires and pairs."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.sensors import joints, pair_data, socket_data, touch_data, true_robot, wire_data

from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.dataset import Measurements, join
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.frames.row_errors import errors_of_rows
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.settings.evaluation import EvaluationSettings
from pisigma.workflow.settings.verification import VerificationSettings
from pisigma.workflow.verify import verify

pytestmark = pytest.mark.usefixtures("without_type_checker")


@cache
def model() -> CalibratedModel:
    """The true arm as the calibrated one, with the frames of touches and one without a name."""
    from testing.sensors import TRUE_BASES

    true = true_robot()
    robot = true.nominal.with_geometry(base=np.zeros(6), tool=true.geometric_robot.tool)
    return CalibratedModel(
        name="welder",
        kind="geometric_calibration",
        robot=robot,
        network=None,
        domain=None,
        branches=(),
        starts=joints(60, 9),
        calibrated=true.geometric_robot.with_geometry(base=np.zeros(6)),
        bases={"": np.zeros(6), **{name: TRUE_BASES[name] for name in ("right", "left")}},
        tools={"": true.geometric_robot.tool},
    )


def of_kind(kind: str) -> Measurements:
    """Exact rows of one kind of sensor."""
    makers = {
        "sockets": socket_data,
        "touches": lambda: touch_data(count=20),
        "wires": lambda: wire_data(24),
        "wires from stated points": lambda: wire_data(24, known=True),
        "pairs": lambda: pair_data(40),
    }
    return makers[kind]()


@pytest.mark.parametrize("kind", ["sockets", "touches", "wires", "pairs"])
def test_rows_of_every_sensor_are_evaluated_and_wrong_ones_are_refused(kind: str) -> None:
    data = of_kind(kind)
    found = evaluate(model(), data)
    nominal, own = (one.position for one in found.models)
    assert found.accepted
    assert found.rows == data.rows
    assert own.statistics["max"] < 1e-6 < 0.05 < nominal.statistics["rms"]
    assert not own.axes
    verified = verify(model(), data)
    assert (verified.verdict, verified.diagnostics) == ("better", ())
    wrong = replace(data, q=data.q * torch.tensor([1.0, -1, 1, 1, 1, 1], dtype=torch.float64))
    gate = check_rows(wrong, model(), allowed_moves=("tool", "joint_zero"))
    assert not gate.trusted
    (fault,) = gate.setup_faults
    assert (fault.kinds, fault.joints) == (("joint_sign",), (1,))


@pytest.mark.parametrize("kind", ["sockets", "wires"])
def test_a_moved_zero_is_named_and_is_a_movement_if_possible(kind: str) -> None:
    data = of_kind(kind)
    moved = replace(data, q=data.q + torch.tensor([0, 0, 0.03, 0, 0, 0], dtype=torch.float64))
    found = check_rows(moved, model())
    assert not found.trusted
    (fault,) = found.setup_faults
    assert (fault.kinds, fault.joints) == (("joint_zero",), (2,))
    assert fault.rms_after < 1e-6
    assert check_rows(moved, model(), allowed_moves=("joint_zero",)).trusted


@pytest.mark.parametrize("kind", ["touches", "wires from stated points"])
def test_rows_with_an_unknown_base_are_trusted(kind: str) -> None:
    data = of_kind(kind)
    elsewhere = replace(data, frame=tuple(f"new {name}" for name in data.frame))
    assert check_rows(elsewhere, model()).trusted
    assert check_rows(replace(elsewhere, frame=data.frame), model(), allowed_moves=("frame",)).trusted


def test_an_error_of_a_socket_is_enlarged_for_the_fitted_position() -> None:
    data = socket_data()
    rows = torch.tensor([name == "low/0" for name in data.socket or ()]).nonzero()[:, 0][:3]
    few = data.select(rows)
    shift = torch.tensor([[1e-3, 0, 0], [-1e-3, 0, 0], [0.0, 0, 0]], dtype=torch.float64)
    T = poses_of_rows(model(), few).clone()
    T[:, :3, 3] += shift
    errors = errors_of_rows(T, few).position
    assert_close(errors, -shift * (9 / 6) ** 0.5, atol=1e-8)
    alone = errors_of_rows(T[:1], few.select(torch.tensor([0]))).position
    assert bool(torch.isnan(alone).all())


def test_a_single_wrong_row_is_named_and_the_others_are_evaluated() -> None:
    data = socket_data()
    q = data.q.clone()
    q[3, 1] += 0.1
    found = evaluate(model(), replace(data, q=q))
    assert found.accepted
    assert found.rows == data.rows - 1
    assert found.models[-1].position.statistics["max"] < 1e-6
    assert any("row 3" in one for one in found.warnings)


def test_known_distances_of_sockets_are_checked() -> None:
    data, stated = socket_data(), {("*/0", "*/1"): 0.05}
    right = evaluate(model(), data, EvaluationSettings(socket_distances=stated))
    assert right.accepted
    distances = right.comparison.socket_distance
    assert distances is not None
    assert len(distances.each) == 3
    assert max(abs(one.errors_mm["welder"]) for one in distances.each) < 1e-5
    assert max(abs(one.errors_mm["nominal"]) for one in distances.each) > 0.05
    for judge, settings in (
        (evaluate, EvaluationSettings(socket_distances={("low/0", "low/1"): 0.053})),
        (verify, VerificationSettings(socket_distances={("low/0", "low/1"): 0.053})),
    ):
        wrong = judge(model(), data, settings)  # type: ignore[operator]
        assert not wrong.accepted
        assert [one.kind for one in wrong.diagnostics] == ["socket_distance"]


def test_sockets_do_not_depend_on_the_base_and_mix_with_positions() -> None:
    data = socket_data()
    away = replace(model(), bases={"": np.array([0.3, 1.0, -0.2, 0.5, 0.1, 0.2])})
    robot = true_robot().geometric_robot.with_geometry(base=away.bases[""])
    away = replace(away, robot=robot, calibrated=robot)
    assert evaluate([away], data).models[-1].position.statistics["max"] < 1e-6
    q = joints(12, 30)
    T = poses_of_rows(model(), Measurements(q=q))
    mixed = join([Measurements(q=q, position=T[:, :3, 3].contiguous()), data])
    found = evaluate(model(), mixed)
    assert found.comparison.rows == mixed.rows
    assert found.models[-1].position.statistics["max"] < 1e-6


def test_rows_that_do_not_suffice_are_refused() -> None:
    with pytest.raises(MeasurementError):
        evaluate(model(), socket_data(), EvaluationSettings(fit_frame=True))
    with pytest.raises(IdentificationError):
        evaluate(model(), wire_data(count=3))
    orientations = Measurements(q=joints(8, 1), rotation=torch.eye(3, dtype=torch.float64).repeat(8, 1, 1))
    with pytest.raises(MeasurementError):
        evaluate(model(), orientations)
