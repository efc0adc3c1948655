"""Pairs of models of one robot, and refusal of models of different robots."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.compared import model_of
from testing.models import hand_made_model
from testing.refusals import refused

from pisigma.files.errors import ModelError
from pisigma.lifetime.comparison.model_pair import Displacement, ModelPair
from pisigma.robot.kinematics.forward import forward_kinematics


def test_moved_base_and_tool_do_not_matter_with_fitted_frames():
    model = hand_made_model("ur10", scale=0.0)
    base, tool = np.array([[0.4, -0.3, 0.2, 0.5, 0.1, -0.2], [0.1, 0.0, 0.2, 0.3, 0.0, 0.1]])
    moved = replace(model, name="moved", robot=model.robot.with_geometry(base=base, tool=tool))
    by = ModelPair.from_models(model, moved, "fitted").displacement(model.starts)
    assert_close(by, torch.zeros_like(by), atol=1e-7)
    assert (
        float(
            ModelPair.from_models(model, moved, "fixed").displacement(model.starts)[:, :3].norm(dim=1).min()
        )
        > 0.1
    )


def test_corrections_of_networks_are_compared():
    first, second = hand_made_model("kiro3", scale=0.0), hand_made_model("kiro3", scale=0.002)
    pair = ModelPair.from_models(first, second, "fixed")
    q = pair.training_joints
    T = forward_kinematics(second.robot, second.nominal_joints(q))
    expected = T[:, :3, 3] - forward_kinematics(first.robot, q)[:, :3, 3]
    assert_close(pair.displacement(q)[:, :3], expected, atol=1e-12)
    displacement = Displacement.from_pair(pair, pair.workspace_joints, "the workspace")
    assert len(displacement.q) + displacement.poses_not_predicted == 3000


@pytest.mark.parametrize(
    ("other", "quantities"), [("kiro3", ["joints"]), ("ur5e", ["a", "d"]), ("rb5", ["joints", "rows"])]
)
def test_different_robots_are_refused(other, quantities):
    others = model_of(50) if other == "rb5" else hand_made_model("kiro3")
    if other == "ur5e":
        robot = hand_made_model("ur10").robot
        others = replace(
            hand_made_model("ur10"), robot=robot.with_geometry(dh=robot.dh * [1, 0.7, 0.7, 1, 1])
        )
    with refused(ModelError) as caught:
        ModelPair.from_models(hand_made_model("ur10"), others, "fitted")
    assert caught.value.value in quantities


def test_fixed_frames_need_a_common_name():
    model = hand_made_model("ur10", scale=0.0)
    first, second = (replace(model, bases={name: model.robot.base}) for name in ("wall", "floor"))
    with refused(ModelError, option="frame", value="wall and floor"):
        ModelPair.from_models(first, second, "fixed")
    assert ModelPair.from_models(first, second, "fitted").frame_names == (("wall", ""), ("floor", ""))
