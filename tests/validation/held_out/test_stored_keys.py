"""Keys of stored figures, which stay when fields are renamed."""

import pytest

from pisigma.files.yaml_file import StoredFigures
from pisigma.validation.held_out.arms_summary import SharedFigures
from pisigma.validation.held_out.calibration_summary import NoiseFigures, ParameterFigures, ScaleFigures
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.validation_figures import ValidationFigures
from pisigma.workflow.arms.find_moved_arms import MovedFigures

SIX = (0.1,) * 6
VALUES = {"nominal": 0.0, "estimated": 1.0, "change": 1.0, "standard_error": 0.1}
MOTION = {"shift_mm": SIX[:3], "rotation_deg": SIX[:3], "standard_errors": SIX, "log_likelihood": 1.0}


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (Diagnostic, {"kind": "search", "severity": "warning", "sentence": "", "rows": ("a.csv, line 2",)}),
        (NoiseFigures, {"sensor": "position", "values": 9}),
        (ParameterFigures, {"name": "d_1", "unit": "mm", "remark": "", "label": "prior", **VALUES}),
        (ScaleFigures, {"factor": 1.0, "sigma": 0.1, "odds": 2.0, "rms_mm": 0.3}),
        (SharedFigures, {"kind": "frame", "name": "hall", "arms": ("a", "b"), "distance_mm": 0.1}),
        (ValidationFigures, {"rows": 3, "frames_fitted": 2}),
        (MovedFigures, {"kind": "arm", "name": "a", "is_named": True, "distance_error_mm": 0.2, **MOTION}),
    ],
)
def test_figures_are_read_and_written_by_their_keys(
    kind: type[StoredFigures], values: dict[str, object]
) -> None:
    read = kind.model_validate(values)
    assert read.model_dump(exclude_unset=True, by_alias=True) == values
    assert not kind.model_fields.keys() >= values.keys()
