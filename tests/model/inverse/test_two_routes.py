"""Arrays, which are solved without torch, and tensors have the same solutions, with and without kernels."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.refusals import numbers_in, refused

import pisigma
from pisigma.files.errors import ModelError, PoseError
from pisigma.files.model_files import COMPILED, DESCRIPTION, WEIGHTS, compiled_model_hash
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import save_model
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.loading import load
from pisigma.model.inverse.solution import Solution
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.workflow.load import load as workflow_load


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model folder of a UR10 with errors in all parameters."""
    nominal, rng = Robot.load("ur10"), np.random.default_rng(4)
    model = CalibratedModel(
        name="cell",
        kind="geometric_calibration",
        robot=nominal,
        network=None,
        domain=None,
        branches=(),
        starts=joints_around("ur10", 50, spread=0.6),
        calibrated=nominal.with_geometry(nominal.dh + 5e-4 * rng.normal(size=nominal.dh.shape)),
    )
    path = tmp_path_factory.mktemp("models") / "cell"
    path.mkdir()
    with no_type_checker():
        save_model(model, path)
    return path


@pytest.fixture(scope="module")
def ik(folder):
    return load(folder)


@pytest.fixture(scope="module")
def poses(ik):
    with no_type_checker():
        return ik.model.forward(joints_around("ur10", 3, 4, spread=0.5))


def call(ik, *arguments, **options):
    with no_type_checker():
        return ik(*arguments, **options)


@pytest.mark.parametrize("batch", [(), (4,), (3, 4), (0,)])
def test_both_routes_give_the_same_in_their_own_kind(ik, poses, batch):
    T = {(): poses[0, 0], (4,): poses[1], (3, 4): poses, (0,): poses[0, :0]}[batch]
    arrays, tensors = call(ik, T.numpy()), call(ik, T)
    assert type(arrays) is type(tensors) is Solution
    assert isinstance(arrays.q, np.ndarray)
    assert isinstance(tensors.q, torch.Tensor)
    assert arrays.q.shape == tuple(tensors.q.shape) == (*batch, 6)
    for name in ("q", "q_nominal", "correction"):
        assert_close(getattr(arrays, name), getattr(tensors, name), atol=1e-9)
    for name in ("status", "branch"):
        assert_close(np.asarray(getattr(arrays, name)), getattr(tensors, name))
    for name in ("position_residual", "rotation_residual"):
        assert np.shape(getattr(arrays, name)) == batch
        assert_close(np.asarray(getattr(arrays, name)), np.zeros(batch), atol=1e-9)
        assert_close(getattr(tensors, name), np.zeros(batch), atol=1e-9)
    assert arrays.sentences == tensors.sentences
    assert arrays.branches == tensors.branches == ik.branches
    assert np.isnan(arrays.accuracy).all()  # nothing is known of it
    assert np.shape(arrays.accuracy) == batch


def test_lists_are_arrays(ik, poses):
    assert_close(call(ik, poses[0, 0].tolist()).q, call(ik, poses[0, 0].numpy()).q)
    assert_close(call(ik, poses.tolist()).q, call(ik, poses.numpy()).q)


def test_near_of_any_batch(ik, poses):
    q = call(ik, poses.numpy()).q
    for near in (q[0, 0], q[0], q, q[:, :1]):
        beside = np.broadcast_to(near, q.shape)
        expected = call(ik, poses, near=torch.from_numpy(beside.copy())).q
        assert_close(call(ik, poses.numpy(), near=near).q, expected, atol=1e-9)
    with refused(PoseError, option="near", value=(2, 4)):
        call(ik, poses.numpy(), near=q[:2])
    with refused(PoseError, option="near", value=(2,)):
        call(ik, poses[0, 0].numpy(), near=[0.0, 1.0])


def test_all_branches(ik, poses):
    with no_type_checker():
        arrays, tensors = ik.all_branches(poses.numpy()), ik.all_branches(poses)
    assert arrays.q.shape == (3, 4, len(ik.branches), 6)
    assert_close(arrays.status, tensors.status)
    reached = np.isfinite(arrays.q).all(-1)
    assert reached.any()
    assert_close(arrays.q[reached], tensors.q.numpy()[reached], atol=1e-9)


def spoil(T, rows):
    bad = T.copy()
    bad[rows[0]], bad[rows[1]], bad[rows[2]][3, 0] = np.nan, 2 * T[0], 0.5
    bad[rows[3], :3, 0] *= -1
    return bad


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_without_raising(ik, poses, kind):
    T = poses.reshape(-1, 4, 4).numpy()
    rows = [1, 4, 6, 9]
    found = call(ik, kind(spoil(T, rows)), throw=False)
    bad = np.isin(np.arange(len(T)), rows)
    assert_close(np.asarray(found.status == Status.INVALID_POSE), bad)
    assert np.isnan(np.asarray(found.q)[bad]).all()
    assert_close(np.asarray(found.q)[~bad], call(ik, T).q[~bad], atol=1e-9)
    assert found.sentences[1] == Status.INVALID_POSE.sentence
    with refused(PoseError, option="T_base_tool", expected="finite entries") as caught:
        call(ik, kind(spoil(T, rows)))
    assert numbers_in(str(caught.value)) == [1]  # the index of the first one
    near = np.asarray(call(ik, T).q).copy()
    near[2, 3] = np.nan
    found = call(ik, kind(T), near=kind(near), throw=False)
    assert np.flatnonzero(np.asarray(found.status) == Status.INVALID_POSE).tolist() == [2]
    with refused(PoseError, option="T_base_tool", value=(3, 3)):
        call(ik, kind(np.zeros((3, 3))), throw=False)
    with refused(PoseError, option="branch", value="up"):
        call(ik, kind(T), branch="up", throw=False)


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_near_in_degrees_is_refused(ik, poses, kind):
    T = poses.reshape(-1, 4, 4).numpy()
    near = np.asarray(call(ik, T).q).copy()
    turned = near + np.clip(-np.sign(near), -1, 1) * 2 * np.pi  # other wraps are valid
    assert_close(call(ik, kind(T), near=kind(turned)).position_residual, 0.0, atol=1e-10)
    near[5] = np.degrees(near[5])
    far = np.flatnonzero(np.abs(near[5]) > 4 * np.pi)[0]
    fields = {"option": "near", "value": near[5, far]}
    for values in (near, near[5]):
        with refused(PoseError, **fields) as caught:
            call(ik, kind(T), near=kind(values))
        assert f"joint theta_{far + 1} " in str(caught.value)
    with refused(PoseError, **fields):
        call(ik, kind(T[5]), near=kind(near[5]))
    found = call(ik, kind(T), near=kind(near), throw=False)
    assert np.flatnonzero(np.asarray(found.status) == Status.INVALID_POSE).tolist() == [5]
    one = call(ik, kind(T[5]), near=kind(near[5]), throw=False)
    assert int(one.status) == Status.INVALID_POSE
    assert np.isnan(np.asarray(one.q)).all()
    with refused(PoseError, **fields), no_type_checker():
        ik.path(T, near=near[5])


def test_near_in_millimetres_is_refused():
    with no_type_checker():
        scara = CorrectedIK(hand_made_model("kiro3"))
    with refused(PoseError, option="near", value=-120.0) as caught:
        call(scara, np.eye(4), near=[0.3, 0.8, -120.0, 0.4])
    assert "joint d_3 " in str(caught.value)
    assert numbers_in(str(caught.value))[:2] == [-120, 1]


def test_values_that_are_not_numbers_are_refused(ik, poses):
    T = poses.reshape(-1, 4, 4).numpy()
    for wanted in (T, T[0]):
        with refused(PoseError, option="near", value=None):
            call(ik, wanted, near=["left"] * 6)
        found = call(ik, wanted, near=["left"] * 6, throw=False)
        assert (np.asarray(found.status) == Status.INVALID_POSE).all()
    with refused(PoseError, option="T_base_tool", value=None):
        call(ik, [["a"] * 4] * 4)
    with refused(PoseError, option="T_base_tool", value=(2, 3)):
        call(ik, np.zeros((2, 3)))


def test_a_robot_program_needs_no_torch(folder, tmp_path):
    """From a folder to joint values, as in a control program."""
    np.save(tmp_path / "q.npy", [0.1, -1.0, 1.2, -0.4, 1.1, 0.3])
    program = f"""
import sys
import numpy as np
import pisigma
ik = pisigma.load({str(folder)!r})
T = np.eye(4)
T[:3, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
T[:3, 3] = 0.6, 0.2, 0.5
found = ik(T)
assert found.status == pisigma.Status.REACHED, found.sentences
again = ik(T, near=found.q)
assert abs(again.q - found.q).max() < 1e-9
assert ik(T[None], throw=False).q.shape == (1, 6)
print(sorted(name for name in ("torch", "lightning", "matplotlib", "scipy") if name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[]\n"


def test_compiled_arrays_belong_to_the_state_of_the_model(folder, tmp_path, poses):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    assert "compiled" in vars(load(copy))  # read, not made
    expected = load(copy).model.robot.dh
    text = (copy / DESCRIPTION).read_text()
    (copy / DESCRIPTION).write_text(text + "\n")
    with refused(ModelError, file=DESCRIPTION):
        load(copy)  # the compiled arrays are stale, so the changed folder itself is read
    (copy / DESCRIPTION).write_text(text)
    (copy / COMPILED).write_bytes((copy / COMPILED).read_bytes()[:-100])
    made = load(copy)
    assert "compiled" not in vars(made)
    assert_close(made.model.robot.dh, expected)
    assert_close(call(made, poses.numpy()).q, call(load(folder), poses.numpy()).q, atol=1e-12)
    (copy / COMPILED).unlink()
    assert_close(call(load(copy), poses.numpy()).q, call(load(folder), poses.numpy()).q, atol=1e-12)
    (copy / WEIGHTS).unlink()
    assert compiled_model_hash(copy) is None
    with refused(ModelError, value=WEIGHTS):
        load(copy)


def test_a_folder_that_is_changed_after_loading_is_refused(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    ready = load(copy)
    (copy / DESCRIPTION).write_text((copy / DESCRIPTION).read_text() + "\n")
    with refused(ModelError, file=str(copy), remedy="load it again"):
        _ = ready.model


def test_a_model_in_memory_equals_its_folder(poses, ik):
    made = CorrectedIK(ik.model)
    assert (made.name, made.branches, made.joints) == (ik.name, ik.branches, ik.joints)
    assert made.branch_order == ik.branch_order
    assert made.closed_form == ik.closed_form
    assert_close(made.limits, ik.limits)
    assert_close(made.revolute, ik.revolute)
    assert_close(call(made, poses.numpy()).q, call(ik, poses.numpy()).q, atol=1e-12)


def test_a_network_model_has_the_same_solutions_by_both_routes():
    with no_type_checker():
        made = CorrectedIK(hand_made_model("kiro4"))
        T = made.model.forward(joints_around("kiro4", 30, spread=0.1))
    arrays, tensors = call(made, T.numpy()), call(made, T)
    assert_close(arrays.q, tensors.q, atol=1e-9)
    assert_close(arrays.status, tensors.status)
    assert_close(arrays.domain_measure, tensors.domain_measure, rtol=1e-9)


def test_public_names():
    assert pisigma.load is workflow_load
    assert pisigma.CorrectedIK is CorrectedIK
