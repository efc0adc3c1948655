"""Whether new measurements are explained better by the corrected model than by the nominal robot."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from pisigma.errors import MeasurementError
from pisigma.judging.bootstrap import Bootstrap
from pisigma.judging.model_comparison import compare_models
from pisigma.judging.moved_frames import FITTED
from pisigma.judging.reference_models import geometric_model, nominal_model
from pisigma.measurement.csv.rows import LIMIT_TOLERANCE
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.comparison_report import report_comparison
from pisigma.verification.setup_faults import PLAUSIBLE_SHARE, SetupFault, find_mix_ups, length_text

FEWEST_CONFIGURATIONS = 6
"""With fewer different joint values nothing is concluded."""
MOST_DRAWN = 2 * 10**7
"""Numbers drawn for confidence intervals at most; of many rows fewer resamples are enough."""
RESAMPLES = (200, 2000)

NOMINAL, GEOMETRIC, CORRECTED = "nominal", "geometric", "corrected"

HALVED = 0.5
"""Where a setup fault is found, errors must at least be halved for the corrected model to count as better."""

Verdict = Literal["better", "not_better", "undecided", "mixed_up"]


@dataclass(frozen=True, eq=False)
class Verification:
    """What new measurements say about a model.

    Attributes:
        verdict: "better" where the corrected model explains them better than the nominal robot, which the confidence
            interval of the mean difference has to show; "undecided" where it shows nothing; "mixed_up" where a
            setup fault explains the errors, or where they are too large for a calibration, so that neither counts.
        sentence: the verdict with figures.
        ratio: mean position error of the corrected model over that of the nominal robot.
        better_share: share of the configurations in which the corrected model is nearer.
        comparison: figures of "nominal", "geometric" (of a hybrid) and "corrected"; see
            `pisigma.reporting.comparison_report.report_comparison`.
        setup_faults: what explains large errors.
        remarks: what else should be known, each a sentence.
    """

    verdict: Verdict
    sentence: str
    ratio: float
    better_share: float
    comparison: Mapping[str, Any]
    setup_faults: tuple[SetupFault, ...]
    remarks: tuple[str, ...]


def read_for_verification(path: str | os.PathLike[str], model: CalibratedModel) -> Measurements:
    """Read measurements whose joint values may lie outside the limits, as those of mixed-up columns do.

    Rows of the set "train" are left out where the file has a column "set".

    Raises:
        MeasurementError: the file cannot be used, or its column `set` leaves no row for tests.
    """
    rows = tuple(replace(row, lower=-np.inf, upper=np.inf) for row in model.robot.rows)
    measurements = Measurements.read_csv(path, replace(model.robot, rows=rows))
    if measurements.split is None:
        return measurements
    test = torch.tensor([name == "test" for name in measurements.split])
    if not test.any():
        raise MeasurementError(
            f"{measurements.source}: column 'set' marks all rows as 'train'; mark some as 'test' or remove the column."
        )
    return measurements.select(test)


def verify(
    model: CalibratedModel, measurements: Measurements, seed: int = 0, fit_frame: bool = False
) -> Verification:
    """Judge whether a correction is active and right.

    Args:
        model: the model.
        measurements: new rows with positions, in frames and of targets that the model knows.
        seed: of the resamples for confidence intervals.
        fit_frame: fit the frames anew, as after the sensor was moved; then any frame will do.

    Raises:
        MeasurementError: no positions were measured, or in a frame or of a target that the model does not know.
        ModelError: the model does not keep enough joint values to fit base and tool of the nominal robot.
        PoseError: the joint values do not fit the robot.
    """
    turned = measurements.rotation is not None
    models = {NOMINAL: nominal_model(model, turned)}
    if model.hybrid is not None:
        models[GEOMETRIC] = geometric_model(model)
    models[CORRECTED] = model
    resamples = int(np.clip(MOST_DRAWN // max(measurements.rows, 1), *RESAMPLES))
    with torch.no_grad():
        compared = compare_models(models, measurements, Bootstrap(resamples, seed), fit_frame)
        report = report_comparison(compared)
        if fit_frame:
            measurements = replace(measurements, frame=(next(iter(model.bases), ""),) * measurements.rows)
        setup_faults = find_mix_ups(model, models[NOMINAL], measurements)
        setup_faults = tuple(found for found in setup_faults if not (fit_frame and found.kinds == ("frame",)))
    nominal, corrected = report["models"][0], report["models"][-1]
    paired = corrected["difference_to_first"]["position"]
    ratio = corrected["mean_mm"] / nominal["mean_mm"] if nominal["mean_mm"] > 0 else float("nan")
    smaller = min(nominal["rms_mm"], corrected["rms_mm"]) * 1e-3
    too_large = smaller > PLAUSIBLE_SHARE * model.robot.reach > 0
    verdict = _verdict(paired, report["configurations"])
    if too_large or (setup_faults and verdict != "not_better" and not ratio <= HALVED):
        verdict = "mixed_up"
    return Verification(
        verdict=verdict,
        sentence=_sentence(verdict, report, ratio, setup_faults),
        ratio=ratio,
        better_share=paired["better_share"],
        comparison=report,
        setup_faults=setup_faults,
        remarks=(*_remarks(model, measurements, report, setup_faults), *([FITTED] if fit_frame else [])),
    )


def _verdict(paired: Mapping[str, Any], configurations: int) -> Verdict:
    if configurations < FEWEST_CONFIGURATIONS or paired["mean_mm_interval"] is None:
        return "undecided"
    low, high = paired["mean_mm_interval"]
    if high < 0:
        return "better"
    return "not_better" if low > 0 or low == high == 0 else "undecided"


def _sentence(
    verdict: Verdict, report: Mapping[str, Any], ratio: float, setup_faults: tuple[SetupFault, ...]
) -> str:
    nominal, corrected = report["models"][0], report["models"][-1]
    paired, count = corrected["difference_to_first"]["position"], report["configurations"]
    begin = {
        "better": "The corrected model explains these measurements better than the nominal robot",
        "not_better": "The nominal robot explains these measurements at least as well as the corrected model",
        "undecided": "These measurements do not tell whether the corrected model or the nominal robot is nearer",
        "mixed_up": "These measurements do not show whether the correction is right, as "
        + ("something was mixed up" if setup_faults else "their errors are no calibration errors"),
    }[verdict]
    means = [length_text(model["mean_mm"] / 1e3) for model in (corrected, nominal)]
    figures = f"the mean error is {means[0]} instead of {means[1]}"
    if np.isfinite(ratio):
        figures += f" (ratio {ratio:.3g})"
    if verdict == "mixed_up":
        known = next(
            (setup_fault for setup_fault in setup_faults if np.isfinite(setup_fault.after_nominal)), None
        )
        if known is not None:
            set_right = [length_text(length) for length in (known.after, known.after_nominal)]
            figures += f"; set right, the errors are {set_right[0]} RMS instead of {set_right[1]}"
        return f"{begin}: {figures}."
    if count < FEWEST_CONFIGURATIONS:
        return f"{begin}: {figures}, but {FEWEST_CONFIGURATIONS} or more different joint values are needed."
    low, high = paired["mean_mm_interval"]
    return (
        f"{begin}: {figures}, it differs by {low:.3g} to {high:.3g} mm with "
        f"{report['bootstrap']['confidence']:.0%} confidence, and it is smaller in {paired['better_share']:.0%} of "
        f"{count} configurations."
    )


def _remarks(
    model: CalibratedModel,
    measurements: Measurements,
    report: Mapping[str, Any],
    setup_faults: tuple[SetupFault, ...],
) -> list[str]:
    remarks = []
    lower, upper = torch.from_numpy(model.robot.limits).unbind(1)
    q = measurements.q
    outside = ((q < lower - LIMIT_TOLERANCE) | (q > upper + LIMIT_TOLERANCE)).any(1)
    if bool(outside.any()):
        first = int(outside.nonzero()[0, 0])
        remarks.append(
            f"{int(outside.sum())} of {measurements.rows} rows, the first in {measurements.place(first)}, have joint "
            f"values outside the limits of robot '{model.robot.name}'."
        )
    if model.provenance.data_sha256 == measurements.content_hash():
        remarks.append("The model was fitted to these rows: the figures say nothing about other poses.")
    if report["models"][-1]["rows_not_predicted"]:
        count = report["models"][-1]["rows_not_predicted"]
        remarks.append(
            f"{count} rows lie so far outside the domain that nothing is predicted; they do not count."
        )
    limit = PLAUSIBLE_SHARE * model.robot.reach
    if not setup_faults and report["models"][-1]["rms_mm"] * 1e-3 > limit:
        remarks.append(
            f"Errors of more than {limit * 1e3:.3g} mm are no calibration errors, but no usual setup fault (frame, "
            "tool, units, order, signs and zeros of the joints, correction applied twice or not at all) explains them; "
            "check whether this robot was measured, and whether the rows belong together."
        )
    return remarks
