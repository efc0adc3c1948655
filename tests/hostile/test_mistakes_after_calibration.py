"""`verify` and `evaluate` check orientations like positions: a mistake in them is named, and not accepted."""

import re
from dataclasses import replace

import pytest
import torch
from hostile.mistakes import POSES, SETS, clean_rows
from testing.models import no_type_checker

from pisigma.workflow import calibrate
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.verify import verify

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module")
def poses(shared_data):
    """A UR10, rows to calibrate with, and others."""
    robot, file, _, _ = SETS[1]
    nominal, clean = clean_rows(shared_data, robot, file, 12)
    even = torch.arange(clean.rows) % 2 == 0
    return nominal, clean.select(even), clean.select(~even)


def calibrated(nominal, rows):
    return calibrate.calibrate(nominal, rows, CalibrationSettings(model="geometric", folds=0)).model


@pytest.fixture(scope="module")
def model(poses):
    """The model of the poses to calibrate with."""
    with no_type_checker():
        return calibrated(*poses[:2])


@pytest.mark.parametrize("name", ["sign of q6", "quaternion wxyz"])
def test_orientations_are_checked(poses, model, name):
    nominal, _, rows = poses
    mistake = next(one for one in POSES if one.name == name)
    wrong = mistake.change(rows, nominal)
    verification, evaluation = verify(model, wrong), evaluate(model, wrong)
    assert verification.verdict == "setup_fault"
    assert re.search(mistake.words, verification.sentence, re.IGNORECASE), verification.sentence
    assert not evaluation.accepted
    assert re.search(mistake.words, evaluation.diagnostics[0].sentence, re.IGNORECASE)


def test_orientations_that_the_model_does_not_determine_are_not_checked(poses, model):
    """A model calibrated with positions does not determine its tool's orientation."""
    nominal, training, rows = poses
    for one in (model, calibrated(nominal, replace(training, rotation=None))):
        assert verify(one, rows).verdict == "better"
        assert evaluate(one, rows).accepted
