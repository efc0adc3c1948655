"""A model folder of an SO-101 with wrong zeros, and its calibration file of LeRobot."""

from pathlib import Path

import pytest
from testing.lerobot_arm import SO101, so101_model

from pisigma.measurement.foreign.lerobot_motors import motors_text
from pisigma.model.folder.model_folder import save_model


@pytest.fixture(scope="session")
def model_folder(tmp_path_factory):
    folder: Path = tmp_path_factory.mktemp("lerobot") / "so101"
    folder.mkdir()
    save_model(so101_model(), folder)
    return folder


@pytest.fixture
def calibration(tmp_path):
    path: Path = tmp_path / "follower.json"
    path.write_text(motors_text(SO101))
    return path
