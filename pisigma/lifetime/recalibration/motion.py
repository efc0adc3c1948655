"""Movements since a model was made, for models that store a posterior, and reasons not to trust the movements."""

import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import replace

import torch

from pisigma.files.errors import IdentificationError, ModelError
from pisigma.lifetime.monitoring.session import SessionResult, format_probability, judge_session
from pisigma.lifetime.recalibration.movement import Movement, is_frame
from pisigma.lifetime.recalibration.recalibration_problem import frame_keys
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import ChangeLimits, RobotClass, plausible_error_per_reach
from pisigma.validation.checks.mixed_rows import MIN_WRONG_SHARE, too_many_wrong_rows_diagnostic
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind
from pisigma.validation.held_out.model_comparison import ModelComparison
from pisigma.validation.setup_faults.cause import join_words, length_text
from pisigma.validation.setup_faults.nominal_robot_faults import evenly_spaced_rows, rows_with_position
from pisigma.validation.setup_faults.setup_faults import without_unknown_orientation

_MAX_ROWS = 60
"""Largest number of rows that are used, because the covariance of all their values is needed."""


def find_motion(
    model: CalibratedModel, rows: Measurements, fitted_kinds: Collection[FrameKind] = ()
) -> SessionResult | None:
    """Find the joints, lengths, base or tool that have moved since a model was made; see `judge_session`.

    Args:
        model: the model.
        rows: rows; the model has their frames and targets, or these are fitted.
        fitted_kinds: bases or tools that are known to have moved.

    Returns:
        The session without movements of fitted frames; None if the model stores no posterior, or if the rows do not
        determine the fitted frames or are implausible, see `session_diagnostics`.
    """
    with suppress(IdentificationError, ModelError):
        posterior = ModelPosterior.from_model(model)
        some = without_unknown_orientation(model, rows)
        if rows.position is not None:
            some = replace(
                some.select(evenly_spaced_rows(rows_with_position(rows), _MAX_ROWS)), pair=None, distance=None
            )
        some = posterior.with_model_names(some)
        with torch.no_grad():
            session, _ = judge_session(
                model, posterior, some, frame_keys(some, fitted_kinds) if fitted_kinds else None
            )
        moved = tuple(one for one in session.movements if one.what.split()[0] not in fitted_kinds)
        if not session_diagnostics(model, some, session):
            return replace(session, movements=moved)
    return None


def session_diagnostics(
    model: CalibratedModel, rows: Measurements, session: SessionResult
) -> tuple[Diagnostic, ...]:
    """Return findings that state why a session is implausible although the checks of its rows found nothing.

    Args:
        model: model with which the session was compared.
        rows: rows of the session.
        session: result of the comparison.
    """
    if len(session.outliers) > MIN_WRONG_SHARE * rows.rows:
        wrong = [rows.place(row) in session.outliers for row in range(rows.rows)]
        return (too_many_wrong_rows_diagnostic(rows, torch.tensor(wrong)),)
    limit = plausible_error_per_reach(model.robot) * model.robot.reach
    if session.rms_after_recalibration > limit:
        sentence = (
            f"{rows.source}: the RMS error is {session.rms * 1e3:.4g} mm, and no movement reduces it to less than "
            f"{limit * 1e3:.3g} mm: a robot other than that of model '{model.name}' was measured, or a column or unit "
            "is wrong; run `pisigma verify` on these rows."
        )
        return (Diagnostic(kind="implausible_errors", severity="implausible", sentence=sentence),)
    return excessive_change_diagnostics(model.robot, session.movements)


def motion_sentence(motion: SessionResult, comparison: ModelComparison) -> str:
    """Return a sentence about movements of the arm, their probability, and the gain expected of a recalibration."""
    means = (length_text(comparison.models[index].position.statistics["mean"] / 1e3) for index in (-1, 0))
    errors = (length_text(rms) for rms in (motion.rms, motion.rms_after_recalibration))
    return (
        f"{motion_text(motion)}, and the mean error is {next(means)} ({next(means)} under the nominal robot). "
        f"Recalibrating is expected to lower the RMS error from {next(errors)} to {next(errors)}."
    )


def motion_warnings(motion: SessionResult) -> tuple[str, ...]:
    """Return sentences about movements that do not change the verdict, or a change that cannot be attributed."""
    if motion.verdict == "unchanged":
        return ()
    return (
        (f"{motion_text(motion)}.",)
        if motion.movements
        else (f"{motion.sentence[:1].upper()}{motion.sentence[1:]}",)
    )


def motion_text(motion: SessionResult) -> str:
    """Return a text about movements, such as "Joint 3 has moved by 0.24 ± 0.01 deg (probability more than 99.9 %)"."""
    amounts: dict[tuple[str, float | None], list[str]] = {}
    for one in motion.movements:
        amounts.setdefault((one.what, one.probability), []).append(one.shift_text)
    text = join_words(
        f"{_subject(what)} by {join_words(those)} (probability {format_probability(probability)})"
        for (what, probability), those in amounts.items()
    )
    return f"{text[:1].upper()}{text[1:]}"


def _subject(what: str) -> str:
    """Return subject and verb for a base, a tool, a joint or a geometric parameter such as "d_4"."""
    if is_frame(what):
        return f"the {what} has moved"
    return f"the parameter {what} has changed" if "_" in what else f"{what} has moved"


def excessive_change_diagnostics(robot: Robot, movements: Sequence[Movement]) -> tuple[Diagnostic, ...]:
    """Return a diagnostic of changes that are larger than those due to wear or a collision.

    Bases, tools and the zero of a single joint may move by any amount.

    Args:
        robot: robot, whose class states the limits; see `RobotClass.max_changes`.
        movements: movements that were found.
    """
    of_class = RobotClass.from_robot(robot)
    far = [one for one in movements if not is_frame(one.what) and _is_beyond(one, of_class.max_changes)]
    if not far or (len(far) == 1 and far[0].what.startswith("joint ")):
        return ()
    changes = join_words(f"{one.what} by {one.shift_text}" for one in far)
    return (
        Diagnostic(
            kind="beyond_wear",
            severity="implausible",
            sentence=f"The rows imply changes that neither wear nor a collision causes in a robot of class "
            f"'{of_class.name}': {changes}. Check units and scale, the order and signs of the columns, and whether "
            "this robot was measured.",
        ),
    )


def _is_beyond(one: Movement, limits: ChangeLimits) -> bool:
    if one.unit == "mm":
        return abs(one.shift) > limits.length * 1e3
    return abs(one.shift) > math.degrees(limits.joint_zero if one.what.startswith("joint ") else limits.angle)
