"""Files of geometry state that the joint correction of a hybrid model is not in them."""

from testing.hybrid import hybrid_of

from pisigma.deployment.export.geometry import geometry_remarks, offset_remarks
from pisigma.model.geometric_model import model_of_hybrid


def test_files_state_that_the_learned_correction_is_missing():
    arm = hybrid_of(name="rb5")
    model = model_of_hybrid("hybrid", arm.true.nominal, arm.result, arm.measurements)
    assert model.hybrid is not None
    for said in (geometry_remarks(model), offset_remarks(model)):
        assert any("joint correction" in sentence for sentence in said)
