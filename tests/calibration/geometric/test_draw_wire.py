"""A draw wire from an unknown place: what it tells of the arm, what not, and errors of rows not fitted to."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.sensors import joints, touch_data, true_robot, wire_data
from testing.simulated_arm import dh_errors
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.sensors.registry import measured_errors
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

PLACE = np.array([1.5, -0.2, 0.9])
ZERO = 0.012
WIRE = np.array([*PLACE, ZERO])


def distances_after_moving(points: Tensor, to: Tensor) -> Tensor:
    """Distances of points after the rigid motion that brings them nearest (Kabsch 1976)."""
    a, b = points - points.mean(0), to - to.mean(0)
    U, _, Vt = torch.linalg.svd(a.mT @ b)
    mirrored = torch.ones(3, dtype=a.dtype)
    mirrored[2] = torch.linalg.det(U @ Vt).sign()
    return (a @ (U * mirrored @ Vt) - b).norm(dim=-1)


def turns(rows: int, rng: np.random.Generator) -> Tensor:
    return torch.from_numpy(rng.uniform(-3, 3, (rows, 6)))


@pytest.mark.parametrize("seed", range(4))
def test_one_wire_calibrates_the_arm_but_not_where_it_stands(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nominal = Robot.load("ur10")
    true = nominal.with_geometry(dh=nominal.dh + dh_errors(nominal, 5e-4, 1e-3, rng))
    q, fresh = turns(200, rng), turns(1000, rng)
    length = (forward_kinematics(true, q)[:, :3, 3] - torch.from_numpy(PLACE)).norm(dim=-1)
    noise = 1e-4 * torch.from_numpy(rng.normal(size=200))
    data = Measurements(q=q, distance=length + ZERO + noise, anchor=("wire",) * 200)
    result = GeometricCalibrator(nominal).fit(data)
    before, after, wanted = (
        forward_kinematics(robot, fresh)[:, :3, 3] for robot in (nominal, result.robot, true)
    )
    assert float(distances_after_moving(before, wanted).mean()) > 1e-3
    assert float(distances_after_moving(after, wanted).mean()) < 0.12e-3  # 0.15 mm is asked for
    assert float((after - wanted).norm(dim=-1).mean()) > 1.5 * float(
        distances_after_moving(after, wanted).mean()
    )
    assert floating_frames(result) == [""]


def floating_frames(result: CalibrationResult) -> list[str]:
    """Frames in which the calibration does not determine the base."""
    return [one.subject for one in result.warning_details if one.kind == "floating_frame"]


def test_anchors_and_touches_at_stated_positions_determine_the_base() -> None:
    nominal, placed = true_robot().nominal, replace(wire_data(), frame=("left",) * 80)
    for data in (wire_data(known=True), touch_data(), join([touch_data(), placed])):
        assert floating_frames(GeometricCalibrator(nominal).fit(data)) == []
    apart = GeometricCalibrator(nominal).fit(join([touch_data(), replace(wire_data(), frame=("far",) * 80)]))
    assert floating_frames(apart) == ["far"]


def errors(data: Measurements, **anchors: np.ndarray) -> Tensor:
    """Distance errors of the true robot."""
    robot = true_robot().geometric_robot
    T = predicted_poses(robot, {"": robot.base}, {"": robot.tool}, data)
    found = measured_errors(T, data, {"anchor": anchors})
    assert set(found) == {"distance"}
    return found["distance"][:, 0]


def test_errors_of_an_anchor_that_was_calibrated() -> None:
    data = wire_data()
    exact = errors(data, wire=WIRE)
    assert_close(exact, torch.zeros(80), atol=1e-12)
    assert_close(
        errors(data, wire=np.array([*PLACE, 0.0])), torch.full((80,), ZERO, dtype=torch.float64), atol=1e-12
    )
    assert data.distance is not None
    longer = replace(data, distance=data.distance + 0.003)
    assert_close(
        errors(longer, wire=WIRE),
        torch.full((80,), 0.003, dtype=torch.float64),
        atol=1e-12,
    )


def test_the_position_of_a_row_is_used_if_the_anchor_was_not_calibrated() -> None:
    data = wire_data(known=True)
    assert data.distance is not None
    assert_close(errors(replace(data, distance=data.distance - ZERO)), torch.zeros(80), atol=1e-12)
    moved = errors(data, wire=WIRE + np.array([0.0, 0.0, 0.05, 0.0]))
    p = forward_kinematics(true_robot().geometric_robot, data.q)[:, :3, 3]
    place = torch.from_numpy(PLACE)
    lifted = torch.from_numpy(PLACE + np.array([0.0, 0.0, 0.05]))
    assert_close(moved, (p - place).norm(dim=-1) - (p - lifted).norm(dim=-1), atol=1e-12)


def test_an_anchor_of_unknown_place_is_refused() -> None:
    with refused(IdentificationError, column="anchor", value="wire"):
        errors(wire_data())
    with refused(IdentificationError, column="anchor", value="wire") as caught:
        errors(wire_data(), wires=WIRE)
    assert "wires" in caught.value.remedy
    partly = wire_data(known=True)
    assert partly.anchor_place is not None
    nowhere = replace(partly, anchor_place=torch.full_like(partly.anchor_place, torch.nan))
    with refused(IdentificationError, column="anchor", value="wire"):
        errors(nowhere)


def test_rows_without_a_distance_have_no_error() -> None:
    data = join([wire_data(count=30), Measurements(q=joints(5, 8), position=torch.zeros(5, 3).double())])
    robot = true_robot().geometric_robot
    T = predicted_poses(robot, {"": robot.base}, {"": robot.tool}, data)
    found = measured_errors(T, data, {"anchor": {"wire": WIRE}})
    assert bool(torch.isnan(found["distance"][30:]).all())
    assert_close(found["distance"][:30, 0], torch.zeros(30), atol=1e-12)
    assert bool(torch.isnan(found["position"][:30]).all())
    assert bool(torch.isfinite(found["position"][30:]).all())


def test_a_calibration_evaluates_held_out_wires() -> None:
    data = wire_data(count=200)
    train, test = data.select(torch.arange(150)), data.select(torch.arange(150, 200))
    result = GeometricCalibrator(true_robot().nominal).fit(train)
    assert_close(result.errors_of(test)["distance"], torch.zeros(50, 1), atol=2e-6)
