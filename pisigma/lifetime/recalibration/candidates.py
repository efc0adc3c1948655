"""Candidate models of a recalibration, compared by cross-validation, and the model that the chosen one gives."""

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress
from pisigma.lifetime.recalibration.adaptation import Adaptation, adapt
from pisigma.lifetime.recalibration.motion import excessive_change_diagnostics
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.lifetime.recalibration.recalibration_problem import FrameKey, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import k_folds
from pisigma.model.calibrated_model import CalibratedModel, Frames, Provenance
from pisigma.model.geometric_model import branches_of
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.model.stored_starts import evenly_spaced_rows
from pisigma.model.training_rows import stored_training_rows
from pisigma.robot.robot_class import plausible_error_per_reach
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.validation.checks.mixed_rows import MIN_WRONG_SHARE, too_many_wrong_rows_diagnostic
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.calibration_validation import ErrorPredictor, pose_errors_of
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.pose_statistics import image_position_rms
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
        held_out_row_count: number of held-out rows that were used.
        p95: 95 % quantile of the same errors [m].
        names: names of the candidates, as at the start of a sentence.
    """

    kept: Kept
    rms: Mapping[Kept, float | None]
    held_out_row_count: int
    p95: Mapping[Kept, float | None] = field(default_factory=dict)
    names: Mapping[Kept, str] = field(default_factory=lambda: NAMES)

    @property
    def updates_model(self) -> bool:
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
        if not self.held_out_row_count:
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
            f"{self.names[self.kept]} is kept: the RMS error of {self.held_out_row_count} rows held out in "
            f"cross-validation is {sizes[self.kept]:.3g} mm{f', compared with {others}' if others else ''}."
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
        relocated: bases and tools that have been moved since the model was made.
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


KIND = "recalibration"
_SUSPICIOUS_FACTOR = 5.0
"""Ratio of the errors of held-out rows to the scatter of positions in the calibration that is suspicious."""


def recalibrated_model(model: CalibratedModel, adaptation: Adaptation, rows: Measurements) -> CalibratedModel:
    """Return the recalibrated model, which also stores a posterior.

    The geometric calibration that a hybrid stores in addition to the hybrid's geometry is updated as well: its
    parameters change by the same amounts, and its bases and tools move as those of the hybrid do.

    Args:
        model: parent model.
        adaptation: adaptation of the parent to the rows.
        rows: new rows.
    """
    known, nominal = model.uncertainty, model.nominal
    assert known is not None
    assert nominal is not None
    solved = adaptation.arm.geometry
    geometry = IdentifiedGeometry(solved.robot, solved.bases, solved.tools, solved.unknowns)
    calibrated, bases, tools = geometry.robot, geometry.bases, geometry.tools
    starts = evenly_spaced_rows(torch.unique(torch.cat([model.starts.double(), rows.q.cpu()]), dim=0))
    hybrid = None
    if model.hybrid is not None and adaptation.arm.correction is not None:
        assert model.calibrated is not None
        coverage = model.hybrid.coverage.with_rows(rows.q)
        hybrid = HybridArm(geometry.robot, adaptation.arm.correction, coverage)
        bases = _taken_along(model.bases, model.hybrid_bases, geometry.bases, before=True)
        tools = _taken_along(model.tools, model.hybrid_tools, geometry.tools, before=False)
        dh = model.calibrated.dh + geometry.robot.dh - model.hybrid.robot.dh
        calibrated = nominal.with_geometry(
            dh=dh, base=next(iter(bases.values())), tool=next(iter(tools.values()))
        )
    robot = nominal.with_geometry(base=calibrated.base, tool=calibrated.tool)
    root = CovarianceRoot(adaptation.covariance_root)
    space = adaptation.problem.design.problem.space
    noise = known.noise.updated(adaptation.noise)
    uncertainty = PositionUncertainty(space, geometry, known.features, root, known.variance_factor, noise)
    return replace(
        model,
        kind=KIND,
        robot=robot,
        branches=branches_of(robot, starts),
        starts=starts,
        calibrated=calibrated,
        bases=bases,
        tools=tools,
        hybrid=hybrid,
        hybrid_bases=geometry.bases if hybrid else {},
        hybrid_tools=geometry.tools if hybrid else {},
        uncertainty=uncertainty.with_rounded_root(rows),
        training_values=stored_training_rows(nominal, rows, model.training_values),
        provenance=Provenance(
            data_source=rows.file_names,
            data_sha256=rows.content_hash(),
            rows=rows.rows,
            rows_left_out=len(rows.left_out),
            versions=Provenance.installed_versions(),
        ),
    )


def _taken_along(frames: Frames, from_: Frames, onto: Frames, before: bool) -> Frames:
    """Move frames as the reference frames of the same names; frames without counterpart are copied from the reference.

    Args:
        frames: frames to move.
        from_: reference frames before the motion.
        onto: reference frames after the motion.
        before: whether the motion multiplies from the left, as for a base, or from the right.
    """
    T = {name: _transforms(those) for name, those in (("own", frames), ("from", from_), ("onto", onto))}
    moved: Frames = {}
    for name, there in T["onto"].items():
        if name not in T["own"]:
            moved[name] = onto[name]
            continue
        own, was = T["own"][name], T["from"][name]
        taken = there @ invert(was) @ own if before else own @ invert(was) @ there
        moved[name] = xyz_zyx_from_transform(taken).numpy()
    return moved


def _transforms(frames: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {
        name: transform_from_xyz_zyx(torch.from_numpy(np.asarray(frame))) for name, frame in frames.items()
    }


def recalibration_diagnostics(
    parent: CalibratedModel,
    choice: CandidateChoice,
    rows: Measurements,
    adaptation: Adaptation,
    wrong_rows: Sequence[int],
    movements: Sequence[Movement],
) -> tuple[Diagnostic, ...]:
    """Return findings that state why the result is implausible although the checks of the rows found nothing.

    Args:
        parent: model that was recalibrated.
        choice: errors of held-out rows.
        rows: all rows.
        adaptation: adaptation of the model to the rows that were not left out.
        wrong_rows: indices of the rows that were left out.
        movements: movements that were found.
    """
    if len(wrong_rows) > MIN_WRONG_SHARE * rows.rows:
        chosen = torch.zeros(rows.rows, dtype=torch.bool)
        chosen[list(wrong_rows)] = True
        return (too_many_wrong_rows_diagnostic(rows, chosen),)
    if choice.kept == "scratch" and (
        implausible := check_rows(rows, parent.nominal or parent.robot).implausible_findings
    ):
        return implausible
    return (
        *_large_errors(parent, choice, adaptation),
        *excessive_change_diagnostics(parent.robot, movements),
    )


def _large_errors(
    parent: CalibratedModel, judged: CandidateChoice, adaptation: Adaptation
) -> tuple[Diagnostic, ...]:
    """Return a finding if no candidate predicts the held-out rows."""
    error, share = judged.rms[judged.kept], plausible_error_per_reach(parent.robot)
    if error is None:
        return ()
    noise = (
        math.nan if parent.uncertainty is None else parent.uncertainty.noise.standard_deviation("position")
    )
    setup = adaptation.problem.setup
    rows = setup.weighted_rows(setup.measurements, adaptation.arm.geometry)
    usual = max(math.sqrt(3) * (0.0 if math.isnan(noise) else noise), image_position_rms(rows))
    missed = f"{rows.source}: the RMS error of held-out rows is {error * 1e3:.3g} mm"
    if error > share * parent.robot.reach:
        sentence = (
            f"{missed}, more than {100 * share:.0f} % of the reach of robot '{parent.robot.name}': another "
            "robot was measured, or columns or units are wrong; run `pisigma verify` on these rows."
        )
    elif error > _SUSPICIOUS_FACTOR * usual > 0 and parent.kind != FLEET_PRIOR:
        sentence = (
            f"{missed}, while single positions scattered by {usual * 1e3:.2g} mm when the model was made: rows may be "
            "wrong or from another robot, or more has changed than these few rows can determine. Check the rows with "
            "`pisigma verify`, or measure more of them."
        )
    else:
        return ()
    return (Diagnostic(kind="residual", severity="implausible", sentence=sentence),)
