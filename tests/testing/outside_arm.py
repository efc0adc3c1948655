"""Arms with gears and sag by a simulator that shares no code with the package; tests are skipped without it."""

import functools
import importlib.util
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

DATA = Path(os.environ.get("PISIGMA_DATA", Path(__file__).parents[2] / ".." / "shared" / "data")).resolve()
SIMULATOR = DATA.parent / "simulated" / "sim.py"
ARMS = ("kr10", "irb120", "arm7", "scara", "rail")


@functools.cache
def simulator() -> ModuleType:
    """The simulator's module."""
    specification = importlib.util.spec_from_file_location("outside_simulator", SIMULATOR)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def sample_joints(true: Any, rows: int, seed: int) -> np.ndarray:
    """Return the joint values that the simulator's `sample` draws one by one, which takes seconds."""
    drawn = np.random.default_rng(seed)
    limits = [joint[5] for joint in true.js if joint[1] != "fixed"]
    turning = [joint[1] == "revolute" for joint in true.js if joint[1] != "fixed"]
    lower, upper = np.clip(np.where(np.array(turning)[:, None], np.deg2rad(limits), limits), -np.pi, np.pi).T
    middle, half = (lower + upper) / 2, (upper - lower) / 2 * 0.9
    q = drawn.uniform(middle - half, middle + half, (20 * rows, len(middle)))
    above = (true.tip(q)[0][:, 2] > 0.1) | (true.name == "scara")
    assert above.sum() >= rows
    return q[above][:rows]


class OutsideArm:
    """One arm of the simulator, and its measurements by a tracker."""

    def __init__(self, name: str, seed: int, rows: int = 100, draw: int = 1) -> None:
        """Draw an arm and joint values."""
        if not SIMULATOR.is_file():
            pytest.skip(f"{SIMULATOR} is not there; set PISIGMA_DATA to the folder of measured robots.")
        self.robot = Robot.load(str(SIMULATOR.parent / f"{name}.urdf"))
        self.true, self.draw = simulator().True_(name, seed), draw
        self.q = sample_joints(self.true, rows, draw)

    def measured(self, logged: np.ndarray | None = None, tool: np.ndarray | None = None) -> Measurements:
        """Measure positions at the joint values, optionally with others logged, or of another point of the tool."""
        tip = None if tool is None else self.true.tool + tool
        x = self.true.measure(self.q, rng=np.random.default_rng(self.draw + 50), tool=tip)[0]
        q = torch.from_numpy(self.q if logged is None else logged)
        return Measurements(q, torch.from_numpy(x), line=tuple(range(2, 2 + len(q))), source="rows.csv")


def either(first: Measurements, second: Measurements, of_second: np.ndarray) -> Measurements:
    """Combine rows of two measurements of the same joint values."""
    assert first.position is not None
    assert second.position is not None
    position = torch.where(torch.from_numpy(of_second)[:, None], second.position, first.position)
    return Measurements(first.q, position, line=first.line, source=first.source)
