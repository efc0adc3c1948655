"""Candidate models of a recalibration, compared by cross-validation."""

import math
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, get_args

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress
from pisigma.lifetime.recalibration.adaptation import Adaptation, adapt
from pisigma.lifetime.recalibration.recalibration_problem import FrameKey, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import k_folds
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.validation.held_out.calibration_validation import ErrorPredictor, pose_errors_of
from pisigma.validation.held_out.trained_calibrations import Calibrator, fit, judgeable_rows

Kept = Literal["recalibrated", "old", "scratch"]
NAMES: dict[Kept, str] = {
    "recalibrated": "The recalibrated model",
    "old": "The old model with the frames of the new rows",
    "scratch": "A calibration from scratch",
}
_OF_FLEET: dict[Kept, str] = NAMES | {
    "recalibrated": "The calibration that starts from the fleet prior",
    "old": "The mean robot of the fleet with base and tool of the new rows",
}
"""Names of the candidates if the model is a fleet prior."""
_FOLDS = 5
MIN_RATIO = 1.05
"""Ratio of RMS errors below which another candidate does not replace the recalibrated model."""
CLEAR_RATIO = 2.0
"""Ratio of RMS errors above which a candidate is better, for any distribution of the errors."""
_OUTLIER_FACTOR = 5.0
"""Ratio to the median error above which rows that every candidate predicts poorly are ignored."""


@dataclass(frozen=True)
class CandidateChoice:
    """Cross-validated errors of the candidates, and the chosen candidate.

    Attributes:
        kept: "recalibrated", unless another candidate is better by more than 5 %, and significantly.
        rms: RMS error of held-out rows under each candidate [m]; None if there are too few rows for the candidate.
        rows: number of held-out rows that were used.
        p95: 95 % quantile of the same errors [m].
        names: names of the candidates, as at the start of a sentence.
    """

    kept: Kept
    rms: Mapping[Kept, float | None]
    rows: int
    p95: Mapping[Kept, float | None] = field(default_factory=dict)
    names: Mapping[Kept, str] = field(default_factory=lambda: NAMES)

    @property
    def updates(self) -> bool:
        """Whether the recalibrated model predicts held-out rows better than the old model by more than 5 %."""
        old, new = self.rms["old"], self.rms["recalibrated"]
        return old is not None and new is not None and self.kept != "old" and old > MIN_RATIO * new

    @property
    def smallest_error_choice(self) -> "CandidateChoice":
        """The choice of the candidate with the smallest error, however small the difference."""
        sizes = {name: size for name, size in self.rms.items() if size is not None}
        return replace(self, kept=min(sizes, key=lambda name: sizes[name])) if sizes else self

    @property
    def sentence(self) -> str:
        """Return a sentence about the chosen candidate, with the errors of all candidates."""
        if not self.rows:
            return f"{self.names[self.kept]} is kept: there are too few rows for a cross-validation."
        sizes = {name: size * 1e3 for name, size in self.rms.items() if size is not None}
        if self.kept not in sizes:
            return f"{self.names[self.kept]} is kept: there are too few rows to cross-validate it."
        others = " and ".join(
            f"{size:.3g} mm under {self.names[name][:1].lower()}{self.names[name][1:]}"
            for name, size in sizes.items()
            if name != self.kept
        )
        return (
            f"{self.names[self.kept]} is kept: the RMS error of {self.rows} rows held out in cross-validation is "
            f"{sizes[self.kept]:.3g} mm{f', compared with {others}' if others else ''}."
        )


def choose_candidate(
    model: CalibratedModel,
    adaptation: Adaptation,
    relocated: Set[FrameKey],
    rows: Measurements,
    calibrator: Calibrator,
    progress: Progress,
) -> CandidateChoice:
    """Predict every fold of the rows with every candidate made without this fold, and choose the one to keep.

    Args:
        model: the model that is recalibrated.
        adaptation: adaptation of the model to all rows.
        relocated: bases and tools that were moved since the model was made.
        rows: new rows, frames and targets by the names of the model.
        calibrator: calibrator for the calibration from scratch.
        progress: callback that is called with the fold that is being predicted.
    """
    posterior, noise = adaptation.problem.posterior, adaptation.drift.noise
    folds = min(_FOLDS, int(groups_to_keep_whole(rows).max()) + 1)
    names = get_args(Kept)
    errors: dict[Kept, Tensor] = {name: torch.full((rows.rows,), torch.nan).double() for name in names}
    for number, (train, test) in enumerate(k_folds(rows, folds, 0) if folds > 1 else (), 1):
        progress(f"fold {number} of {folds}")
        training = rows.select(train)
        test = test[_predictable(rows, test, training)]
        problem = recalibration_problem(model, posterior, training, relocated)
        candidates: dict[Kept, Callable[[], ErrorPredictor]] = {
            "recalibrated": partial(adapt, problem, noise, adaptation.drift),
            "old": partial(adapt, problem.with_fixed_arm(), noise),
            "scratch": partial(fit, calibrator, training, lambda what: None),
        }
        for name, candidate in candidates.items():
            try:
                errors[name][test] = pose_errors_of(candidate(), rows.select(test)).position
            except IdentificationError:  # too few rows to identify it
                errors[name][test] = torch.inf
    return replace(_decided(errors), names=_OF_FLEET if model.kind == FLEET_PRIOR else NAMES)


def _decided(errors: Mapping[Kept, Float64[Tensor, " rows"]]) -> CandidateChoice:
    """Return the chosen candidate, given the errors of held-out rows [m]."""
    smallest = torch.stack(list(errors.values())).amin(0)
    judged = torch.isfinite(smallest)
    counted = (
        judged & (smallest <= _OUTLIER_FACTOR * smallest[judged].median()) if bool(judged.any()) else judged
    )
    rms, p95 = dict[Kept, float | None](), dict[Kept, float | None]()
    for name, lengths in errors.items():
        known = bool(counted.any()) and bool(torch.isfinite(lengths[counted]).all())
        rms[name] = float(lengths[counted].square().mean().sqrt()) if known else None
        p95[name] = float(lengths[counted].quantile(0.95)) if known else None
    first = errors["recalibrated"][counted]
    better = [
        (size, name)
        for name, size in rms.items()
        if size is not None and _clearly_better(errors[name][counted], first)
    ]
    return CandidateChoice(min(better)[1] if better else "recalibrated", rms, int(counted.sum()), p95)


def _clearly_better(errors: Float64[Tensor, " rows"], than: Float64[Tensor, " rows"]) -> bool:
    """Return whether the RMS of errors is smaller by more than 5 %, and by a factor of 2 or significantly.

    The tests are paired t-tests at the level of 0.5 % each, because the recalibrated model also knows the arm at poses
    without rows. They compare squares, and logarithms, because a few large squares can hide what most rows show. Errors
    of metres have tails so heavy that neither test is significant, hence the factor of 2.
    """
    count = len(errors)
    if not bool(torch.isfinite(than).all()):
        return True
    if count < 2 or MIN_RATIO**2 * float(errors.square().sum()) >= float(than.square().sum()):
        return False
    if CLEAR_RATIO**2 * float(errors.square().sum()) <= float(than.square().sum()):
        return True
    quantile = 2.58 + 7 / (
        count - 1
    )  # quantile of Student's t distribution, to 6 % from four degrees of freedom
    gains = than.square() - errors.square(), (than / errors).clamp(1e-9, 1e9).log()
    return any(float(gain.mean()) > quantile * float(gain.std()) / math.sqrt(count) for gain in gains)


def _predictable(rows: Measurements, test: Tensor, training: Measurements) -> Tensor:
    """Return the mask of test rows whose frame, target and anchor also occur in training rows."""
    frames = set(training.frame)
    framed = torch.tensor([rows.frame[row] in frames for row in test.tolist()])
    try:
        return framed & judgeable_rows(rows, test, training)
    except IdentificationError:
        return torch.zeros_like(framed)
