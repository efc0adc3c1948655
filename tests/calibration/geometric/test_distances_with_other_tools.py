"""Distances of robots with another tool than the nominal one are fitted before they are judged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.sensors import joints, pair_data, socket_data, true_robot, wire_data
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.initial_guess.tool_from_distances import base_from_anchors
from pisigma.files.errors import IdentificationError, ImplausibleError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx

pytestmark = pytest.mark.usefixtures("without_type_checker")

SENSORS: dict[str, Callable[[], Measurements]] = {
    "wire": wire_data,
    "wire from a stated anchor": lambda: wire_data(known=True),
    "pair": pair_data,
}
SOCKETS = {("plate/0", "plate/1"): 0.05, ("low/0", "low/1"): 0.05, ("high/0", "high/1"): 0.05}


def with_tool_off(off: float) -> Robot:
    """The nominal robot, its tool so far from the true one [m]."""
    nominal = true_robot().nominal
    tool = nominal.tool.copy()
    tool[:3] += off * np.array([0.6, -0.48, 0.64])
    return nominal.with_geometry(tool=tool)


@pytest.mark.parametrize(
    ("sensor", "off"), [*((one, 0.137) for one in SENSORS), ("wire", 0.0), ("pair", 0.3)]
)
def test_a_tool_that_is_not_nominal_is_found(sensor: str, off: float) -> None:
    result = GeometricCalibrator(with_tool_off(off)).fit(SENSORS[sensor]())
    assert result.status.is_minimum
    assert_close(result.robot.tool[2], true_robot().geometric_robot.tool[2], atol=1e-3)
    assert all(found.sigma < 1e-6 for found in result.noise)


def seen_from(T_frame_robot: Tensor, anchors: int) -> Measurements:
    """Wires from anchors that are stated in a frame."""
    robot, q = true_robot().geometric_robot, joints(80, 7)
    places = torch.tensor([[1.5, -0.2, 0.9], [-0.4, 1.1, 0.3], [0.3, -1.2, 0.5]]).double()
    number = torch.arange(len(q)) % anchors
    distance = (forward_kinematics(robot, q)[:, :3, 3] - places[number]).norm(dim=-1)
    stated = places @ T_frame_robot[:3, :3].mT + T_frame_robot[:3, 3]
    names = tuple(f"wire {k}" for k in number.tolist())
    return Measurements(q=q, distance=distance, anchor=names, anchor_place=stated[number])


@pytest.mark.parametrize(("anchors", "off"), [(1, 0.137), (2, 1.0), (3, 1.0)])
def test_neither_a_far_frame_nor_a_long_tool_has_to_be_drawn(anchors: int, off: float) -> None:
    T = transform_from_xyz_zyx(torch.tensor([2.5, -1.2, 0.4, 2.3, 0.1, -0.05], dtype=torch.float64))
    nominal = with_tool_off(off)
    result = GeometricCalibrator(nominal).fit(seen_from(T, anchors))
    assert result.status.is_minimum
    assert result.noise[0].sigma < 1e-6
    if anchors == 3:
        found = transform_from_xyz_zyx(torch.tensor(result.robot.base))
        assert_close(found, T, atol=5e-3)


@pytest.mark.parametrize("anchors", [1, 2, 3])
def test_anchors_at_stated_positions_determine_the_frame(anchors: int) -> None:
    T = transform_from_xyz_zyx(torch.tensor([2.5, -1.2, 0.4, 2.3, 0.1, -0.05], dtype=torch.float64))
    data = seen_from(T, anchors)
    tip = forward_kinematics(true_robot().geometric_robot, data.q)[:, :3, 3]
    found = transform_from_xyz_zyx(torch.tensor(base_from_anchors(data, data.frame[0], tip, np.zeros(6))))
    assert data.anchor_place is not None
    seen = data.anchor_place[:anchors] - found[:3, 3]
    assert_close(seen @ found[:3, :3], (data.anchor_place[:anchors] - T[:3, 3]) @ T[:3, :3], atol=1e-6)
    assert_close(found[:3, :3] @ found[:3, :3].mT, torch.eye(3).double(), atol=1e-12)
    if anchors == 1:  # which says nothing of how the robot is turned
        assert_close(found[:3, :3], torch.eye(3).double(), atol=1e-12)


@pytest.mark.parametrize("off", [0.0, 0.137])
def test_sockets_with_stated_distances_find_the_tool(off: float) -> None:
    result = GeometricCalibrator(with_tool_off(off), socket_distances=SOCKETS).fit(socket_data())
    assert result.status.is_minimum
    assert_close(result.robot.tool[2], true_robot().geometric_robot.tool[2], atol=1e-3)


@pytest.mark.parametrize(
    ("sensor", "factor", "off", "unit"),
    [
        ("wire", 1e-3, 0.137, "metres"),
        ("wire from a stated anchor", 1e3, 0.0, "millimetres"),
        ("pair", 1 / 25.4, 0.0, "inches"),
        ("pair", 1e3, 0.0, "millimetres"),
    ],
)
def test_distances_in_another_unit_are_refused(sensor: str, factor: float, off: float, unit: str) -> None:
    data = SENSORS[sensor]()
    assert data.distance is not None
    with refused(ImplausibleError, value=unit):
        GeometricCalibrator(with_tool_off(off)).fit(replace(data, distance=data.distance * factor))


@pytest.mark.parametrize(
    ("robot", "tool", "factor", "unit"),
    [("ur10", "free", 1e-3, "metres"), ("ur5", "fixed", 1 / 25.4, "inches")],
)
def test_wires_of_measured_robots_in_another_unit_are_refused(
    robot: str, tool: str, factor: float, unit: str, shared_data: Path
) -> None:
    name = {"ur10": "ur10/series_c_train.csv", "ur5": "ur5/grid.csv"}[robot]
    rows = Measurements.read_csv(shared_data / name).select(torch.arange(0, 900, 3))
    assert rows.position is not None
    lengths = (rows.position - rows.position.mean(0) - torch.tensor([1.2, 0.8, 0.9])).norm(dim=-1)
    data = Measurements(q=rows.q, distance=lengths, anchor=("wall",) * rows.rows)
    assert GeometricCalibrator(Robot.load(robot)).fit(data).noise[0].sigma < 3e-4
    with refused(ImplausibleError, value=unit):
        GeometricCalibrator(Robot.load(robot), tool=tool).fit(replace(data, distance=lengths * factor))


@pytest.mark.parametrize("factor", [1e-3, 25.4])
def test_stated_distances_of_sockets_in_another_unit_are_refused(factor: float) -> None:
    wrong = {sockets: distance * factor for sockets, distance in SOCKETS.items()}
    with pytest.raises(IdentificationError):
        GeometricCalibrator(with_tool_off(0.137), socket_distances=wrong).fit(socket_data())


@pytest.mark.parametrize(
    ("sensor", "off"), [("wire", 0.0), ("wire from a stated anchor", 0.137), ("pair", 0.137)]
)
def test_distances_of_other_rows_are_refused(sensor: str, off: float) -> None:
    data = SENSORS[sensor]()
    assert data.distance is not None
    order = torch.randperm(data.rows // 2, generator=torch.Generator().manual_seed(0))
    rows = (2 * order[:, None] + torch.arange(2)).flatten()
    with pytest.raises(IdentificationError):
        GeometricCalibrator(with_tool_off(off)).fit(replace(data, distance=data.distance[rows]))


@pytest.mark.parametrize("sensor", SENSORS)
def test_one_wrong_distance_is_named_whatever_the_tool(sensor: str) -> None:
    data = SENSORS[sensor]()
    assert data.distance is not None
    wrong = data.distance.clone()
    wrong[16:18] += 1.5
    with pytest.raises(IdentificationError, match=r"row 1[67]"):
        GeometricCalibrator(with_tool_off(0.137)).fit(replace(data, distance=wrong))
