"""A frame or a tool that moves while rows are measured is found with its row; healthy measurements are left alone."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.checked import checked
from testing.closeness import assert_close
from testing.outside_arm import OutsideArm
from testing.simulated_arm import SimulatedArm, simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements, with_new_frames
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector
from pisigma.validation.checks.row_order import check_row_order
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.row_order import find_motion

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data"))
SHIFT = torch.tensor([0.004, -0.003, 0.0], dtype=torch.float64)
TURN = rotation_from_vector(torch.tensor([0.0, math.radians(1.0), 0.0], dtype=torch.float64))
FIRST_LINE = 2


def arm(turned: bool = False, rows: int = 80) -> SimulatedArm:
    """Measurements as if they came from a file."""
    made = simulate("ur5", seed=1, rows=rows, noise=5e-5, turn_noise=1e-4 if turned else None)
    lines = tuple(range(FIRST_LINE, FIRST_LINE + rows))
    return replace(made, measurements=replace(made.measurements, line=lines, source="tracker.csv"))


def frame_moved(rows: Measurements, first: int) -> Measurements:
    """The frame shifts by 5 mm and turns by 1 deg about the middle of its points."""
    assert rows.position is not None
    position = rows.position.clone()
    middle = position[first:].mean(0)
    position[first:] = (position[first:] - middle) @ TURN.T + middle + SHIFT
    if rows.rotation is None:
        return replace(rows, position=position)
    rotation = rows.rotation.clone()
    rotation[first:] = TURN @ rotation[first:]
    return replace(rows, position=position, rotation=rotation)


def tool_moved(simulated: SimulatedArm, first: int) -> Measurements:
    """The target is 10 mm elsewhere on the tool."""
    rows = simulated.measurements
    assert rows.position is not None
    R = forward_kinematics(simulated.true, rows.q)[:, :3, :3]
    position = rows.position.clone()
    position[first:] += 2 * R[first:] @ SHIFT
    return replace(rows, position=position)


def drifting(rows: Measurements, share: torch.Tensor) -> Measurements:
    assert rows.position is not None
    return replace(rows, position=rows.position + share[:, None] * SHIFT)


def found(robot: Robot, rows: Measurements) -> list[Diagnostic]:
    return list(check_row_order(checked(GeometricCalibrator(robot), rows)))


@pytest.mark.parametrize(("turned", "first"), [(False, 16), (True, 40)])
def test_a_frame_that_moved_is_found_with_its_row_and_amount(turned: bool, first: int) -> None:
    simulated = arm(turned)
    rows = frame_moved(simulated.measurements, first)
    (diagnostic,) = found(simulated.nominal, rows)
    assert diagnostic.severity == "implausible"
    assert diagnostic.cause == "frame"
    assert diagnostic.values["first_line"] == first + FIRST_LINE
    motion = find_motion(GeometricCalibrator(simulated.nominal).fit(rows))
    assert motion is not None
    assert motion.first_moved_index == first
    assert_close(motion.shift, SHIFT, atol=2e-4)
    assert_close(np.rad2deg(motion.turn), 1.0, atol=0.03)
    apart = with_new_frames(rows, [first + FIRST_LINE])
    assert found(simulated.nominal, apart) == []
    sigma = GeometricCalibrator(simulated.nominal).fit(apart).noise[0].sigma
    assert_close(sigma, 5e-5, rtol=0.2)


def test_the_same_rows_under_other_names_have_a_motion_of_their_own_frame() -> None:
    """A search is not repeated for the same rows; a cell renames frames after a change of the instrument."""
    simulated = arm()
    rows = frame_moved(simulated.measurements, 40)
    named = [replace(rows, frame=(name,) * rows.rows) for name in ("", "since 2026-03-02")]
    motions = [find_motion(GeometricCalibrator(simulated.nominal).fit(one)) for one in named]
    assert [None if one is None else one.name for one in motions] == ["", "since 2026-03-02"]


def test_a_tool_that_moved_is_distinguished_from_a_frame() -> None:
    simulated = arm()
    (diagnostic,) = found(simulated.nominal, tool_moved(simulated, 40))
    assert diagnostic.severity == "implausible"
    assert (diagnostic.cause, diagnostic.values["first_line"]) == ("tool", 42)
    assert_close(diagnostic.values["shift_mm"], 10.0, atol=0.1)


@pytest.mark.parametrize("wave", [False, True])
def test_a_slow_drift_is_found(wave: bool) -> None:
    simulated = arm()
    time = torch.linspace(0, 1, 80, dtype=torch.float64)
    (diagnostic,) = found(
        simulated.nominal, drifting(simulated.measurements, (4 * time).sin() if wave else time)
    )
    assert diagnostic.severity == "implausible"
    assert diagnostic.cause == "frame"
    assert "first_row" not in diagnostic.values


def test_a_small_motion_is_a_warning() -> None:
    simulated = arm(rows=200)
    behind = (torch.arange(200) >= 100).double()
    (diagnostic,) = found(simulated.nominal, drifting(simulated.measurements, 0.02 * behind))
    assert diagnostic.severity == "warning"
    assert diagnostic.values["first_line"] == 102


@pytest.mark.parametrize(
    ("seed", "rows", "wrong"),
    [(0, 15, 0.0), (1, 15, 0.1), (2, 60, 0.1), (3, 60, 0.0)],
)
def test_valid_rows_in_any_order_are_accepted(seed: int, rows: int, wrong: float) -> None:
    simulated = simulate("ur5", seed=seed, rows=rows, noise=5e-5, wrong=wrong)
    assert found(simulated.nominal, simulated.measurements) == []
    in_order = simulated.measurements.select(simulated.measurements.q[:, seed].argsort())
    assert found(simulated.nominal, in_order) == []


@pytest.mark.parametrize(("seed", "rows"), [(2, 20), (7, 20), (10, 20), (3, 24), (6, 24), (7, 24)])
def test_few_rows_of_an_arm_with_gears_are_accepted(seed: int, rows: int) -> None:
    """What motions and parameters could follow to the noise, as they are nearly as many as the values."""
    simulated = simulate("ur5", seed=seed, rows=rows)
    drawn, q = np.random.default_rng(seed), simulated.measurements.q
    size, phase = (
        torch.from_numpy(made) for made in (drawn.normal(0, 2.6e-4, (3, 6)), drawn.uniform(0, 6.28, (3, 6)))
    )
    gears = sum(size[k] * torch.sin(harmonic * q + phase[k]) for k, harmonic in enumerate((1, 2, 7)))
    position = forward_kinematics(simulated.true, q + gears)[:, :3, 3]
    measured = Measurements(q, position + torch.from_numpy(drawn.normal(0, 3.6e-5, (rows, 3))))
    assert found(simulated.nominal, measured) == []


def test_exact_rows_and_few_rows_show_nothing() -> None:
    exact, few = simulate("ur5", rows=40), simulate("ur5", rows=14, noise=5e-5)
    assert find_motion(GeometricCalibrator(exact.nominal).fit(exact.measurements)) is None
    offsets = GeometricCalibrator(few.nominal, free="joint_offsets")
    assert find_motion(offsets.fit(few.measurements.select(torch.arange(6)))) is None


@pytest.mark.parametrize(
    ("name", "file"),
    [("ur5", "ur5/grid.csv"), ("fanuc_r2000", "fanuc_r2000/positions.csv"), ("ur10", "ur10/series_b.csv")],
)
def test_measured_robots_show_no_motion_in_any_order(name: str, file: str) -> None:
    if not (DATA / file).is_file():
        pytest.skip(f"{DATA / file} is not there; set PISIGMA_DATA to the folder of measured robots.")
    robot = Robot.load(name)
    rows = Measurements.read_csv(DATA / file, robot)
    every = rows.select(torch.arange(0, rows.rows, max(rows.rows // 300, 1)))
    for data in (every.select(every.q[:, joint].argsort()) for joint in (1, 4)):
        assert [one for one in found(robot, data) if one.severity == "implausible"] == []
    assert found(robot, every) == []


@pytest.mark.parametrize(
    ("shift", "frames", "reported"), [(8e-5, 1, True), (8e-5, 2, False), (4e-3, 2, True)]
)
def test_what_two_frames_leave_unexplained_is_no_motion_of_the_tool(shift, frames, reported):
    """A motion of the tool where a frame starts is reported only if it makes the errors far larger."""
    simulated = simulate("ur5", seed=1, rows=160, noise=5e-5)
    rows = replace(simulated.measurements, line=tuple(range(2, 162)), source="tracker.csv")
    R = forward_kinematics(simulated.true, rows.q)[80:, :3, :3]
    position = rows.position.clone()
    position[80:] += R @ torch.tensor([shift, 0.0, 0.0], dtype=torch.float64)
    rows = replace(rows, position=position)
    if frames == 2:
        rows = with_new_frames(rows, (82,))
    assert bool(found(simulated.nominal, rows)) == reported


@pytest.mark.parametrize(("name", "draw"), [("rail", 1), ("rail", 2), ("scara", 1)])
def test_repeats_of_few_poses_are_no_evidence_of_a_motion(name: str, draw: int) -> None:
    outside = OutsideArm(name, 3, 20, draw)
    outside.q = np.repeat(outside.q, 3, 0)
    assert [*check_row_order(checked(GeometricCalibrator(outside.robot), outside.measured()))] == []


def test_a_motion_between_repeated_poses_is_found() -> None:
    outside = OutsideArm("kr10", 3, 40, 1)
    outside.q = np.repeat(outside.q, 2, 0)
    rows = outside.measured()
    assert rows.position is not None
    later = (torch.arange(80) >= 40)[:, None]
    moved = replace(rows, position=rows.position + torch.tensor([1e-3, -1e-3, 5e-4]) * later)
    (only,) = check_row_order(checked(GeometricCalibrator(outside.robot), moved))
    assert (only.cause, only.values["first_row"]) == ("frame", 40)
