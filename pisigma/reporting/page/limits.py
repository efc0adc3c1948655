"""What limits the accuracy: scatter that no model can predict, or what the model lacks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.accuracy import Accuracy
from pisigma.reporting.page.judged_rows import JudgedRows
from pisigma.reporting.tables import figure_text

MOSTLY = 0.8
"""From such a share of the squared error on, scatter is what limits."""
LEAST_REPEATS = 10
"""Degrees of freedom from which repeated rows tell the scatter."""


@dataclass(frozen=True)
class Limit:
    """What limits the accuracy.

    Attributes:
        noise: RMS length of the scatter of a measured position [mm]; None where it is not known.
        share: of the squared error that it makes up, at most 1; None likewise.
        source: where the figure of the noise is from.
        clause: to go on "what limits it is ...".
        sentence: the same with figures.
    """

    noise: float | None
    share: float | None
    source: str
    clause: str
    sentence: str


def limit_of(model: CalibratedModel, accuracy: Accuracy | None, rows: JudgedRows | None) -> Limit:
    """Compare the error with the scatter of repeated rows, or with the noise that a hybrid found.

    Args:
        model: the model.
        accuracy: its errors, or None.
        rows: judged rows, or None.
    """
    if accuracy is not None and accuracy.reference:
        sentence = (
            " ".join(model.metrics.get("limitations", ())) or "Ask the full model for its own accuracy."
        )
        return Limit(None, None, "", "the full model that it stands for", sentence)
    noise, source = _repeated(rows), "rows that were measured more than once"
    if noise is None:
        noise, source = _found(model), "the noise that the calibration found"
    if noise is None or accuracy is None or accuracy.quantity[0] != "mm" or not accuracy.last["rms_mm"] > 0:
        return _unknown(model)
    share = min((noise / accuracy.last["rms_mm"]) ** 2, 1.0)
    told = (
        f"By {source}, a measured position scatters by {figure_text(noise)} mm RMS, which is {100 * share:.0f} % of "
        f"the squared error"
    )
    if share >= MOSTLY:
        gain = 100 * (1 - math.sqrt(share))
        clause = f"scatter of the measurements ({100 * share:.0f} % of the squared error)"
        sentence = f"{told}: a perfect model would have {gain:.0f} % less error on the same rows, no more."
        return Limit(
            noise,
            share,
            source,
            clause,
            sentence.replace("0 % less error", "hardly less error") if gain < 0.5 else sentence,
        )
    clause = (
        f"the model more than the measurements, whose scatter is {100 * share:.0f} % of the squared error"
    )
    sentence = (
        f"{told}; the other {100 * (1 - share):.0f} % are errors of the model: too few rows, or effects that it cannot "
        "express."
    )
    return Limit(noise, share, source, clause, sentence)


def _unknown(model: CalibratedModel) -> Limit:
    rest = next((n["sigma_mm"] for n in model.metrics.get("noise", ()) if "sigma_mm" in n), None)
    clause = "measurement scatter or effects that the model lacks: these rows cannot tell which"
    if rest is None:
        sentence = (
            "How much the measurements scatter by themselves is not known; measure some poses several times."
        )
        return Limit(None, None, "", clause, sentence)
    sentence = (
        f"What the geometry leaves over, {figure_text(rest)} mm per coordinate, is scatter of the measurements and "
        "everything that geometry cannot express; measure some poses several times, or calibrate a hybrid, to tell "
        "them apart."
    )
    return Limit(None, None, "", clause, sentence)


def _repeated(rows: JudgedRows | None) -> float | None:
    """RMS length of the scatter of positions at equal joint values [mm], pooled; None with too few of them."""
    if rows is None:
        return None
    known = torch.isfinite(rows.residual).all(-1)
    if int(known.sum()) <= LEAST_REPEATS:
        return None
    measurements = rows.measurements.select(known)
    group = groups_of_equal_joints(measurements.q)
    names = list(zip(group.tolist(), measurements.frame, measurements.target, strict=True))
    order = {name: number for number, name in enumerate(dict.fromkeys(names))}
    number = torch.tensor([order[name] for name in names])
    values = rows.residual[known]
    counts = torch.bincount(number).double()
    freedom = float((counts - 1).sum())
    if freedom < LEAST_REPEATS:
        return None
    means = torch.zeros(len(order), 3, dtype=torch.float64).index_add_(0, number, values) / counts[:, None]
    return math.sqrt(float((values - means[number]).square().sum()) / freedom) * 1e3


def _found(model: CalibratedModel) -> float | None:
    """RMS length of the noise of a position that a hybrid found [mm]; of geometry alone it is no noise."""
    hybrid = model.metrics.get("hybrid")
    learned = hybrid.get("learned") if isinstance(hybrid, Mapping) else None
    if not learned:
        return None
    found = [noise for noise in learned["noise"] if noise["sensor"] in ("position", "socket")]
    return math.sqrt(3) * found[0]["sigma_mm"] if found and "sigma_mm" in found[0] else None
