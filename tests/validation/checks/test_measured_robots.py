"""What the checks say of measured robots: nothing while they are healthy, and the fault where one was made."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from testing.checked import checked, kinds_of
from testing.hybrid import few_robots

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import ImplausibleError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.validation.checks.registry import diagnostics_of

pytestmark = pytest.mark.usefixtures("without_type_checker")

FILES = {
    "ur5": "ur5/grid.csv",
    "ur10": "ur10/series_c_train.csv",
    "fanuc_r2000": "fanuc_r2000/positions.csv",
    "panda": "panda_sockets/panda_3.csv",
}


@cache
def rows_of(folder: Path, robot: str, step: int) -> Measurements:
    rows = Measurements.read_csv(folder / FILES[robot])
    return rows.select(torch.arange(0, rows.rows, step))


def calibrator(robot: str, rows: Measurements, distance: float = 0.05) -> GeometricCalibrator:
    placements = {name.rpartition("/")[0] for name in rows.socket or ()}
    distances = {(f"{name}/0", f"{name}/1"): distance for name in placements}
    return GeometricCalibrator(Robot.load(robot), socket_distances=distances)


def spoilt(rows: Measurements, share: float, size: float, same: bool) -> Measurements:
    """Measurements of which some positions are off by `size` [m], in one direction or any."""
    generator = torch.Generator().manual_seed(0)
    wrong = torch.randperm(rows.rows, generator=generator)[: round(share * rows.rows)]
    off = torch.randn(len(wrong), 3, generator=generator, dtype=torch.float64)
    off = torch.ones_like(off) if same else off
    position = rows.position.index_add(0, wrong, size * off / off.norm(dim=1, keepdim=True))
    return replace(rows, position=position)


@pytest.mark.parametrize(
    ("robot", "step"), [("ur5", 2), ("ur5", 10), ("ur10", 20), ("fanuc_r2000", 1), ("panda", 1)]
)
def test_healthy_robots_have_no_diagnostic(shared_data, robot, step):
    rows = rows_of(shared_data, robot, step)
    assert kinds_of(calibrator(robot, rows), rows) == []


@pytest.mark.parametrize(
    ("robot", "measured", "catalogue"),
    [("ur5", "ur10", nullcontext), ("ur10", "ur5", few_robots)],
    ids=("all", "few"),
)
def test_another_robot_is_named(shared_data, robot, measured, catalogue):
    rows = rows_of(shared_data, measured, 20)
    with catalogue():
        diagnostics = diagnostics_of(checked(calibrator(robot, rows), rows))
    assert {one.kind for one in diagnostics if one.severity == "implausible"} >= {
        "other_robot",
        "prior_ratio",
    }
    assert (diagnostics[0].kind, diagnostics[0].cause) == ("other_robot", measured)


@pytest.mark.parametrize("distance", [0.005, 0.5])
def test_a_wrong_distance_of_sockets_is_refused(shared_data, distance):
    rows = rows_of(shared_data, "panda", 1)
    with pytest.raises(ImplausibleError):
        calibrator("panda", rows, distance).fit(rows)


@pytest.mark.parametrize(("robot", "same"), [("ur5", True), ("ur10", False), ("fanuc_r2000", True)])
def test_many_wrong_rows_are_reported(shared_data, robot, same):
    rows = spoilt(rows_of(shared_data, robot, 8), 0.4, 3e-3, same)
    severities = [
        severity for kind, severity in kinds_of(calibrator(robot, rows), rows) if kind == "two_populations"
    ]
    assert severities  # a shift of a frame that is large beside the errors makes the calibration implausible
    assert same or severities == ["warning"]


@pytest.mark.parametrize(
    ("sigma", "expected"), [(0.1, "implausible"), (4e-4, "warning"), (1e-4, None), (1e-5, "warning")]
)
def test_stated_noise_is_held_against_residuals(shared_data, sigma, expected):
    rows = rows_of(shared_data, "ur5", 10)
    rows = replace(rows, sigma_position=torch.full((rows.rows,), sigma, dtype=torch.float64))
    severities = [
        severity for kind, severity in kinds_of(calibrator("ur5", rows), rows) if kind == "stated_noise"
    ]
    assert severities == ([] if expected is None else [expected])
