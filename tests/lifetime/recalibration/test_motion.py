"""Movements found by `verify`, with the command that recalibrates."""

import math
import re

import pytest
from testing.aged import original_model, rows_after_change
from testing.models import hand_made_model

from pisigma.lifetime.recalibration.motion import find_motion
from pisigma.workflow.settings.verification import VerificationSettings
from pisigma.workflow.verify import verify

pytestmark = pytest.mark.usefixtures("without_type_checker")
ELSEWHERE = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)
COLLISION = (0.0, 0.0, math.radians(0.25), 0.0, 0.0, 0.0)


def test_a_moved_joint_is_named_with_the_command_to_run():
    verification = verify(original_model(), rows_after_change(10, 3, COLLISION))
    assert verification.verdict == "moved"
    assert not verification.accepted
    assert verification.sentence.startswith("Joint 3 has moved by 0.2")
    assert "± 0.0" in verification.sentence
    assert verification.setup_faults == ()
    printed = verification.to_json()
    assert [one["what"] for one in printed["moved"]] == ["joint 3"]
    assert printed["recalibrate"].startswith("pisigma recalibrate rb5 ")
    assert printed["recalibrate"].endswith(" --out DIR")


@pytest.mark.parametrize("collision", [False, True])
def test_six_rows_in_another_frame_are_enough(collision):
    """The base is fitted, so that it is not said to have moved."""
    rows = rows_after_change(6, 11, COLLISION if collision else (0.0,) * 6, ELSEWHERE)
    verification = verify(original_model(), rows, VerificationSettings(fit_frame=True))
    assert verification.verdict == ("moved" if collision else "better")
    assert [one.what for one in verification.movements.movements] == ["joint 3"] * collision
    assert ("--moved base" in verification.recalibration_command) == collision
    # fitted parameters, degrees of freedom, values, fitted parameters
    assert re.findall(r"\d+", verification.warnings[-1]) == ["6", "12", "18", "6"]


def test_a_small_motion_of_the_base_is_a_warning():
    verification = verify(original_model(), rows_after_change(10, 6, base=(2e-4, -1e-4, 2e-4, 0.0, 0.0, 0.0)))
    assert verification.verdict == "better"
    assert {one.what for one in verification.movements.movements} == {"base"}


def test_a_model_without_a_posterior_gives_no_session():
    assert find_motion(hand_made_model("kiro3"), rows_after_change(6, 1)) is None
