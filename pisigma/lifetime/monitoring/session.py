"""One session of measurements against a model: unchanged, or what moved, and whether recalibrating pays."""

import math
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.refinement import linearised
from pisigma.estimation.drift import Drift, DriftGroup, LinearValues
from pisigma.estimation.hypotheses import Explanation, Motion, SessionEvidence
from pisigma.estimation.posterior_update import PosteriorUpdate
from pisigma.estimation.wrong_rows import Explained, with_wrong_rows
from pisigma.files.errors import IdentificationError
from pisigma.lifetime.recalibration.adaptation import AdaptedArm, linear_values, noise_of_sensors
from pisigma.lifetime.recalibration.movement import HistoryMovement, Movement, movements_of_group
from pisigma.lifetime.recalibration.recalibration_problem import (
    FrameKey,
    RecalibrationProblem,
    hypotheses,
    recalibration_problem,
)
from pisigma.lifetime.recalibration.relocated_frames import FAR
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior
from pisigma.validation.held_out.calibration_validation import errors_under

Verdict = Literal["unchanged", "moved", "unclear"]
ANYWHERE = 0.02
"""[rad, or of the reach] Prior standard deviation of a joint's zero that is estimated for the chart: about 1 deg."""
UNOBSERVABLE = 0.005
"""[rad, or of the reach] A zero that is known no better after a session is called unobservable: about 0.3 deg."""
PAYS = 1.05
"""Recalibrating pays where it is expected to make errors smaller by this factor or more."""
USUAL = 2.0
"""Factor on the noise of the calibration up to which an explanation is complete."""
LEAST_NAMED = 0.05
"""Probability from which on an unclear explanation is mentioned."""
MOST_ROUNDS = 4
SETTLED = 1.0
"""Rounds end when predicted values move by less than this share of the noise."""


@dataclass(frozen=True, eq=False)
class JointZeros:
    """Shifts of all joints' zeros in a session, each estimated beside all others, for charts over many sessions.

    Attributes:
        shift: [rad or m].
        deviation: standard deviations, with the uncertainty of the model and the prior of about 1 deg.
        influence: derivatives of the shifts by the directions of the model's uncertainty, which all sessions share.
        own: covariance of what else makes the shifts err: the noise of this session, and what stands elsewhere in it.
    """

    shift: Float64[Tensor, " dof"]
    deviation: Float64[Tensor, " dof"]
    influence: Float64[Tensor, "dof directions"]
    own: Float64[Tensor, "dof dof"]


@dataclass(frozen=True)
class Session:
    """What a session says of a robot.

    Attributes:
        rows: number of rows.
        unchanged: probability that nothing moved.
        moved: what moved, the arm first.
        candidates: names and probabilities of what may have moved where that is unclear, else none.
        rms: root mean square of the errors under the model, with frames as they stand now [m].
        rms_after: the same expected after recalibrating [m].
        rotation_ratio: errors of the orientation by those expected after recalibrating; 1 where none was measured.
        error_score: root mean square of the errors over their standard deviations; 1 is usual.
        values: number of measured values.
        standing: names of bases and tools that stand elsewhere than when the model was made.
        observable: per joint, whether the rows say anything of its zero.
        outliers: places of rows that do not count, because they do not go with the others whatever has moved.
        score_ratio: with images, whose poses have more noise than error, values over their standard deviations by those
            expected after recalibrating; else 1.
    """

    rows: int
    unchanged: float
    moved: tuple[HistoryMovement, ...]
    candidates: tuple[tuple[str, float], ...]
    rms: float
    rms_after: float
    rotation_ratio: float
    error_score: float
    values: int
    standing: tuple[str, ...]
    observable: tuple[bool, ...]
    outliers: tuple[str, ...] = ()
    score_ratio: float = 1.0

    @property
    def verdict(self) -> Verdict:
        """Whether nothing moved, something did, or something did and it is not clear what."""
        if self.moved:
            return "moved"
        return "unclear" if self.candidates else "unchanged"

    @property
    def recalibrate(self) -> bool:
        """Whether the arm changed so much that recalibrating pays."""
        arm = any(not is_frame(one.what) for one in self.moved) or bool(self.candidates)
        return arm and (self.rms > PAYS * self.rms_after or max(self.rotation_ratio, self.score_ratio) > PAYS)

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.verdict == "unclear":
            named = (f"{what} ({share:.0%})" for what, share in self.candidates[:3] if share >= LEAST_NAMED)
            return f"something changed, and these rows do not show what: {' or '.join(named)}."
        if self.verdict == "unchanged":
            return "nothing moved beyond its uncertainty."
        moved = (f"{one.sentence} ({shown_probability(one.probability)})" for one in self.moved)
        return f"{'; '.join(moved)}."

    @property
    def unobservable(self) -> tuple[str, ...]:
        """Sentences on the joints whose zeros these rows cannot determine, and why."""
        last, sentences = len(self.observable), []
        for number, observable in enumerate(self.observable, 1):
            frame = {1: "base", last: "tool"}.get(number, "")
            if not observable and frame and any(name.split()[0] == frame for name in self.standing):
                sentences.append(
                    f"Joint {number} cannot be told from the {frame}, which stands elsewhere than when the model was "
                    "made."
                )
            elif not observable:
                sentences.append(f"Joint {number} is unobservable: these rows do not determine its zero.")
        return tuple(sentences)

    @property
    def gain(self) -> float:
        """By how much recalibrating is expected to make the errors of such rows smaller [m]."""
        return max(self.rms - self.rms_after, 0.0)


def judge_session(
    model: CalibratedModel,
    posterior: ModelPosterior,
    rows: Measurements,
    stated: Set[FrameKey] | None = None,
) -> tuple[Session, JointZeros]:
    """Compare everything that can have moved since a model was made.

    Args:
        model: the model.
        posterior: of it.
        rows: of one session, frames and targets by the names of the model.
        stated: bases and tools that stand elsewhere than when the model was made; None to find them by evidence.

    Raises:
        IdentificationError: nothing usable was measured, or too little to guess where something stands.
        PoseError: the joint values do not fit the robot.
    """
    solved = _solve(model, posterior, rows, stated or frozenset())
    probabilities = dict.fromkeys(stated or (), 1.0)
    if stated is None and solved.frame_moved:
        solved, probabilities = _elsewhere(model, posterior, rows, solved)
    return _judged(solved, probabilities), _zeros(solved)


def _elsewhere(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, still: "_Solved"
) -> tuple["_Solved", dict[FrameKey, float]]:
    """Find which bases and tools stand elsewhere: the base, the tool, or both where neither explains the rows."""
    geometry = posterior.geometry
    bases = frozenset(("base", name) for name in rows.frame if name in geometry.bases)
    tools = frozenset(("tool", name) for name in rows.target if name in geometry.tools)
    tried: dict[frozenset[FrameKey], _Solved] = {frozenset(): still}
    for owners in (bases, tools, bases | tools):
        if not owners or (owners == bases | tools and any(one.fits for one in tried.values())):
            continue
        with suppress(IdentificationError):  # so few rows cannot say where these stand
            tried[owners] = _solve(model, posterior, rows, owners)
    log = torch.tensor([one.explanation.log_evidence for one in tried.values()])
    share = dict(zip(tried, log.softmax(0).tolist(), strict=True))
    best = max(tried, key=lambda owners: share[owners])
    return tried[best], {owner: sum(share[those] for those in tried if owner in those) for owner in best}


@dataclass(frozen=True, eq=False)
class _Solved:
    """A session, linearised where the most probable explanation puts it."""

    problem: RecalibrationProblem
    values: LinearValues
    noise: Float64[Tensor, " sensors"]
    evidence: SessionEvidence
    explanation: Explanation

    @property
    def fits(self) -> bool:
        """Whether the rows err about as much as they usually do."""
        return self.explanation.noise_factor <= USUAL

    @property
    def suspected(self) -> tuple[Motion, ...]:
        """What moved, or the likeliest where that is unclear."""
        return self.explanation.motions or self.explanation.candidates[:1]

    @property
    def moved_frames(self) -> list[DriftGroup]:
        """Bases and tools that moved, beside which joints and errors are charted: the arm is as it was."""
        return [_freed(one) for one in self.explanation.motions if is_frame(one.group.what)]

    @property
    def frame_moved(self) -> bool:
        """Whether a base or a tool seems to stand so far off that its motion is not linear."""
        return any(is_frame(one.group.what) and one.size >= FAR for one in self.suspected)

    def arm_with(self, motions: tuple[DriftGroup, ...]) -> AdaptedArm:
        """The arm with what stands elsewhere, and some motions, as these rows have it; all else as in the model."""
        return AdaptedArm.at(self.problem, self.unknowns(motions))

    def score_ratio(self, before: tuple[DriftGroup, ...], after: tuple[DriftGroup, ...]) -> float:
        """Divide the values that some motions leave, over their standard deviations, by those that others leave."""
        values, deviation = self.values, self.values.deviation(self.noise)
        left = [values.y - values.X @ (self.unknowns(those) - self.problem.mean) for those in (before, after)]
        first, second = (float((one / deviation).square().mean().sqrt()) for one in left)
        return first / second if second > 0 else 1.0

    def unknowns(self, motions: tuple[DriftGroup, ...]) -> Float64[Tensor, " unknowns"]:
        """Most probable unknowns with what stands elsewhere and some motions; all else as in the model."""
        standing = tuple(group for group in self.problem.groups if group.fixed_size)
        drift = Drift((*standing, *motions), self.noise * self.explanation.noise_factor)
        shift: Tensor = PosteriorUpdate(self.problem.root[:, :0], self.values, drift).shift
        return self.problem.mean + shift


def _solve(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, elsewhere: Set[FrameKey]
) -> _Solved:
    """Linearise, explain, and go on from there until the linearisation holds."""
    problem = recalibration_problem(model, posterior, rows, elsewhere)
    noise = noise_of_sensors(problem, posterior.noise)
    group = held_out_groups(problem.setup.measurements)
    x = problem.mean
    wrong: Mapping[int, float] = {}
    for _ in range(MOST_ROUNDS):
        values = linear_values(problem, linearised(problem.design, x, 0.0, group))
        solved = _explained(problem, noise, replace(values, wrong=wrong))
        values, wrong = solved.values, solved.values.wrong
        there = solved.unknowns(tuple(_sized(one) for one in solved.suspected))
        step = values.X @ (there - x) / values.deviation(noise)
        x = there
        if float(step.square().mean().sqrt()) < SETTLED or (solved.frame_moved and not elsewhere):
            break
    return solved


def _explained(
    problem: RecalibrationProblem, noise: Float64[Tensor, " sensors"], values: LinearValues
) -> _Solved:
    """The most probable explanation of a session's values, wrong rows among them."""
    standing = [one for one in problem.groups if one.fixed_size]
    every = SessionEvidence(values, problem.root, standing, hypotheses(problem), noise)

    def explain(wrong: Mapping[int, float]) -> Explained[_Solved]:
        evidence = every.with_wrong(wrong)
        there, explanation = evidence.values, evidence.explain()
        solved = _Solved(problem, there, noise, evidence, explanation)
        factor = explanation.noise_factor
        V = evidence.covariance([_sized(one) for one in solved.suspected], factor)
        return Explained(solved, there, explanation.log_evidence, V, factor * there.deviation(noise))

    return with_wrong_rows(explain(values.wrong), explain).what


def _sized(motion: Motion) -> DriftGroup:
    return replace(motion.group, size=motion.size)


def _freed(motion: Motion) -> DriftGroup:
    """Let what moved be anywhere near."""
    return replace(motion.group, size=max(motion.size, ANYWHERE))


def _judged(solved: _Solved, elsewhere: dict[FrameKey, float]) -> Session:
    """Work out what there is to say."""
    every, wrong = solved.problem.setup.measurements, solved.problem.wrong_rows(solved.values)
    rows = every.select((~wrong).nonzero()[:, 0])
    explanation, evidence = solved.explanation, solved.evidence
    motions = tuple(_sized(one) for one in solved.suspected)
    of_arm = tuple(group for group in motions if not is_frame(group.what))
    frames = tuple(group for group in motions if is_frame(group.what))
    before = solved.arm_with(frames)
    (rms, angle), (rms_after, angle_after) = (_rms(arm, rows) for arm in (before, solved.arm_with(motions)))
    count = len(solved.values.y)
    determined = sum(len(group.index) for group in of_arm if group.single)
    optimism = math.sqrt(count / max(count - determined, 1))  # the rows themselves determined what moved
    return Session(
        rows=every.rows,
        unchanged=explanation.unchanged,
        moved=_moved(solved, elsewhere),
        candidates=tuple((one.group.what, one.probability) for one in explanation.candidates),
        rms=rms,
        rms_after=rms_after * optimism,
        rotation_ratio=1.0 if angle_after == 0 else angle / (angle_after * optimism),
        score_ratio=solved.score_ratio(frames, motions) / optimism if "corner" in every.kinds else 1.0,
        error_score=evidence.with_moved(solved.moved_frames).error_score(),
        values=len(solved.values.y),
        standing=tuple(" ".join(owner).strip() for owner in elsewhere),
        observable=tuple(
            float(evidence.shift([group], explanation.noise_factor)[1].sqrt())
            < UNOBSERVABLE * float(group.scale)
            for group in _joints(solved)
        ),
        outliers=tuple(every.place(row) for row in wrong.nonzero()[:, 0].tolist()),
    )


def _moved(solved: _Solved, elsewhere: dict[FrameKey, float]) -> tuple[Movement, ...]:
    """How far everything that moved has, all estimated together; the arm first."""
    problem, explanation = solved.problem, solved.explanation
    found = [(_freed(one), one.probability) for one in explanation.motions]
    for (kind, name), probability in elsewhere.items():
        whats = (kind, f"{kind} {name}")
        found += [(one, probability) for one in problem.groups if one.fixed_size and one.what in whats]
    if not found:
        return ()
    shift, covariance = solved.evidence.shift([group for group, _ in found], explanation.noise_factor)
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
    """Zeros of all joints together."""
    evidence, noise_factor = solved.evidence.with_moved(solved.moved_frames), solved.explanation.noise_factor
    shift, covariance = evidence.shift(_joints(solved), noise_factor)
    influence, own = evidence.influence(_joints(solved), noise_factor)
    return JointZeros(shift, covariance.diagonal().sqrt(), influence, own)


def _joints(solved: _Solved) -> list[DriftGroup]:
    """The zeros of all joints, which may stand anywhere."""
    groups = solved.problem.groups
    return [replace(group, size=ANYWHERE) for group in groups if group.what.startswith("joint ")]


def shown_probability(probability: float | None) -> str:
    """Write a probability as a percentage that is never rounded to 100 %; "unknown" for None."""
    if probability is None:
        return "unknown"
    return "more than 99.9 %" if probability > 0.999 else f"{100 * probability:.1f} %"


def is_frame(what: str) -> bool:
    """Whether what moved is a base or a tool."""
    return what.split()[0] in ("base", "tool")


def _rms(arm: AdaptedArm, rows: Measurements) -> tuple[float, float]:
    """Root mean squares of the errors of lengths [m] and of angles [rad], 0 where none was measured."""
    errors = errors_under(arm, rows)
    return _root_mean_square(errors.position), _root_mean_square(errors.rotation)


def _root_mean_square(sizes: Tensor | None) -> float:
    measured = torch.zeros(0) if sizes is None else sizes[torch.isfinite(sizes)]
    return float(measured.square().mean().sqrt()) if len(measured) else 0.0
