"""`pisigma calibrate`, `evaluate` and `train` with several targets and frames."""

import json
from dataclasses import replace

import pytest
import torch
from testing.models import no_type_checker
from testing.simulated_arm import simulate

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model
from pisigma.robot.kinematics.forward import forward_kinematics


def written(path, measurements):
    """Write rows and give the path."""
    with no_type_checker():
        measurements.write_csv(path, revolute=[True] * measurements.dof)
    return path


@pytest.fixture(scope="module")
def targets():
    """Positions of three reflectors in two frames, each configuration nine times."""
    names = ("A", "B", "C") * 90
    frames = tuple("left" if row // 9 % 2 else "right" for row in range(270))
    offsets = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.02], [-0.05, -0.05, 0.1]], dtype=torch.float64)
    shift = torch.tensor([[2.0 if name == "left" else 0.0, 0.0, 0.0] for name in frames], dtype=torch.float64)
    with no_type_checker():
        arm = simulate("kiro4", rows=60, noise=5e-5, turn_noise=1e-4)
        q = arm.measurements.q[:30].repeat_interleave(9, 0)
        T = forward_kinematics(arm.true, q)
    own = offsets[torch.tensor(["ABC".index(name) for name in names])]
    position = T[:, :3, 3] + (T[:, :3, :3] @ own[..., None])[..., 0] + shift
    generator = torch.Generator().manual_seed(0)
    noise = 1e-5 * torch.randn(position.shape, generator=generator, dtype=torch.float64)
    return Measurements(q=q, position=position + noise, target=names, frame=frames)


def test_several_targets_and_frames(run, refuses, targets, tmp_path):
    path = written(tmp_path / "targets.csv", targets)
    printed = json.loads(
        run(
            *("calibrate", "kiro4", path, "--out", tmp_path / "arm", "--model", "geometric"),
            *("--set", "repeats=1", "--json"),
        ).stdout
    )
    assert printed["cross_validation"]["geometric"]["rms_mm"] < 0.1
    model = load_model(tmp_path / "arm")
    assert (set(model.bases), set(model.tools)) == ({"left", "right"}, {"A", "B", "C"})
    judged = json.loads(run("evaluate", tmp_path / "arm", path, "--json").stdout)
    assert judged["trained_on"]
    assert judged["corrected"]["rms_mm"] < 0.1 < judged["nominal"]["rms_mm"]
    one = targets.select(torch.arange(9))
    other = written(tmp_path / "other.csv", replace(one, target=("A", "B", "D") * 3))
    assert "'D'" in refuses("evaluate", tmp_path / "arm", other, error=MeasurementError)
    strange = written(tmp_path / "strange.csv", replace(one, frame=("lft",) * 9))
    assert "'lft'" in refuses("evaluate", tmp_path / "arm", strange, error=MeasurementError)


def test_inverse_calibration_wants_one_frame_and_target(refuses, repository, targets, tmp_path):
    path = written(tmp_path / "targets.csv", targets)
    text = (repository / "training" / "ur10_inverse.yaml").read_text().replace("robot: ur10", "robot: kiro4")
    (tmp_path / "measured.yaml").write_text(text)
    refuses(
        "train",
        tmp_path / "measured.yaml",
        "--data",
        path,
        "--out",
        tmp_path / "model",
        error=MeasurementError,
        option="frame",
        value="left",
    )
    one = written(tmp_path / "one.csv", replace(targets, frame=()))
    command = ("train", tmp_path / "measured.yaml", "--data", one, "--out", tmp_path / "model")
    refuses(*command, error=MeasurementError, option="target", value="B")
