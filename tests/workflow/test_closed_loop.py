"""A SCARA with errors reaches commanded poses in MuJoCo after its cell was planned, measured and calibrated."""

import importlib
import sys

import pytest

from pisigma.workflow.cell.cell_file import MEASURED_JOINTS

pytest.importorskip("mujoco", reason="MuJoCo is not installed")


@pytest.fixture
def closed_loop(repository, monkeypatch):
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    yield importlib.import_module("closed_loop")
    for name in ("closed_loop", "mujoco_arm"):
        del sys.modules[name]


@pytest.mark.usefixtures("without_type_checker")
def test_commanded_poses_are_reached_in_mujoco(closed_loop, tmp_path):
    plan = closed_loop.plan_of("scara", poses=30, candidates=500)
    closed = closed_loop.close_loop("scara", "measured", 0, tmp_path, plan, count=100)
    assert closed.reached == 100
    assert closed.nominal_mm > 0.3
    assert closed.rms_mm < 0.05
    assert 0.8 < closed.predicted_p95_mm / closed.p95_mm < 1.3
    assert closed.verdict == "better"
    assert MEASURED_JOINTS in closed.warnings
