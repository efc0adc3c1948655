"""Comparison of a session with a model: moved joints, moved instruments, and unobservable joints."""

import math
from dataclasses import replace

import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close

from pisigma.lifetime.monitoring.session import judge_session
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.model.model_posterior import ModelPosterior

ELSEWHERE = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)


def moved_joint(joint, degrees=0.05):
    return tuple(math.radians(degrees) * (k == joint) for k in range(1, 7))


def judged(rows, stated=None):
    model = original_model()
    return judge_session(model, ModelPosterior.from_model(model), rows, stated)


@pytest.mark.parametrize("joint", [1, 2, 3, 4, 5])
def test_the_joint_that_moved_is_named_from_five_poses(joint):
    degrees = 0.05 if joint < 4 else 0.5  # nearer to the reflector
    session, zeros = judged(rows_after_change(5, 20 + joint, moved_joint(joint, degrees)))
    assert session.verdict == "moved"
    assert [one.what for one in session.movements] == [f"joint {joint}"]
    low, high = session.movements[0].interval
    assert low < degrees < high
    assert session.movements[0].probability > 0.9
    assert session.unchanged_probability < 0.01
    assert abs(float(zeros.shift[joint - 1]) - math.radians(degrees)) < 4 * float(zeros.sigma[joint - 1])


def test_false_alarms_are_rare():
    sessions = [judged(rows_after_change(5, 100 + seed))[0] for seed in range(10)]
    assert [one.verdict for one in sessions] == ["unchanged"] * 10
    assert not any(one.recalibrate for one in sessions)


def test_a_recalibration_is_recommended_after_a_collision():
    session, _ = judged(rows_after_change(10, 3, moved_joint(3, 0.25)))
    assert session.recalibrate
    assert session.rms_after_recalibration < 0.2 * session.rms
    assert_close(session.expected_gain, session.rms - session.rms_after_recalibration, rtol=1e-12)
    assert not judged(rows_after_change(10, 3))[0].recalibrate


@pytest.mark.parametrize("joint", [0, 3])
def test_a_wrong_row_is_not_mistaken_for_a_movement(joint):
    rows = rows_after_change(10, 3, moved_joint(joint, 0.25))
    wrong = rows.position.clone()
    wrong[4, 1] += 0.005
    session, _ = judged(replace(rows, position=wrong))
    assert session.outliers == (rows.place(4),)
    assert [one.what for one in session.movements] == (["joint 3"] if joint else [])
    assert_close(session.rms, judged(rows.select(torch.tensor([0, 1, 2, 3, 5, 6, 7, 8, 9])))[0].rms, rtol=0.1)


def test_a_wrong_reading_of_a_repeated_pose_is_named_and_left_out():
    rows = rows_after_change(10, 3).select(torch.arange(10).repeat_interleave(3))
    noise = 2e-5 * torch.randn(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows = replace(rows, position=rows.position + noise, line=tuple(range(2, 32)))
    wrong = rows.position.clone()
    wrong[4, 1] += 0.005
    session, _ = judged(replace(rows, position=wrong))
    assert session.outliers == (rows.place(4),)
    assert_close(session.rms, judged(rows)[0].rms, rtol=0.1)


def test_two_joints_that_moved_are_both_named():
    both = tuple(a + b for a, b in zip(moved_joint(2, 0.2), moved_joint(5, -0.3), strict=True))
    session, _ = judged(rows_after_change(12, 4, both))
    assert {one.what for one in session.movements} == {"joint 2", "joint 5"}


@pytest.mark.parametrize("joint", [0, 3])
def test_a_moved_instrument_is_distinguished_from_a_joint(joint):
    session, _ = judged(rows_after_change(12, 5, moved_joint(joint, 0.1), ELSEWHERE))
    expected = ["joint 3"] if joint else []
    assert [one.what for one in session.movements] == [*expected, "base", "base"]
    assert session.recalibrate == bool(joint)
    assert "base" in session.relocated_frames
    assert not session.zero_is_observable[0]
    assert "joint 1" in session.unobservable_sentences[0]
    assert "base" in session.unobservable_sentences[0]


def test_a_small_motion_of_the_base_is_not_mistaken_for_a_joint():
    session, _ = judged(rows_after_change(10, 6, base=(3e-4, -2e-4, 4e-4, 0.0, 0.0, 0.0)))
    assert {one.what for one in session.movements} == {"base"}
    assert not session.recalibrate


def test_moved_frames_can_be_stated():
    session, _ = judged(rows_after_change(12, 5), frozenset({("base", "")}))
    assert session.relocated_frames == ("base",)
    assert all(one.what == "base" for one in session.movements)


def test_scores_are_as_large_as_expected_where_nothing_changes():
    zeros = [judged(rows_after_change(10, 200 + seed))[1] for seed in range(12)]
    scores = torch.stack(
        [
            one.shift
            / (one.model_sensitivity @ one.model_sensitivity.mT + one.session_covariance).diagonal().sqrt()
            for one in zeros
        ]
    )
    assert 0.4 < float(scores[:, :5].square().mean().sqrt()) < 1.6


def test_only_the_part_of_a_tool_that_moved_is_named():
    session, _ = judged(rows_after_change(10, 3))
    origin = Movement("tool", 30.0, 0.01, "mm", 0.999)
    still = Movement("tool", 0.0, 0.0001, "deg", 0.999)
    both = replace(session, movements=(origin, still))
    assert both.sentence == replace(session, movements=(origin,)).sentence
    assert replace(session, movements=(still,)).sentence != both.sentence
