"""Models of hybrid calibrations: predictions, their folder, and inconsistent folders."""

import functools
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.edited_folders import edit, edit_tensors
from testing.hybrid import hybrid_of, joints_in
from testing.refusals import refused

from pisigma.calibration.hybrid.uncertainty import ROUNDING_TOLERANCE
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import MeasurementError, ModelError, PoseError
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import parameter_posterior, position_accuracy, sigma_of_rows
from pisigma.model.calibrated_model import hybrid_motion, hybrid_poses, nominal_poses_of_rows, poses_of_rows
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import pose_error

pytestmark = pytest.mark.usefixtures("without_type_checker")

SET_UPS = {
    "additive": {"name": "rb5"},
    "products": {"name": "rb5", "products": True, "frames": True},
    "half": {"name": "kiro4", "share": 0.5},
    "joints": {"name": "ur5", "features": ("joints",)},
    "slide": {"name": "kiro3"},
    "payload": {"name": "rb5", "features": ("gravity", "conditions", "series"), "payloads": (0.0, 20.0)},
}


@functools.cache
def model_of(set_up: str):
    arm = hybrid_of(**SET_UPS[set_up])
    return arm, model_of_hybrid("hybrid", arm.true.nominal, arm.result, arm.measurements, ("recipe", "ab"))


@pytest.fixture(scope="module", params=SET_UPS)
def hybrid(request):
    """A simulation, and the model of its calibration."""
    return model_of(request.param)


def everywhere(arm, rows: int = 300) -> torch.Tensor:
    return joints_in(arm.true.nominal, rows, seed=7)


def test_the_set_ups_agree_with_their_names():
    assert model_of("additive")[1].hybrid.correction.orders == ()
    assert set(model_of("products")[1].hybrid.correction.orders) == {2}
    assert [f.name for f in model_of("joints")[1].hybrid.correction.features] == ["joints"]
    assert "conditions" in [f.name for f in model_of("payload")[1].hybrid.correction.features]
    arm, model = model_of("half")
    inside = model.hybrid.coverage.contains(everywhere(arm))
    assert 0 < int(inside.sum()) < len(inside)


def test_the_model_predicts_what_the_calibration_does(hybrid):
    arm, model = hybrid
    assert (model.kind, model.provenance.recipe) == ("hybrid_calibration", "recipe")
    q = everywhere(arm)
    assert_close(model.forward(q), arm.result.arm().forward(q), atol=1e-12)
    assert_close(
        poses_of_rows(model, arm.measurements), arm.result.predicted_poses(arm.measurements), atol=1e-12
    )
    errors = arm.measurements.position - poses_of_rows(model, arm.measurements)[:, :3, 3]
    nominal = arm.measurements.position - nominal_poses_of_rows(model, arm.measurements)[:, :3, 3]
    assert float(errors.square().mean()) < 0.2 * float(nominal.square().mean())


def test_frames_and_targets_are_distinguished():
    arm, model = model_of("products")
    assert list(model.bases) == list(model.hybrid_bases) == ["wall", "floor"]
    q = everywhere(arm, 4)
    names = {"frame": ("wall", "floor") * 2, "target": ("A", "A", "B", "B")}
    rows = Measurements(q=q, **names)
    assert_close(poses_of_rows(model, rows), arm.result.predicted_poses(rows), atol=1e-12)
    assert_close(poses_of_rows(model, rows)[0], model.forward(q)[0], atol=1e-12)
    with refused(MeasurementError, column="frame", value="ceiling"):
        poses_of_rows(model, replace(rows, frame=("ceiling",) * 4))


def test_deviations_are_those_of_the_calibration(hybrid):
    arm, model = hybrid
    own = replace(arm.measurements, q=everywhere(arm, len(arm.measurements.q)), position=None)
    rounding = 1e-5 if model.uncertainty.covariance_root.rounded is None else 1.5 * ROUNDING_TOLERANCE
    expected = arm.result.sigma(own)
    assert_close(sigma_of_rows(model, own), expected, atol=1e-12, rtol=rounding)
    rows = [i for i in range(own.rows) if (own.frame[i], own.target[i]) == (own.frame[0], own.target[0])]
    found = position_accuracy(model, own.q[rows].reshape(1, len(rows), -1))
    usual = {"payload": torch.full_like(own.payload, own.payload.mean())} if own.payload is not None else {}
    expected = arm.result.sigma(replace(own, **usual))
    assert_close(found[0], expected[rows].norm(dim=-1), atol=1e-12, rtol=rounding)


def test_rows_without_a_name_use_the_only_frame():
    arm, model = model_of("additive")
    rows = Measurements(q=everywhere(arm, 3), frame=("anything",) * 3)
    assert_close(sigma_of_rows(model, rows), sigma_of_rows(model, replace(rows, frame=())))
    assert_close(poses_of_rows(model, rows), model.forward(rows.q), atol=1e-12)


def test_the_accuracy_without_rows_is_nan():
    arm, model = model_of("additive")
    q = everywhere(arm, 3)
    q[1, 2] = torch.nan
    found = position_accuracy(model, q)
    assert found.isnan().tolist() == [False, True, False]
    assert bool(position_accuracy(replace(model, uncertainty=None), q).isnan().all())
    assert position_accuracy(model, q[:0]).shape == (0,)


def test_outside_the_measured_joints_the_correction_is_less_certain():
    arm, model = model_of("half")
    q = everywhere(arm)
    inside, moved = model.hybrid.coverage.contains(q), q + model.hybrid.correction(q)
    assert_close(model.forward(q), forward_kinematics(model.hybrid.robot, moved), atol=1e-15)
    predicted = position_accuracy(model, q)
    assert float(predicted[~inside].median()) > 1.2 * float(predicted[inside].median())


def test_a_folder_predicts_the_same_to_the_last_bit(hybrid, tmp_path):
    arm, model = hybrid
    save_model(model, tmp_path)
    loaded = load_model(tmp_path)
    q = everywhere(arm)
    assert torch.equal(loaded.forward(q), model.forward(q))
    assert torch.equal(poses_of_rows(loaded, arm.measurements), poses_of_rows(model, arm.measurements))
    assert torch.equal(sigma_of_rows(loaded, arm.measurements), sigma_of_rows(model, arm.measurements))
    posterior, kept = parameter_posterior(model), parameter_posterior(loaded)
    assert (kept.names, kept.weight_count) == (posterior.names, posterior.weight_count)
    assert torch.equal(kept.mean, posterior.mean)
    assert torch.equal(kept.covariance_root, posterior.covariance_root)
    assert np.array_equal(loaded.robot.dh, model.robot.dh)
    assert np.array_equal(loaded.robot.limits, model.robot.limits)
    assert loaded.branches == model.branches
    assert loaded.provenance == model.provenance
    assert not any(parameter.requires_grad for parameter in loaded.hybrid.correction.parameters())
    again = tmp_path / "again"
    again.mkdir()
    save_model(loaded, again)
    assert (again / "model.yaml").read_bytes() == (tmp_path / "model.yaml").read_bytes()
    assert (again / "model.safetensors").read_bytes() == (tmp_path / "model.safetensors").read_bytes()


def test_a_folder_with_a_rounded_root(tmp_path):
    arm, rounded = model_of("products")
    root = CovarianceRoot(arm.result.uncertainty.dense_root)
    exact = replace(rounded, uncertainty=replace(rounded.uncertainty, covariance_root=root))
    save_model(rounded, tmp_path)
    loaded = load_model(tmp_path)
    assert loaded.uncertainty.covariance_root.rounded is not None
    assert torch.equal(loaded.uncertainty.dense_root, rounded.uncertainty.dense_root)
    q = everywhere(arm)
    assert torch.equal(loaded.forward(q), exact.forward(q))
    assert torch.equal(position_accuracy(loaded, q), position_accuracy(rounded, q))
    assert_close(position_accuracy(loaded, q), position_accuracy(exact, q), rtol=0.015)
    assert_close(sigma_of_rows(loaded, arm.measurements), sigma_of_rows(exact, arm.measurements), rtol=0.01)
    sizes = []
    for model in (exact, rounded):
        folder = tmp_path / str(len(sizes))
        folder.mkdir()
        save_model(model, folder)
        sizes.append((folder / "model.safetensors").stat().st_size)
    assert sizes[1] < sizes[0] / 5


def test_without_a_correction_it_is_the_geometric_model(tmp_path):
    arm, _ = model_of("additive")
    known = arm.result.uncertainty
    size = len(known.space.parameters)
    bare = replace(known, features=(), covariance_root=CovarianceRoot(known.dense_root[:size]))
    result = replace(arm.result, learned=None, uncertainty=bare)
    model = model_of_hybrid("geometric", arm.true.nominal, result, arm.measurements)
    assert (model.kind, model.hybrid) == ("geometric_calibration", None)
    save_model(model, tmp_path)
    loaded = load_model(tmp_path)
    q = everywhere(arm)
    assert torch.equal(loaded.forward(q), forward_kinematics(arm.result.geometric.robot, q))
    assert torch.equal(position_accuracy(loaded, q), position_accuracy(model, q))
    assert_close(sigma_of_rows(model, arm.measurements), result.sigma(arm.measurements), rtol=1e-3, atol=0)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (3, 1, 2), (5000,)], ids=str)
def test_poses_of_batches(batch):
    arm, model = model_of("additive")
    q = everywhere(arm, int(np.prod(batch))).reshape(*batch, 6)
    T = hybrid_poses(model.hybrid, q)
    assert T.shape == (*batch, 4, 4)
    assert_close(T, model.hybrid.forward(q), atol=1e-14)
    with pytest.raises(PoseError, match="theta_6"):
        hybrid_poses(model.hybrid, q[..., :5])


@pytest.mark.parametrize("set_up", ["additive", "products", "half", "slide"])
def test_the_jacobian_agrees_with_differences(set_up):
    arm, model = model_of(set_up)
    inside = (arm.measurements.q[:40] + arm.measurements.q[40:80]) / 2  # not at the ends of what was measured
    q = torch.cat([everywhere(arm, 60), inside])
    T, J = hybrid_motion(model.hybrid, q)
    assert_close(T, model.forward(q), atol=1e-13)
    step = 1e-6 * torch.eye(q.shape[1], dtype=torch.float64)
    for joint in range(q.shape[1]):
        ahead, behind = (model.forward(q + sign * step[joint]) for sign in (1, -1))
        assert_close(J[..., joint], pose_error(ahead, behind) / 2e-6, atol=2e-6)
    cheap = hybrid_motion(model.hybrid, q, exact=False)[1]
    assert 1e-5 < float((cheap - J).abs().max()) < 0.05
    assert float((joint_jacobian(model.calibrated, q)[1] - J).abs().max()) > 1e-5


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A model folder, saved once."""
    path = tmp_path_factory.mktemp("saved")
    save_model(model_of("products")[1], path)
    return path


@pytest.fixture
def folder(saved, tmp_path) -> Path:
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    return tmp_path


def refusal(folder: Path) -> str:
    """The message of the refusal: one line that names the folder."""
    with pytest.raises(ModelError) as caught:
        load_model(folder)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert str(folder) in sentence
    assert len(sentence) < 600
    return sentence


def test_an_unchanged_folder_survives_the_editing_of_these_tests(folder):
    edit_tensors(folder, lambda tensors: None)
    assert load_model(folder).kind == "hybrid_calibration"


@pytest.mark.parametrize("name", ["model.yaml", "model.safetensors"])
@pytest.mark.parametrize("share", [0.3, 0.97, 0.9999])
def test_truncated_files(folder, name, share):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: int(share * len(content))])
    assert refusal(folder)


def _learned(**values):
    return lambda document: document["learned"].update(values)


def _known(**values):
    return lambda document: document["uncertainty"].update(values)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda document: document.update(format=99), "99"),
        (_learned(features=[{"name": "seris", "harmonics": 3}]), "features"),
        (_learned(features=[{"name": "series", "harmonics": 3}]), "key 'uncertainty.features'"),
        (_learned(features=[{"name": "series", "harmonics": 3}] * 2), "key 'uncertainty.features'"),
        (_learned(features=[{"name": "series", "harmonics": 10**9}]), "100000"),
        (_learned(features=[{"name": "series", "harmonics": 4, "gravity": [0, 0, 1]}]), "gravity"),
        (_learned(features=[{"name": "gravity", "gravity": [0.0, 0.0, 0.0]}]), "gravity"),
        (_learned(features=[]), "key 'uncertainty.features'"),
        (_learned(orders=[2, 2]), "(6, 4, 12)"),
        (_learned(orders=[1]), "orders"),
        (_learned(orders=[]), "(6, 0, 12)"),
        (_learned(fade_rad=0.1), "fade_rad"),
        (lambda document: document["learned"]["bases"].pop("floor"), "key 'learned'"),
        (lambda document: document["bases"].pop("floor"), "key 'learned'"),
        (_learned(tools={}), "key 'learned'"),
        (lambda document: document.pop("learned"), "correction."),
        (lambda document: document.pop("uncertainty"), "'uncertainty.numbers'"),
        (lambda document: document.update(calibrated=None), "key 'calibrated'"),
        (_known(free=[0, 1]), "(494,)"),
        (lambda document: document["uncertainty"]["free"].reverse(), "key 'uncertainty.free'"),
        (lambda document: document["uncertainty"]["free"].__setitem__(-1, 9999), "key 'uncertainty.free'"),
        (lambda document: document["uncertainty"]["features"].pop(0), "key 'uncertainty.features'"),
        (lambda document: document["uncertainty"]["features"].remove("products"), "(168,)"),
        (_known(features=3), "features"),
        (_known(unknowns=[{"name": "socket"}]), "unknowns"),
        (_known(prior_scale=-1.0), "prior_scale"),
        (_known(values={"socket": {"A": [0.0, "far"]}}), "values"),
        (lambda document: document["robot"]["rows"][0].update(d_mm=1.0), "'drawn.dh'"),
        (
            lambda document: document["robot"]["rows"][0].update(limits_deg=[-10.0, 10.0]),
            "'drawn.limits'",
        ),
        (lambda document: document["robot"]["rows"][0].pop("limits_deg"), "(5, 2)"),
    ],
)
def test_descriptions_that_do_not_fit(folder, change, named):
    edit(folder, change)
    assert named in refusal(folder)


def _put(name: str, value: torch.Tensor):
    return lambda tensors: tensors.update({name: value})


@pytest.mark.parametrize(
    ("change", "value"),
    [
        (lambda tensors: tensors.pop("learned.dh"), "learned.dh"),
        (lambda tensors: tensors.pop("coverage.half"), "coverage.half"),
        (lambda tensors: tensors.pop("correction.linear.0"), "correction.linear.0"),
        (_put("correction.linear.9", torch.zeros(1).double()), "correction.linear.9"),
        (_put("correction.weight", torch.zeros(6, 3, 12).double()), (6, 3, 12)),
        (
            lambda tensors: tensors.update({"correction.bias": tensors["correction.bias"].float()}),
            torch.float32,
        ),
        (_put("coverage.joint", torch.zeros(6).double()), torch.float64),
        (_put("coverage.joint", torch.zeros(6, dtype=torch.int64)), "coverage.joint"),
        (_put("coverage.middle", torch.zeros(99).double()), "coverage"),
        (lambda tensors: tensors["coverage.half"].fill_(-1.0), "coverage.joint"),
        (lambda tensors: tensors["coverage.half"].fill_(torch.nan), "coverage.half"),
        (lambda tensors: tensors["correction.weight"].view(-1)[3:4].fill_(torch.inf), "correction.weight"),
        (_put("uncertainty.numbers", torch.zeros(9, dtype=torch.uint8)), "uncertainty.numbers"),
        (lambda tensors: tensors["uncertainty.numbers"].resize_(99), "uncertainty.numbers"),
        (lambda tensors: tensors["drawn.dh"].add_(1e-6), "drawn.dh"),
        (lambda tensors: tensors["calibrated.base"].add_(1e-6), "calibrated.base"),
        (lambda tensors: tensors["drawn.limits"].add_(1e-6), "drawn.limits"),
        (
            lambda tensors: tensors.update({"uncertainty.unit": tensors["uncertainty.unit"].float()}),
            torch.float32,
        ),
    ],
)
def test_tensors_that_do_not_fit(folder, change, value):
    edit_tensors(folder, change)
    with refused(ModelError, file="model.safetensors", value=value):
        load_model(folder)
