"""Which model predicts left-out rows best: the old one with new frames, the recalibrated one, or one from scratch."""

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
from pisigma.validation.held_out.calibration_validation import PredictsErrors, errors_under
from pisigma.validation.held_out.trained_calibrations import Calibrator, fit, judgeable

Kept = Literal["recalibrated", "old", "scratch"]
NAMES: dict[Kept, str] = {
    "recalibrated": "The recalibrated model",
    "old": "The old model with the frames of the new rows",
    "scratch": "A calibration from scratch",
}
OF_FLEET: dict[Kept, str] = NAMES | {
    "recalibrated": "The calibration that begins with the fleet",
    "old": "The mean robot of the fleet with the base and the tool of the rows",
}
"""The same where the model is the prior of a fleet."""
FOLDS = 5
ABOUT_AS_GOOD = 1.05
"""The recalibrated model is kept where left-out errors of others are smaller by no more than this factor."""
FAR_BETTER = 2.0
"""A candidate whose root mean square is smaller by this factor is better, however its rows are distributed."""
STRAY = 5.0
"""Rows that every candidate misses by so many times the usual error say nothing of the candidates."""


@dataclass(frozen=True)
class CandidateChoice:
    """Errors of left-out rows under every candidate, and the one that is kept.

    Attributes:
        kept: recalibrated, unless another one is better by more than 5 % and more than chance.
        rms: by candidate the root mean square of the errors of left-out rows [m]; None where the rows are too few.
        rows: number of rows that count.
        names: of the candidates, as sentences begin with them.
    """

    kept: Kept
    rms: Mapping[Kept, float | None]
    rows: int
    names: Mapping[Kept, str] = field(default_factory=lambda: NAMES)

    @property
    def with_least_error(self) -> "CandidateChoice":
        """The same where the candidate with the least error is kept, by however little."""
        sizes = {name: size for name, size in self.rms.items() if size is not None}
        return replace(self, kept=min(sizes, key=lambda name: sizes[name])) if sizes else self

    @property
    def sentence(self) -> str:
        """Which candidate won, and by how much."""
        if not self.rows:
            return f"{self.names[self.kept]} is kept: the rows are too few to leave any out."
        sizes = {name: size * 1e3 for name, size in self.rms.items() if size is not None}
        if self.kept not in sizes:
            return f"{self.names[self.kept]} is kept: the rows are too few to predict left-out ones with it."
        others = " and ".join(
            f"{size:.3g} mm under {self.names[name][:1].lower()}{self.names[name][1:]}"
            for name, size in sizes.items()
            if name != self.kept
        )
        return (
            f"{self.names[self.kept]} is kept: the RMS error of {self.rows} left-out rows is "
            f"{sizes[self.kept]:.3g} mm{f', against {others}' if others else ''}."
        )


def choose_candidate(
    model: CalibratedModel,
    whole: Adaptation,
    elsewhere: Set[FrameKey],
    rows: Measurements,
    calibrator: Calibrator,
    progress: Progress,
) -> CandidateChoice:
    """Leave out one fold of the rows after the other and predict it by every candidate.

    Args:
        model: the model.
        whole: adapted to all rows.
        elsewhere: bases and tools that stand elsewhere.
        rows: frames and targets by the names of the model.
        calibrator: from scratch.
        progress: called with the fold that is being judged.
    """
    posterior, noise = whole.problem.posterior, whole.noise
    folds = min(FOLDS, int(groups_to_keep_whole(rows).max()) + 1)
    names = get_args(Kept)
    errors: dict[Kept, Tensor] = {name: torch.full((rows.rows,), torch.nan).double() for name in names}
    for number, (train, test) in enumerate(k_folds(rows, folds, 0) if folds > 1 else (), 1):
        progress(f"fold {number} of {folds}")
        training = rows.select(train)
        test = test[_predictable(rows, test, training)]
        problem = recalibration_problem(model, posterior, training, elsewhere)
        candidates: dict[Kept, Callable[[], PredictsErrors]] = {
            "recalibrated": partial(adapt, problem, noise, whole.drift),
            "old": partial(adapt, problem.without_arm(), noise),
            "scratch": partial(fit, calibrator, training, lambda what: None),
        }
        for name, candidate in candidates.items():
            try:
                errors[name][test] = errors_under(candidate(), rows.select(test)).position
            except IdentificationError:  # so few rows do not determine it
                errors[name][test] = torch.inf
    return replace(_decided(errors), names=OF_FLEET if model.kind == FLEET_PRIOR else NAMES)


def _decided(errors: Mapping[Kept, Float64[Tensor, " rows"]]) -> CandidateChoice:
    """The candidate that is kept."""
    smallest = torch.stack(list(errors.values())).amin(0)
    judged = torch.isfinite(smallest)
    counted = judged & (smallest <= STRAY * smallest[judged].median()) if bool(judged.any()) else judged
    rms: dict[Kept, float | None] = {}
    for name, lengths in errors.items():
        size = float(lengths[counted].square().mean().sqrt()) if bool(counted.any()) else float("inf")
        rms[name] = size if size < float("inf") else None
    first = errors["recalibrated"][counted]
    better = [
        (size, name)
        for name, size in rms.items()
        if size is not None and _clearly_better(errors[name][counted], first)
    ]
    return CandidateChoice(min(better)[1] if better else "recalibrated", rms, int(counted.sum()))


def _clearly_better(errors: Float64[Tensor, " rows"], than: Float64[Tensor, " rows"]) -> bool:
    """Whether the RMS of errors is smaller by more than 5 %, and by far or rows are smaller by more than chance.

    Paired t-tests, 0.5 % each, since the recalibrated model also knows the arm where these rows do not lie: of the
    squares, and of the logarithms where a few large squares hide what most rows say.
    Squares of errors by metres have so heavy tails that neither shows what their size alone does.
    """
    count = len(errors)
    if not bool(torch.isfinite(than).all()):
        return True
    if count < 2 or ABOUT_AS_GOOD**2 * float(errors.square().sum()) >= float(than.square().sum()):
        return False
    if FAR_BETTER**2 * float(errors.square().sum()) <= float(than.square().sum()):
        return True
    quantile = 2.58 + 7 / (count - 1)  # of Student's distribution, to 6 % from four degrees of freedom on
    gains = than.square() - errors.square(), (than / errors).clamp(1e-9, 1e9).log()
    return any(float(gain.mean()) > quantile * float(gain.std()) / math.sqrt(count) for gain in gains)


def _predictable(rows: Measurements, test: Tensor, training: Measurements) -> Tensor:
    """Which test rows have a frame, a target and an anchor that the training rows have too."""
    frames = set(training.frame)
    framed = torch.tensor([rows.frame[row] in frames for row in test.tolist()])
    try:
        return framed & judgeable(rows, test, training)
    except IdentificationError:
        return torch.zeros_like(framed)
