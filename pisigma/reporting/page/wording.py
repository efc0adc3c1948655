"""Findings of a report as titles and sentences; the wording of sentences is in the template `report.txt.j2`."""

import functools

from pisigma.reporting.calibration_tables import cross_validation_text
from pisigma.reporting.rendering import sentences
from pisigma.reporting.result_text import Table
from pisigma.validation.report.accuracy import Accuracy, RowOrigin
from pisigma.validation.report.arm_in_images import ArmInImages
from pisigma.validation.report.corrections import CorrectionCurve
from pisigma.validation.report.dependence import Dependence, ErrorsByName
from pisigma.validation.report.error_map import ErrorMap, Layer, Quantity

MODEL_LABELS = {
    "nominal": "nominal",
    "geometric": "geometric",
    "hybrid": "hybrid",
    "corrected": "with the network",
    "full": "full solution",
    "distilled": "distilled",
}
"""Column headings by the name of the model."""
TITLES: dict[RowOrigin, str] = {
    "file": "rows of the file",
    "training": "rows of the calibration",
    "test": "test set",
    "cross_validation": "held-out rows",
    "simulation": "held-out rows",
    "poses": "held-out poses",
}
"""Titles of the tables of errors by the origin of the rows."""
LAYER_LABELS: dict[Quantity, str] = {
    "before": "before (nominal)",
    "after": "after calibration",
    "predicted": "predicted accuracy",
    "before_deg": "orientation, before",
    "after_deg": "orientation, after",
    "correction": "correction",
    "distance": "distance",
    "turn": "rotation",
}
"""Labels of the values that an error map shows, by layer."""

say = functools.partial(sentences, "report.txt.j2")
"""Fill in a macro of `report.txt.j2`; see `sentences`."""


def rows_text(accuracy: Accuracy) -> str:
    """Return a text on the rows to which the errors belong and the models that predicted them."""
    figures = accuracy.validation
    folds = cross_validation_text(figures) if figures is not None and (figures.folds or 1) > 1 else ""
    return say("judged_rows", accuracy, folds)[0]


def dependence_text(dependence: Dependence) -> str:
    """Return whether errors depend on a quantity."""
    return " ".join(say("dependence", dependence, dependence.test))


def names_text(errors: ErrorsByName) -> str:
    """Return whether errors differ between frames or targets."""
    return say("by_name", errors)[0]


def map_text(error_map: ErrorMap) -> str:
    """Return a text on the points that an error map shows."""
    return say("map", error_map)[0]


def layer_text(layer: Layer, error_map: ErrorMap) -> str:
    """Return a text on the values of a layer of an error map."""
    return say("layer", layer.key, error_map.origin)[0]


def curve_text(curve: CorrectionCurve) -> str:
    """Return a text on the size of the correction of a joint and its measured range."""
    return say("curve", curve)[0]


def zeros_table(arm: ArmInImages) -> Table:
    """Return a table of the zeros of the joints."""
    rows = [
        (one.joint, "", "", "not found: base and tool have the same effect")
        if one.standard_error is None
        else (one.joint, f"{one.error:+.2f}", f"{one.standard_error:.2f}", "found")
        for one in arm.zeros
    ]
    return Table(("joint", "error of the zero [deg]", "std. error [deg]", "remark"), tuple(rows))


def arm_sentence(arm: ArmInImages) -> str:
    """Return a sentence on the errors of both arms in the images."""
    before, after = arm.nominal_rms * 1e3, arm.calibrated_rms * 1e3
    times = f"{before / after:.1f} times smaller: it is halved {arm.halvings:.1f} times"
    change = times if after < before else "not smaller"
    return (
        f"In {len(arm.images)} images, the board is {before:.3g} mm RMS from where the nominal arm says (base and tool "
        f"fitted), and {after:.3g} mm from where the calibrated arm says; the error is {change}."
    )
