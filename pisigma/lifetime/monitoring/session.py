"""Compare a session of measurements with a model: what moved, if anything, and whether to recalibrate."""

import math
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.calibration.hybrid.refinement import linearise_rows
from pisigma.estimation.alternatives import Explanation, GroupMotion, SessionEvidence
from pisigma.estimation.drift import Drift, DriftGroup, LinearValues, PosteriorUpdate
from pisigma.estimation.wrong_rows import ExplainedRows, mark_wrong_rows
from pisigma.files.errors import IdentificationError
from pisigma.lifetime.recalibration.adaptation import AdaptedArm, linear_values, noise_of_calibration
from pisigma.lifetime.recalibration.movement import (
    HistoryMovement,
    Movement,
    is_frame,
    movements_of_group,
)
from pisigma.lifetime.recalibration.recalibration_problem import (
    FrameKey,
    RecalibrationProblem,
    known_frames,
    movement_hypotheses,
    recalibration_problem,
)
from pisigma.lifetime.recalibration.relocated_frames import MIN_MOVE
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior
from pisigma.validation.held_out.calibration_validation import pose_errors_of

Verdict = Literal["unchanged", "moved", "unclear"]
ZERO_PRIOR = 0.02
"""Prior standard deviation [rad, or share of the reach] of joint zeros that are estimated for charts, about 1 deg."""
_UNOBSERVABLE = 0.005
"""Posterior standard deviation [rad, or share of the reach] above which a joint zero is unobservable, about 0.3 deg."""
_MIN_GAIN_RATIO = 1.05
"""Expected ratio of errors before and after a recalibration above which a recalibration is recommended."""
_MAX_NOISE_FACTOR = 2.0
"""Factor on the noise of the calibration up to which an explanation is complete."""
_MIN_NAMED_PROBABILITY = 0.05
"""Probability above which an ambiguous explanation is named."""
_MAX_LINEARISATIONS = 4
_CONVERGENCE_TOLERANCE = 1.0
"""RMS change of predicted values, relative to their noise, below which linearisation ends."""


@dataclass(frozen=True, eq=False)
class JointZeros:
    """Shifts of all joint zeros in a session, estimated together, for charts over many sessions.

    Attributes:
        shift: changes of theta or d of the joints [rad or m], without the directions of the joints.
        sigma: standard deviations, including the uncertainty of the model and the prior of about 1 deg [rad or m].
        model_sensitivity: derivatives of the shifts with respect to the directions of the model's uncertainty, which
            all sessions share.
        session_covariance: covariance due to the noise and the moved bases and tools of this session.
    """

    shift: Float64[Tensor, " dof"]
    sigma: Float64[Tensor, " dof"]
    model_sensitivity: Float64[Tensor, "dof directions"]
    session_covariance: Float64[Tensor, "dof dof"]


@dataclass(frozen=True)
class SessionResult:
    """Result of comparing a session with a model.

    Attributes:
        rows: number of rows.
        unchanged_probability: probability that no part moved.
        movements: movements; movements of the arm come first.
        candidates: names and probabilities of possible movements if these are ambiguous; otherwise empty.
        rms: RMS position error under the model, with the current base and tool [m].
        rms_after_recalibration: RMS position error expected after a recalibration [m].
        rotation_ratio: ratio of orientation errors to the errors expected after a recalibration; 1 if none was
            measured.
        error_score: RMS of the errors divided by their standard deviations; about 1 if nothing changed.
        values: number of measured values.
        relocated_frames: names of bases and tools that have been moved since the model was made.
        zero_is_observable: whether the rows determine the zero of each joint.
        outliers: file and line of rows that are not used because they contradict the other rows under any movement.
        score_ratio: for images, whose poses have more noise than error, RMS ratio of values to their standard
            deviations, divided by that expected after a recalibration; otherwise 1.
    """

    rows: int
    unchanged_probability: Annotated[float, Field(alias="unchanged")]  # histories store the keys
    movements: Annotated[tuple[HistoryMovement, ...], Field(alias="moved")]
    candidates: tuple[tuple[str, float], ...]
    rms: float
    rms_after_recalibration: Annotated[float, Field(alias="rms_after")]
    rotation_ratio: float
    error_score: float
    values: int
    relocated_frames: Annotated[tuple[str, ...], Field(alias="standing")]
    zero_is_observable: Annotated[tuple[bool, ...], Field(alias="observable")]
    outliers: tuple[str, ...] = ()
    score_ratio: float = 1.0

    @property
    def verdict(self) -> Verdict:
        """Verdict: nothing moved ("unchanged"), something moved ("moved"), or the movement is ambiguous ("unclear")."""
        if self.movements:
            return "moved"
        return "unclear" if self.candidates else "unchanged"

    @property
    def recalibrate(self) -> bool:
        """Whether the arm has changed so much that a recalibration is recommended."""
        arm = any(not is_frame(one.what) for one in self.movements) or bool(self.candidates)
        return arm and (
            self.rms > _MIN_GAIN_RATIO * self.rms_after_recalibration
            or max(self.rotation_ratio, self.score_ratio) > _MIN_GAIN_RATIO
        )

    @property
    def sentence(self) -> str:
        """Clause that states the verdict, with a full stop."""
        if self.verdict == "unclear":
            named = (
                f"{what} ({format_probability(share)})"
                for what, share in self.candidates[:3]
                if share >= _MIN_NAMED_PROBABILITY
            )
            return f"something changed, but these rows cannot distinguish what: {' or '.join(named)}."
        if self.verdict == "unchanged":
            return "nothing moved beyond its uncertainty."
        # for a base or a tool, omit the rotation if only the origin moved, and the other way round
        clear = [
            one for one in self.movements if one.is_significant or not is_frame(one.what)
        ] or self.movements
        moved = (f"{one.sentence} ({format_probability(one.probability)})" for one in clear)
        return f"{'; '.join(moved)}."

    @property
    def unobservable_sentences(self) -> tuple[str, ...]:
        """Sentences about the joints whose zeros the rows do not determine, and why."""
        last, sentences = len(self.zero_is_observable), []
        for number, observable in enumerate(self.zero_is_observable, 1):
            frame = {1: "base", last: "tool"}.get(number, "")
            if not observable and frame and any(name.split()[0] == frame for name in self.relocated_frames):
                sentences.append(
                    f"The zero of joint {number} cannot be distinguished from the {frame}, which has been moved "
                    "since the model was made."
                )
            elif not observable:
                sentences.append(f"Joint {number} is unobservable: these rows do not determine its zero.")
        return tuple(sentences)

    @property
    def expected_gain(self) -> float:
        """Expected decrease of the RMS error of such rows due to a recalibration [m]."""
        return max(self.rms - self.rms_after_recalibration, 0.0)


def judge_session(
    model: CalibratedModel,
    posterior: ModelPosterior,
    rows: Measurements,
    relocated: Set[FrameKey] | None = None,
) -> tuple[SessionResult, JointZeros]:
    """Compare, by their evidence, all movements that may have happened since a model was made.

    Args:
        model: the model.
        posterior: posterior of the model.
        rows: rows of one session, frames and targets by the names of the model.
        relocated: bases and tools that have been moved since the model was made; None to find them by evidence.

    Returns:
        The result of the session, and the zeros of all joints for charts.

    Raises:
        IdentificationError: there are no usable rows, or too few to guess a moved base or tool.
        PoseError: the joint values do not fit the robot.
    """
    solved = _solve(model, posterior, rows, relocated or frozenset())
    probabilities = dict.fromkeys(relocated or (), 1.0)
    if relocated is None and solved.frame_moved:
        solved, probabilities = _with_relocated(model, posterior, rows, solved)
    return _judged(solved, probabilities), _zeros(solved)


def _with_relocated(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, still: "_Solved"
) -> tuple["_Solved", dict[FrameKey, float]]:
    """Find which bases and tools were moved: the base, the tool, or both if neither alone explains the rows."""
    bases, tools = known_frames(posterior, rows)
    tried: dict[frozenset[FrameKey], _Solved] = {frozenset(): still}
    for owners in (bases, tools, bases | tools):
        if not owners or (owners == bases | tools and any(one.has_usual_noise for one in tried.values())):
            continue
        with suppress(IdentificationError):  # too few rows to determine these
            tried[owners] = _solve(model, posterior, rows, owners)
    log = torch.tensor([one.explanation.log_evidence for one in tried.values()])
    share = dict(zip(tried, log.softmax(0).tolist(), strict=True))
    best = max(tried, key=lambda owners: share[owners])
    return tried[best], {owner: sum(share[those] for those in tried if owner in those) for owner in best}


@dataclass(frozen=True, eq=False)
class _Solved:
    """A session, linearised at the most probable explanation."""

    problem: RecalibrationProblem
    values: LinearValues
    noise: Float64[Tensor, " sensors"]
    evidence: SessionEvidence
    explanation: Explanation

    @property
    def has_usual_noise(self) -> bool:
        """Whether the noise is about that of the calibration."""
        return self.explanation.noise_factor <= _MAX_NOISE_FACTOR

    @property
    def probable_movements(self) -> tuple[GroupMotion, ...]:
        """Movements, or only the most probable one if they are ambiguous."""
        return self.explanation.motions or self.explanation.candidates[:1]

    @property
    def moved_frames(self) -> list[DriftGroup]:
        """Bases and tools that moved, which are free in the charts of joints and errors."""
        return [_freed(one) for one in self.explanation.motions if is_frame(one.group.name)]

    @property
    def frame_moved(self) -> bool:
        """Whether a base or a tool has moved too far for its motion to be linear."""
        return any(is_frame(one.group.name) and one.size >= MIN_MOVE for one in self.probable_movements)

    def arm_with(self, motions: tuple[DriftGroup, ...]) -> AdaptedArm:
        """Return the arm of the model, with moved bases and tools and given movements fitted."""
        return AdaptedArm.from_unknowns(self.problem, self.unknowns(motions))

    def score_ratio(self, before: tuple[DriftGroup, ...], after: tuple[DriftGroup, ...]) -> float:
        """Compute the ratio of the RMS standardised residuals that two sets of movements leave."""
        values, deviation = self.values, self.values.sigma(self.noise)
        left = [values.y - values.X @ (self.unknowns(those) - self.problem.mean) for those in (before, after)]
        first, second = (float((one / deviation).square().mean().sqrt()) for one in left)
        return first / second if second > 0 else 1.0

    def unknowns(self, motions: tuple[DriftGroup, ...]) -> Float64[Tensor, " unknowns"]:
        """Return the mean unknowns with moved bases and tools and some movements; all others are as in the model."""
        standing = tuple(group for group in self.problem.groups if group.fixed_size)
        drift = Drift((*standing, *motions), self.noise * self.explanation.noise_factor)
        shift: Tensor = PosteriorUpdate(self.problem.covariance_root[:, :0], self.values, drift).shift
        return self.problem.mean + shift


def _solve(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, relocated: Set[FrameKey]
) -> _Solved:
    """Linearise and explain repeatedly until the linearisation converges."""
    problem = recalibration_problem(model, posterior, rows, relocated)
    noise = noise_of_calibration(problem)
    group = held_out_groups(problem.setup.measurements)
    x = problem.mean
    wrong: Mapping[int, float] = {}
    for _ in range(_MAX_LINEARISATIONS):
        values = linear_values(problem, linearise_rows(problem.design, x, 0.0, group))
        solved = _explained(problem, noise, replace(values, wrong_configurations=wrong))
        values, wrong = solved.values, solved.values.wrong_configurations
        there = solved.unknowns(tuple(_sized(one) for one in solved.probable_movements))
        step = values.X @ (there - x) / values.sigma(noise)
        x = there
        if float(step.square().mean().sqrt()) < _CONVERGENCE_TOLERANCE or (
            solved.frame_moved and not relocated
        ):
            break
    return solved


def _explained(
    problem: RecalibrationProblem, noise: Float64[Tensor, " sensors"], values: LinearValues
) -> _Solved:
    """Find the most probable explanation of the values of a session, including wrong rows."""
    standing = [one for one in problem.groups if one.fixed_size]
    every = SessionEvidence(values, problem.covariance_root, standing, movement_hypotheses(problem), noise)

    def explain(wrong: Mapping[int, float]) -> ExplainedRows[_Solved]:
        evidence = every.with_wrong_configurations(wrong)
        there, explanation = evidence.values, evidence.compare_hypotheses()
        solved = _Solved(problem, there, noise, evidence, explanation)
        factor = explanation.noise_factor
        V = evidence.covariance([_sized(one) for one in solved.probable_movements], factor)
        return ExplainedRows(solved, there, explanation.log_evidence, V, factor * there.sigma(noise))

    return mark_wrong_rows(explain(values.wrong_configurations), explain).explanation


def _sized(motion: GroupMotion) -> DriftGroup:
    return replace(motion.group, drift_size=motion.size)


def _freed(motion: GroupMotion) -> DriftGroup:
    """Return the group of a movement, with a prior of at least `ZERO_PRIOR`."""
    return replace(motion.group, drift_size=max(motion.size, ZERO_PRIOR))


def _judged(solved: _Solved, relocated: dict[FrameKey, float]) -> SessionResult:
    """Compute the result of a session."""
    every, wrong = solved.problem.setup.measurements, solved.problem.wrong_rows(solved.values)
    rows = every.select((~wrong).nonzero()[:, 0])
    explanation, evidence = solved.explanation, solved.evidence
    motions = tuple(_sized(one) for one in solved.probable_movements)
    of_arm = tuple(group for group in motions if not is_frame(group.name))
    frames = tuple(group for group in motions if is_frame(group.name))
    before = solved.arm_with(frames)
    (rms, angle), (rms_after, angle_after) = (_rms(arm, rows) for arm in (before, solved.arm_with(motions)))
    count = len(solved.values.y)
    determined = sum(len(group.index) for group in of_arm if group.is_one_motion)
    optimism = math.sqrt(
        count / max(count - determined, 1)
    )  # residuals are too small, because the rows determined the movement
    return SessionResult(
        rows=every.rows,
        unchanged_probability=explanation.unchanged_probability,
        movements=_moved(solved, relocated),
        candidates=tuple((one.group.name, one.probability) for one in explanation.candidates),
        rms=rms,
        rms_after_recalibration=rms_after * optimism,
        rotation_ratio=1.0 if angle_after == 0 else angle / (angle_after * optimism),
        score_ratio=solved.score_ratio(frames, motions) / optimism if "corner" in every.kinds else 1.0,
        error_score=evidence.with_moved_groups(solved.moved_frames).error_score(),
        values=len(solved.values.y),
        relocated_frames=tuple(" ".join(owner).strip() for owner in relocated),
        zero_is_observable=tuple(
            float(evidence.estimate_shift([group], explanation.noise_factor)[1].sqrt())
            < _UNOBSERVABLE * float(group.sigma_at_unit_size)
            for group in _joints(solved)
        ),
        outliers=tuple(every.place(row) for row in wrong.nonzero()[:, 0].tolist()),
    )


def _moved(solved: _Solved, relocated: dict[FrameKey, float]) -> tuple[Movement, ...]:
    """Estimate all movements together; movements of the arm come first."""
    problem, explanation = solved.problem, solved.explanation
    found = [(_freed(one), one.probability) for one in explanation.motions]
    for (kind, name), probability in relocated.items():
        whats = (kind, f"{kind} {name}")
        found += [(one, probability) for one in problem.groups if one.fixed_size and one.name in whats]
    if not found:
        return ()
    shift, covariance = solved.evidence.estimate_shift(
        [group for group, _ in found], explanation.noise_factor
    )
    geometry = solved.arm_with(tuple(_sized(one) for one in explanation.motions)).geometry
    moved: list[Movement] = []
    first = 0
    for group, probability in found:
        members = slice(first, first + len(group.index))
        first = members.stop
        parts = movements_of_group(problem, geometry, group, shift[members], covariance[members, members])
        moved += [replace(part, probability=probability) for part in parts]
    return tuple(sorted(moved, key=lambda one: is_frame(one.what)))


def _zeros(solved: _Solved) -> JointZeros:
    """Estimate the zeros of all joints together."""
    noise_factor = solved.explanation.noise_factor
    evidence = solved.evidence.with_moved_groups(solved.moved_frames)
    shift, covariance = evidence.estimate_shift(_joints(solved), noise_factor)
    sensitivity, session_covariance = evidence.sensitivity_and_covariance(_joints(solved), noise_factor)
    return JointZeros(shift, covariance.diagonal().sqrt(), sensitivity, session_covariance)


def _joints(solved: _Solved) -> list[DriftGroup]:
    """Return the groups of all joint zeros, with their prior set to `ZERO_PRIOR`."""
    groups = solved.problem.groups
    return [replace(group, drift_size=ZERO_PRIOR) for group in groups if group.name.startswith("joint ")]


def format_probability(probability: float | None) -> str:
    """Return a probability as a percentage that is never rounded to 100 %; "unknown" for None."""
    if probability is None:
        return "unknown"
    return "more than 99.9 %" if probability > 0.999 else f"{100 * probability:.1f} %"


def _rms(arm: AdaptedArm, rows: Measurements) -> tuple[float, float]:
    """Compute the RMS errors of lengths [m] and of angles [rad]; 0 if none was measured."""
    errors = pose_errors_of(arm, rows)
    return _root_mean_square(errors.position), _root_mean_square(errors.rotation)


def _root_mean_square(sizes: Tensor | None) -> float:
    measured = torch.zeros(0) if sizes is None else sizes[torch.isfinite(sizes)]
    return float(measured.square().mean().sqrt()) if len(measured) else 0.0
