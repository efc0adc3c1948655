"""Robots for the tests of kinematics: those of the catalogue, and synthetic ones that use every feature of a row."""

import importlib.util
import math
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from pisigma.robot import Robot, Row

NAMES = ("kiro3", "kiro4", "ur5", "ur10", "odd", "seven")


def _build_odd() -> Robot:
    """Build a robot with both joint types and directions, fixed rows everywhere, all five parameters, base and tool."""
    rows = (
        Row("pedestal", "fixed"),
        Row("turn", "revolute", -1, -2.0, 2.0),
        Row("slide", "prismatic", -1, -0.3, 0.4),
        Row("bracket", "fixed"),
        Row("swing", "revolute", 1),
        Row("reach", "prismatic", 1, 0.0, 0.5),
        Row("flange", "fixed"),
    )
    dh = np.random.default_rng(5).uniform(-1.0, 1.0, (7, 5))
    return Robot("odd", "test", "test", rows, dh, np.linspace(-0.5, 0.6, 6), np.linspace(0.4, -0.3, 6))


def _build_seven() -> Robot:
    """Seven revolute joints with alternating twists."""
    d = (0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126)
    alpha = (-90, 90, 90, -90, -90, 90, 0)
    dh = np.array(
        [[0.0, length, 0.0, math.radians(twist), 0.0] for length, twist in zip(d, alpha, strict=True)]
    )
    return Robot("seven", "test", "test", tuple(Row(f"q{i}", "revolute") for i in range(7)), dh)


def load(name: str) -> Robot:
    """Load a robot of `NAMES`."""
    return {"odd": _build_odd, "seven": _build_seven}.get(name, lambda: Robot.load(name))()


def dress(robot: Robot) -> Robot:
    """Return a robot with other directions, offsets, base and tool, and a fixed row at each end."""
    rows = [
        replace(row, direction=(-1) ** i, lower=-np.inf, upper=np.inf) for i, row in enumerate(robot.rows)
    ]
    dh = robot.dh.copy()
    turning = np.array([row.type == "revolute" for row in rows])
    dh[turning, 0] += np.linspace(-2.0, 3.0, turning.sum())
    dh[~turning, 1] += 0.1
    dh[-1] += [0.0, 0.12, 0.03, 0.4, -0.3]
    ends = np.array([[0.1, 0.2, 0.3, 0.4, 0.5], [-0.3, 0.1, -0.1, 0.2, 0.3]])
    return Robot(
        f"dressed {robot.name}",
        "test",
        "test",
        (Row("stand", "fixed"), *rows, Row("gripper", "fixed")),
        np.vstack([ends[:1], dh, ends[1:]]),
        np.array([0.5, -0.2, 0.3, 0.7, -0.4, 0.2]),
        np.array([0.02, 0.05, 0.11, -0.6, 0.3, 1.1]),
    )


def random_joints(robot: Robot, generator: torch.Generator, *batch: int) -> torch.Tensor:
    """Draw joint values within the limits, or within half a turn or half a metre if there are none."""
    limits = torch.tensor(robot.limits)
    half = torch.tensor([math.pi if revolute else 0.5 for revolute in robot.revolute])
    lower, upper = limits[:, 0].clamp(min=-half), limits[:, 1].clamp(max=half)
    return lower + (upper - lower) * torch.rand((*batch, robot.dof), generator=generator, dtype=torch.float64)


@pytest.fixture(params=NAMES)
def robot(request) -> Robot:
    """Each robot of `NAMES`."""
    return load(request.param)


@pytest.fixture(scope="session")
def robots():
    """The functions `load`, `dress` and `random_joints`."""
    return sys.modules[__name__]


@pytest.fixture(scope="session")
def benchmark_module(repository: Path) -> ModuleType:
    """`benchmarks/kinematics_speed.py`, which builds the peer's chain in float64."""
    pytest.importorskip("pytorch_kinematics")
    path = repository / "benchmarks" / "kinematics_speed.py"
    spec = importlib.util.spec_from_file_location("kinematics_speed", path)
    module = importlib.util.module_from_spec(spec)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the peer's imports are not ours to mend
        spec.loader.exec_module(module)
    return module
