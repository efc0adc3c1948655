"""The result of `pisigma.load` is accepted wherever a model or its folder is."""

import pytest
from testing.models import hand_made_model
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.model.folder.model_folder import model_or_folder
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.planning.subject import RobotOrModel
from pisigma.workflow.evaluate import models_by_label


@pytest.mark.usefixtures("without_type_checker")
def test_the_model_of_a_corrected_ik_is_taken():
    model = hand_made_model("kiro3")
    ik = CorrectedIK(model)
    assert model_or_folder(ik) is model
    assert model_or_folder(model) is model
    assert model_or_folder("models/kiro3") == "models/kiro3"
    assert list(models_by_label(["nominal", ik]).values()) == ["nominal", model]
    with refused(PlanningError, value=model.name):
        RobotOrModel.load(ik)
