"""Arm for which programs are rewritten."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from testing.identified import geometric_model, off_by

from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot


@pytest.fixture(scope="session")
def arm(tmp_path_factory) -> Path:
    """A geometric model of a UR10 with a base and a tool."""
    nominal = Robot.load("ur10").with_geometry(base=np.full(6, 0.3), tool=np.full(6, 0.1))
    model = geometric_model("ur10")
    folder = tmp_path_factory.mktemp("models") / "arm"
    folder.mkdir()
    save_model(replace(model, robot=nominal, calibrated=off_by(nominal)), folder)
    return folder
