"""Arms of one torso: models with one set of parameters of the shared joints, what moved, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.torso import ARMS, IN_HALL, NOISE, TORSO, measured_rows, nominal_arms, true_arm

from pisigma.files.errors import IdentificationError, PlanningError
from pisigma.files.yaml_file import read_yaml
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector, transform, transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.validation.held_out.arms_summary import ArmsSummary
from pisigma.workflow.arms.calibrate_arms import FRAMES_FILE, Arm, arms_of_cell, calibrate_arms
from pisigma.workflow.arms.find_moved_arms import find_moved_arms
from pisigma.workflow.arms.torso import torso_joints
from pisigma.workflow.settings.calibration import CalibrationSettings

JOINTS = 2


@pytest.fixture(scope="module")
def nominal(tmp_path_factory) -> tuple[Robot, Robot]:
    """Both arms."""
    return nominal_arms(tmp_path_factory.mktemp("torso"), JOINTS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, nominal) -> Path:
    """The models of both arms."""
    quick = CalibrationSettings(folds=0)
    arms = [
        Arm(name, robot, measured_rows(true_arm(nominal, k, 0, JOINTS), k), quick)
        for k, (name, robot) in enumerate(zip(ARMS, nominal, strict=True))
    ]
    path: Path = tmp_path_factory.mktemp("arms") / "models"
    calibrate_arms(arms).save(path)
    return path


def now(nominal: tuple[Robot, Robot], motion: torch.Tensor, zero: float = 0.0) -> dict[str, Measurements]:
    """Return new rows of both arms in the frame, after a motion of the base and a new zero of the waist."""
    base = xyz_zyx_from_transform(motion @ transform_from_xyz_zyx(torch.from_numpy(IN_HALL))).numpy()
    return {
        name: measured_rows(true_arm(nominal, k, 0, JOINTS, zero).with_geometry(base=base), 100 + k, 10)
        for k, name in enumerate(ARMS)
    }


STILL = torch.eye(4, dtype=torch.float64)


def test_models_have_the_same_values_of_the_shared_joints(folder, nominal):
    left, right = (load_model(folder / name) for name in ARMS)
    shared = JOINTS - 1
    for model in (left, right):
        assert model.calibrated is not None
        assert model.uncertainty is not None
        assert float(np.abs(model.calibrated.dh[:shared] - nominal[0].dh[:shared]).max()) > 1e-4
    assert_close(left.calibrated.dh[:shared], right.calibrated.dh[:shared], atol=1e-12)
    assert_close(left.bases["hall"], right.bases["hall"], atol=1e-9)
    for number, model in enumerate((left, right)):
        rows = measured_rows(true_arm(nominal, number, 0, JOINTS), 50 + number)
        apart = forward_kinematics(model.calibrated, rows.q)[:, :3, 3] - rows.position
        assert float(apart.square().mean().sqrt()) < 2 * NOISE


def test_frames_state_one_base_and_the_shared_joints(folder):
    written = read_yaml(folder / FRAMES_FILE, ArmsSummary, PlanningError)
    (base,) = written.bases
    assert_close([base.x_mm, base.y_mm, base.z_mm, base.roll_deg], [0.0] * 4, atol=1e-9)
    assert [arm.torso for arm in written.arms] == [TORSO, TORSO]
    assert [(one.kind, one.name) for one in written.shared] == [("joint", one) for one in TORSO] + [
        ("frame", "hall")
    ]
    assert (written.degrees_of_freedom, written.diagnostics) == (8, ())


def test_nothing_is_named_if_nothing_moved(folder, nominal):
    assert not any(one.is_best_explanation for one in find_moved_arms(folder, now(nominal, STILL)).bodies)


def test_new_zero_of_the_waist_is_named_once(folder, nominal):
    found = find_moved_arms(folder, now(nominal, STILL, 1e-3))
    (one,) = (one for one in found.bodies if one.is_best_explanation)
    assert (one.kind, one.name, found.moved_bases.is_one_body) == ("joint", "waist", True)
    assert_close(np.deg2rad(np.linalg.norm(one.rotation_deg)), 1e-3, atol=1e-4)


def test_base_of_the_torso_or_the_frame_is_named(folder, nominal):
    bump = transform(
        rotation_from_vector(torch.tensor([5e-4, 0, 0]).double()), torch.tensor([0, 5e-4, 0]).double()
    )
    found = find_moved_arms(folder, now(nominal, bump))
    assert {(one.kind, one.name) for one in found.bodies if one.is_best_explanation} == {
        ("arm", "left"),
        ("frame", "hall"),
    }


def test_arms_of_a_cell_are_read_with_their_torso(tmp_path):
    nominal_arms(tmp_path)
    lines = [f"  {name}: {{robot: torso.urdf, tip: {name}_6_link, sessions: [{name}.csv]}}" for name in ARMS]
    (tmp_path / "cell.yaml").write_text("\n".join(["arms:", *lines]))
    arms = arms_of_cell(tmp_path)
    assert torso_joints(ARMS, [arm.robot for arm in arms]) == {"left": ("waist",), "right": ("waist",)}


def test_arms_with_other_joints_in_common_are_refused(tmp_path):
    left, right = nominal_arms(tmp_path, JOINTS)
    path = tmp_path / "torso.urdf"
    on_chest = Robot.load(path, "waist_link", "right_6_link")
    with refused(IdentificationError, value="right", option="arms"):
        torso_joints(ARMS, (left, on_chest))
    with refused(IdentificationError, value="again", option="arms"):
        torso_joints((*ARMS, "again"), (left, right, left))
    path.write_text(path.read_text().replace('name="chest" type="revolute"', 'name="chest" type="prismatic"'))
    with refused(IdentificationError, value="right", option="arms"):
        torso_joints(ARMS, [Robot.load(path, tip=f"{side}_6_link") for side in ARMS])
    ur5 = Robot.load("ur5")
    assert torso_joints(ARMS, (ur5, ur5)) == {"left": (), "right": ()}


def test_joint_correction_of_an_arm_of_a_torso_is_refused(nominal):
    settings = CalibrationSettings(features=("gravity",))
    arms = [Arm(name, one, measured_rows(one, 0), settings) for name, one in zip(ARMS, nominal, strict=True)]
    with refused(IdentificationError, option="features"):
        calibrate_arms(arms)


def test_moved_chest_is_named(nominal):
    quick = CalibrationSettings(model="geometric", folds=0)
    arms = []
    for k, (name, robot) in enumerate(zip(ARMS, nominal, strict=True)):
        true = true_arm(nominal, k, 0, JOINTS)
        dh = true.dh.copy()
        dh[0, 3] += 2e-3 * k
        arms.append(Arm(name, robot, measured_rows(true.with_geometry(dh), k), quick))
    found = calibrate_arms(arms)
    assert not found.trusted
    assert ("joint", "chest") in {(one.cause, one.values["name"]) for one in found.summary.diagnostics}
