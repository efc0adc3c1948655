"""Compiled inverse kinematics reaches the poses, agrees with torch, and rejects invalid input."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, no_type_checker, with_limits
from testing.refusals import refused

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.files.errors import ModelError, PoseError
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.shared_features import NominalPose
from pisigma.model.compiled_model import describe_as_arrays, save_compiled
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_error import task_error

NAMES = ["kiro3", "kiro4", "ur5", "rb5", "panda"]


def _torch_solutions(model, T, near=None, branch=None):
    with no_type_checker():
        return NumericIK(model).solve_batch(T, near=near, branch=branch)


def _both(name, arms, rows=40, near=False, **kind):
    """Return joint values, poses, the compiled solution and that of torch."""
    model = arms.calibrated(name, **kind)
    q = arms.draw_joints(model.robot, rows, seed=7, share=kind.get("covered", 1.0) * 1.05)
    T = model.forward(q)
    beside = q + 0.02 * torch.sin(17 * q) if near else None
    found = arms.compiled(name, **kind).solve_batch(T.numpy(), None if beside is None else beside.numpy())
    return q, T, found, _torch_solutions(model, T, beside)


def _left(kernels, model, q, T):
    """Return pose errors in the tool axes that are not free: all six except for a SCARA."""
    error, _ = task_error(kernels.task_axes, T, model.forward(torch.from_numpy(q)))
    return error[:, ~torch.tensor(kernels.task_axes.free)]


CASES = [
    ("kiro3", False, True, 1.0),
    ("kiro3", True, False, 1.0),
    ("kiro4", True, True, 0.5),
    ("kiro4", False, False, 1.0),
    ("ur5", False, True, 1.0),
    ("ur5", True, True, 0.5),
    ("ur5", True, False, 1.0),
    ("rb5", True, True, 1.0),
    ("rb5", False, True, 0.5),
    ("panda", False, True, 1.0),
    ("panda", True, True, 0.5),
    ("panda", True, False, 1.0),
]
"""Name, whether near other joint values, whether hybrid, and the covered share: each value for every closed form."""


@pytest.mark.parametrize(("name", "near", "hybrid", "covered"), CASES)
def test_solutions_agree_with_torch(name, near, hybrid, covered, arms):
    _, _, found, expected = _both(name, arms, near=near, hybrid=hybrid, covered=covered)
    reached = (found.status != Status.UNREACHABLE) & (expected.status.numpy() != Status.UNREACHABLE)
    same = reached & (found.branch == expected.branch.numpy())
    assert same.mean() > 0.95 * (expected.status != Status.UNREACHABLE).double().mean()
    free = same & (found.status == expected.status.numpy()) & (found.status != Status.SINGULAR)
    assert free.mean() > 0.9 * same.mean()
    difference = np.abs(found.q - expected.q.numpy())[free].max(-1)
    part = (
        0.95 if name != "panda" else 0.5
    )  # of many solutions a redundant arm's depends on every step that led there
    assert np.quantile(difference, part) < 1e-9
    both = free & np.isfinite(found.q_nominal).all(-1) & np.isfinite(expected.q_nominal.numpy()).all(-1)
    if both.any():
        assert np.quantile(np.abs(found.q_nominal - expected.q_nominal.numpy())[both].max(-1), part) < 1e-6
    assert both.any() or name == "kiro3"  # whose nominal arm does not tilt


@pytest.mark.parametrize(
    ("name", "covered"),
    [("kiro3", 1.0), ("kiro4", 0.5), ("ur5", 1.0), ("rb5", 0.5), ("panda", 1.0), ("panda", 0.5)],
)
def test_reached_poses_are_reached(name, covered, arms):
    model, kernels = arms.calibrated(name, covered=covered), arms.compiled(name, covered=covered)
    q = arms.draw_joints(model.robot, 2000, seed=8, share=covered)
    T = model.forward(q)
    found = kernels.solve_batch(T.numpy(), near=q.numpy() + 0.01)
    reached = found.status != Status.UNREACHABLE
    assert reached.mean() >= (0.999 if name != "panda" else 0.99)
    assert_close(_left(kernels, model, found.q[reached], T[reached]), 0.0, atol=1e-10)
    assert found.position_residual[reached].max() < 1e-10
    assert found.rotation_residual[reached].max() < 1e-10
    assert np.isnan(found.q[~reached]).all()
    assert (np.abs(found.q - q.numpy()).max(-1) < 1e-6).mean() > 0.99 or model.robot.dof > 6


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "ur5"])  # one for every closed form
def test_every_branch_agrees_with_torch(name, arms):
    model, kernels = arms.calibrated(name), arms.compiled(name)
    T = model.forward(arms.draw_joints(model.robot, 4, seed=9))
    for branch in kernels.branches[:: 1 if len(kernels.branches) == 2 else 3]:  # both values of every fork
        found, expected = (
            kernels.solve_batch(T.numpy(), branch=branch),
            _torch_solutions(model, T, branch=branch),
        )
        reached = (found.status != Status.UNREACHABLE) & (expected.status.numpy() != Status.UNREACHABLE)
        assert reached.sum() >= (expected.status != Status.UNREACHABLE).sum() - 1
        assert (found.branch == kernels.branches.index(branch)).all()
        if not reached.any():
            assert name == "kiro3"  # four joints reach a pose on the branch that it was made on only
            continue
        difference = np.abs(found.q - expected.q.numpy())[reached].max(-1)
        assert np.median(difference) < 1e-11
        assert np.sort(difference)[:-1].max() < 1e-7


@pytest.mark.parametrize("name", NAMES)
def test_batches_equal_single_poses_on_any_number_of_threads(name, arms):
    model, kernels = arms.calibrated(name), arms.compiled(name)
    q = arms.draw_joints(model.robot, 400, seed=10)
    T = model.forward(q).numpy()
    found = kernels.solve_batch(T, threads=2)
    again = kernels.solve_batch(T, threads=1)
    assert np.array_equal(found.q, again.q, equal_nan=True)
    for i in range(0, 400, 40):
        single = kernels.solve(T[i])
        assert np.array_equal(single.q, found.q[i], equal_nan=True)
        assert (single.status, single.branch) == (found.status[i], found.branch[i])
    assert kernels.solve_batch(T[:0]).q.shape == (0, model.robot.dof)


def test_orientation_errors_of_half_a_turn_are_solved(arms):
    model, kernels = arms.calibrated("ur5"), arms.compiled("ur5")
    q = arms.draw_joints(model.robot, 50, seed=11)
    flipped = model.forward(q) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    found = kernels.solve_batch(flipped.numpy(), near=q.numpy())
    reached = found.status != Status.UNREACHABLE
    assert reached.any()
    assert_close(model.forward(torch.from_numpy(found.q[reached])), flipped[reached], atol=1e-10)


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "ur5", "rb5", "fanuc_r2000"])
def test_poses_that_only_the_calibrated_arm_reaches_are_solved(name, arms):
    """They are near singular poses: no nominal branch reaches them, but one comes near."""
    model = arms.calibrated(name)
    T = model.forward(arms.draw_joints(model.robot, 200 if name == "kiro3" else 10_000, seed=21))
    nominal = torch.isfinite(closed_form_solver(model.robot).solve(T).q).all(-1).any(-1)
    T = T[~nominal].numpy()
    assert len(T) >= 20
    found = arms.compiled(name).solve_batch(T)
    reached = found.status != Status.UNREACHABLE
    assert reached.mean() > 0.95
    left = _left(arms.compiled(name), model, found.q[reached], torch.from_numpy(T[reached]))
    assert_close(left, 0.0, atol=1e-10)


def test_statuses_describe_the_result(arms):
    model, kernels = arms.calibrated("ur5", covered=0.5), arms.compiled("ur5", covered=0.5)
    far = np.eye(4)
    far[:3, 3] = 9.0
    assert kernels.solve(far).status == Status.UNREACHABLE
    assert np.isnan(kernels.solve(far).q).all()
    q = torch.full((1, 6), 0.8, dtype=torch.float64)
    q[0, 0] = 3.0
    outside = kernels.solve(model.forward(q)[0].numpy(), near=q[0].numpy())
    assert outside.status == Status.OUTSIDE_DOMAIN
    assert_close(outside.domain_measure, 1 + model.hybrid.coverage.distance_outside(q).max(), atol=1e-12)
    assert outside.domain_measure > 1
    stretched = torch.tensor([0.3, -0.7, 0.0, 0.5, 0.6, 0.2], dtype=torch.float64)
    geometric = arms.calibrated("ur5", hybrid=False)
    nominal = replace(geometric, calibrated=None)
    T = nominal.forward(stretched[None])[0].numpy()
    assert CompiledIK.from_model(nominal).solve(T, near=stretched.numpy()).status == Status.SINGULAR


def test_limits_apply_to_the_corrected_values(arms):
    model = arms.calibrated("ur5", hybrid=False)
    q = torch.tensor([0.3, -0.7, 1.0, 0.5, 0.6, 0.2], dtype=torch.float64)
    T = model.forward(q[None])[0].numpy()
    turned = q.clone()
    turned[5] -= 2 * np.pi
    for lower, upper, status, value in (
        (-1.0, 1.0, Status.REACHED, 0.2),
        (6.0, 7.0, Status.REACHED, 0.2 + 2 * np.pi),
        (1.0, 2.0, Status.OUTSIDE_JOINT_LIMITS, 0.2),
    ):
        robots = [with_limits(robot, 5, lower, upper) for robot in (model.robot, model.calibrated)]
        kernels = CompiledIK.from_model(replace(model, robot=robots[0], calibrated=robots[1]))
        branch = kernels.branches[arms.compiled("ur5", hybrid=False).solve(T, near=q.numpy()).branch]
        found = kernels.solve(T, near=q.numpy(), branch=branch)
        assert found.status == status
        assert_close(found.q[5], value, atol=1e-9)
        assert len(found.sentences) == 1
    near = arms.compiled("ur5", hybrid=False).solve(T, near=turned.numpy())
    assert_close(near.q, turned, atol=1e-9)


def test_a_correction_that_differs_between_turns_is_solved_on_the_given_turn(arms):
    model, kernels = arms.calibrated("ur5", joints=True), arms.compiled("ur5", joints=True)
    q = arms.draw_joints(model.robot, 50, seed=12)
    q[:, 5] += torch.where(q[:, 5] > 0, -2 * torch.pi, 2 * torch.pi)
    T = model.forward(q)
    found = kernels.solve_batch(T.numpy(), near=q.numpy())
    reached = found.status != Status.UNREACHABLE
    assert reached.mean() > 0.9
    assert_close(model.forward(torch.from_numpy(found.q[reached])), T[reached], atol=1e-10)
    assert (np.abs(found.q - q.numpy())[reached].max(-1) < 1e-6).mean() > 0.9


GOOD = np.eye(4)
INVALID = {
    "nan": (np.where(np.eye(4) == 0, np.nan, 1.0), "finite entries"),
    "infinite": (GOOD + np.inf, "finite entries"),
    "scaled": (np.diag([2.0, 2.0, 2.0, 1.0]), "an orthonormal rotation part"),
    "mirrored": (np.diag([1.0, 1.0, -1.0, 1.0]), "a right-handed rotation part (determinant +1)"),
    "last row": (2 * np.eye(4), "the last row 0 0 0 1"),
    "shape": (np.eye(3), "one homogeneous transform of shape (4, 4)"),
    "text": ([["a"] * 4] * 4, "an array of real numbers with lengths in metres"),
    "ragged": ([[1.0], [1.0, 2.0]], "an array of real numbers with lengths in metres"),
}


@pytest.mark.parametrize("case", INVALID)
def test_invalid_poses_are_rejected_on_one_line(case, arms):
    kernels, (T, expected) = arms.compiled("ur5"), INVALID[case]
    with refused(PoseError, option="T_base_tool", expected=expected) as caught:
        kernels.solve(T)
    assert "\n" not in str(caught.value)
    if case not in ("text", "ragged", "shape"):
        with pytest.raises(PoseError, match="index 3"):
            kernels.solve_batch(np.stack([GOOD, GOOD, GOOD, T, GOOD]))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"near": np.zeros(5)}, "6 columns"),
        ({"near": np.full(6, np.nan)}, "finite joint values"),
        ({"near": "here"}, "an array of real numbers with lengths in metres"),
        ({"branch": "front/elbow_up/no_flop"}, ""),
    ],
)
def test_invalid_options_are_rejected(options, expected, arms):
    (option,) = options
    with refused(PoseError, option=option, expected=expected):
        arms.compiled("ur5").solve(GOOD, **options)
    with refused(PoseError, option=option, expected=expected):
        arms.compiled("ur5").solve_batch(GOOD[None], **options)


def test_invalid_batches_are_rejected(arms):
    kernels = arms.compiled("ur5")
    with refused(PoseError, option="T_base_tool", value=(3, 4)):
        kernels.solve_batch(GOOD[:3])
    with refused(PoseError, option="threads", value=0):
        kernels.solve_batch(GOOD[None], threads=0)
    with refused(PoseError, option="T_base_tool", expected="an array of real numbers with lengths in metres"):
        kernels.solve_batch([["a"] * 4] * 4)


def test_models_without_a_compiled_form_are_rejected(arms):
    model = arms.calibrated("ur5")
    with refused(ModelError, value="network"):
        describe_as_arrays(replace(hand_made_model("ur10"), calibrated=model.calibrated))
    correction = JointCorrection(model.robot, [NominalPose(model.robot)])
    arm = HybridArm(model.calibrated, correction, model.hybrid.coverage)
    with refused(ModelError, value="pose"):
        describe_as_arrays(replace(model, hybrid=arm))
    panda = arms.calibrated("panda")
    with refused(ModelError, value="starts"):
        describe_as_arrays(replace(panda, starts=panda.starts[:0]))
    with refused(ModelError, value=(800, 7)):
        CompiledIK.from_model(replace(panda, starts=panda.starts.repeat(2, 1)))


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_a_file_is_restored_without_torch(name, arms, tmp_path):
    model, kernels = arms.calibrated(name), arms.compiled(name)
    T = model.forward(arms.draw_joints(model.robot, 1, seed=13))[0].numpy()
    file = tmp_path / "compiled.npz"
    save_compiled(model, file)
    np.save(tmp_path / "T.npy", T)
    script = (
        "import sys\nimport numpy as np\n"
        "from pisigma.model.inverse.compiled_ik import CompiledIK\n"
        f"found = CompiledIK.load({str(file)!r}).solve(np.load({str(tmp_path / 'T.npy')!r}))\n"
        "heavy = ('torch', 'lightning', 'jaxtyping', 'matplotlib', 'pydantic', 'numba')\n"
        "assert not [name for name in heavy if name in sys.modules]\n"
        "print(found.q.tolist())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert_close(np.array(eval(done.stdout)), kernels.solve(T).q, atol=1e-12)
    save_compiled(model, file, model_folder_hash="5ca1ab1e")
    loaded = CompiledIK.load(file)
    assert (loaded.belongs_to, kernels.belongs_to) == ("5ca1ab1e", "")
    assert (loaded.branches, loaded.joints, loaded.name) == (kernels.branches, kernels.joints, kernels.name)


def test_invalid_files_are_rejected(arms, tmp_path):
    file = tmp_path / "compiled.npz"
    save_compiled(arms.calibrated("ur5"), file)
    content = file.read_bytes()
    with refused(ModelError, file="missing.npz", value="No such file or directory"):
        CompiledIK.load(tmp_path / "missing.npz")
    for wrong in (b"", b"nothing", content[: len(content) // 2], content[:3000] + b"x" + content[3001:]):
        file.write_bytes(wrong)
        with refused(ModelError, file=file):
            CompiledIK.load(file)
    np.savez(tmp_path / "other.npz", q=np.zeros(3))
    with refused(ModelError, file="other.npz", expected="format 7", value=None):
        CompiledIK.load(tmp_path / "other.npz")
