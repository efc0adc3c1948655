"""`verify` and `evaluate` judge orientations as they judge positions: a mistake in them is named, and not accepted."""

import re
from dataclasses import replace

import pytest
import torch
from hostile.mistakes import POSES, SETS, clean_rows

from pisigma.workflow import calibrate
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.verify import verify

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module")
def poses(shared_data):
    """A UR10, rows to calibrate with, and others."""
    robot, file, _, _ = SETS[1]
    nominal, clean = clean_rows(shared_data, robot, file, 6)
    even = torch.arange(clean.rows) % 2 == 0
    return nominal, clean.select(even), clean.select(~even)


def calibrated(nominal, rows):
    return calibrate.calibrate(nominal, rows, CalibrationSettings(model="geometric", folds=0)).model


@pytest.mark.parametrize("name", ["sign of q6", "quaternion wxyz"])
def test_orientations_are_judged(poses, name):
    nominal, training, rows = poses
    model = calibrated(nominal, training)
    mistake = next(one for one in POSES if one.name == name)
    wrong = mistake.change(rows, nominal)
    verification, evaluation = verify(model, wrong), evaluate(model, wrong)
    assert verification.verdict == "setup_fault"
    assert re.search(mistake.words, verification.sentence, re.IGNORECASE), verification.sentence
    assert not evaluation.accepted
    assert re.search(mistake.words, evaluation.diagnostics[0].sentence, re.IGNORECASE)


def test_orientations_that_no_model_knows_are_not_judged(poses):
    """A model of positions does not say how its tool is turned, so that poses show nothing of it."""
    nominal, training, rows = poses
    for measured in (training, replace(training, rotation=None)):
        model = calibrated(nominal, measured)
        assert verify(model, rows).verdict == "better"
        assert evaluate(model, rows).accepted
