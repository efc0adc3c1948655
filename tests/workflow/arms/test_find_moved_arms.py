"""Arms that were calibrated, stored, and bumped: named from eight new rows of each, and what is refused."""

from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.two_arms import UR5, measured_positions, rows_now

from pisigma.files.errors import IdentificationError, ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.se3 import transform
from pisigma.workflow.arms.calibrate_arms import Arm, calibrate_arms
from pisigma.workflow.arms.find_moved_arms import find_moved_arms
from pisigma.workflow.settings.calibration import CalibrationSettings

NAMES = ("left", "right")
BUMP = transform(torch.eye(3).double(), torch.tensor([3e-4, 0.0, -4e-4], dtype=torch.float64))
"""Motion by 0.5 mm."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two calibrated arms that were measured in one frame."""
    quick = CalibrationSettings(folds=0, features=())
    arms = [Arm(name, UR5, measured_positions(k, 0, ("hall",), 40), quick) for k, name in enumerate(NAMES)]
    path: Path = tmp_path_factory.mktemp("arms") / "models"
    calibrate_arms(arms).save(path)
    return path


def now(body: str) -> dict[str, Measurements]:
    """Return new rows of both arms."""
    return {name: rows_now(number, 0, BUMP, body) for number, name in enumerate(NAMES)}


def test_nothing_is_named_if_nothing_moved(folder):
    found = find_moved_arms(folder, now(""))
    assert not any(one.is_best_explanation for one in found.bodies)
    assert found.to_json()["probability"] > 1e-3


def test_bumped_base_is_named_with_shift_and_standard_errors(folder):
    found = find_moved_arms(folder, now("right"))
    (one,) = (one for one in found.bodies if one.is_best_explanation)
    assert (one.kind, one.name, found.moved_bases.is_one_body) == ("arm", "right", True)
    assert_close(one.shift_mm, [0.3, 0.0, -0.4], atol=0.1)
    assert max(one.standard_errors[:3]) < 0.05
    (body,) = found.moved_bases.likely_bodies
    drawn = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    lengths = (body.shift + drawn @ torch.linalg.cholesky(body.covariance[:3, :3]).mT).norm(dim=1)
    assert_close(one.shift_standard_error_mm, float(lengths.std()) * 1e3, rtol=0.05)
    assert f"{one.shift_standard_error_mm:.2g} mm" in one.sentence


def test_one_arm_cannot_say_whether_it_or_the_frame_moved(folder):
    found = find_moved_arms(folder, {"right": now("right")["right"]})
    assert {one.name for one in found.bodies if one.is_best_explanation} == {"right", "hall"}


def test_unknown_arm_is_refused(folder):
    with refused(ModelError, value="middle"):
        find_moved_arms(folder, {"middle": now("")["left"]})


def test_too_few_rows_are_refused(folder):
    with refused(IdentificationError, value=6):
        find_moved_arms(folder, {"left": now("")["left"].select(torch.tensor([0, 1]))})


def test_changed_model_is_refused(folder, tmp_path):
    (tmp_path / "frames.yaml").write_bytes((folder / "frames.yaml").read_bytes())
    (tmp_path / "left").symlink_to(folder / "right")
    with refused(ModelError, file=str(tmp_path / "left")):
        find_moved_arms(tmp_path, now(""))
