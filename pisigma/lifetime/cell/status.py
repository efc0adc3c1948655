"""Next step of a cell: rules that derive a state, a reason and a command from its sessions, events and models."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pisigma.lifetime.cell.controller import records
from pisigma.lifetime.cell.events import ARM_EVENTS
from pisigma.lifetime.cell.facts import NOT_TRUSTED, CellFacts, facts_of
from pisigma.lifetime.cell.history import Check, ModelEntry
from pisigma.lifetime.cell.layout import SESSIONS
from pisigma.lifetime.cell.step import COMPUTED, State, Step

MAX_DAYS_UNVERIFIED = 92
"""[days] Time without a session after which the model in use has to be verified again: a quarter of a year."""
VERIFICATION_POSES = 10
"""Number of poses of a session for verification or monitoring."""
P95_PER_SCATTER = 2.7955
"""95 % quantile of the length of three independent normal errors, per standard deviation (chi distribution)."""

FOREIGN = "foreign"
"""Verdict on a file in `sessions/` that is not a measurement file."""


@dataclass(frozen=True)
class CellStatus:
    """Status of a cell.

    Attributes:
        facts: facts from which the next step was derived.
        step: the next step.
    """

    facts: CellFacts
    step: Step

    @property
    def name(self) -> str:
        """Name of the folder of the cell."""
        return Path(self.facts.folder).name

    @property
    def is_due(self) -> bool:
        """Whether there are steps that need neither new rows nor a decision of a person."""
        return self.step.verb is not None or self.step.state in ("not_taken_in", "file_refused")

    @property
    def last_error(self) -> Check | None:
        """The last check that found an RMS error of the model in use or, if there is none, of the newest model."""
        model = self.facts.in_use or (self.facts.models[-1] if self.facts.models else None)
        checks = [] if model is None else self.facts.errors_of(model.name, *COMPUTED)
        known = [one for one in checks if one.rms_mm is not None]
        return known[-1] if known else None

    def to_json(self) -> dict[str, Any]:
        """Return the status as plain values; `next.command` and `next.reason` are the next step."""
        facts, model = self.facts, self.facts.in_use
        return {
            "cell": facts.folder,
            "model": None if model is None else model.name,
            "made_of": [] if model is None else list(model.made_of),
            "p95_mm": None if model is None else model.p95_mm,
            "limit_mm": facts.limit_mm,
            "controller": records(facts.controller.active()),
            "plans": list(facts.plans),
            "sessions": [
                {
                    "name": one.name,
                    "day": one.day,
                    "rows": one.rows,
                    "set_aside": one.set_aside or None,
                    "controller": records(facts.controller.during(one)),
                }
                for one in facts.sessions
            ],
            "events": [one.to_json() for one in facts.events],
            "models": [{"name": one.name, "remark": one.remark} for one in facts.models],
            "not_taken_in": list(facts.not_taken_in),
            "not_read": list(facts.not_read),
            "next": self.step.to_json(),
        }


def status_of(folder: Path) -> CellStatus:
    """Return the status of a cell and its next step.

    Args:
        folder: folder of the cell.

    Raises:
        PisigmaError: see `facts_of`.
    """
    facts = facts_of(folder)
    return CellStatus(facts, next_step(facts))


def next_step(facts: CellFacts) -> Step:
    """Return the step of the first rule that applies, in the order of `RULES`; a plan is measured before the next."""
    step = due_step(facts)
    if facts.incomplete and step.verb in ("calibrate", "verify", "monitor"):
        why = f"{facts.incomplete}; measure and import the others, or continue with `{step.command}`"
        return Step("session_incomplete", why, facts.import_command())
    if step.command != facts.command("plan"):
        return step
    if facts.unmeasured_plan:
        return _to_measure(facts, facts.unmeasured_plan)
    if facts.plans_nothing:
        reason = f"{step.reason}; {facts.plans_nothing}, so measure poses that you choose and import them"
        return replace(step, reason=reason, command=facts.import_command())
    return step


def due_step(facts: CellFacts) -> Step:
    """Return the step of the first rule that applies, as if every plan had been measured."""
    return next(step for rule in RULES if (step := rule(facts)) is not None)


def plans_check(facts: CellFacts) -> bool:
    """Return whether a few poses are due that check the present model, instead of those of a calibration."""
    return bool(facts.models) and due_step(facts).state != "outside_limit"


def _to_measure(facts: CellFacts, plan: str) -> Step:
    return Step(
        "not_measured",
        f"{plan} has not been measured yet; ROWS.csv contains its rows with the measured columns added",
        facts.import_command(),
    )


def _edited_session(facts: CellFacts) -> Step | None:
    if not facts.edited:
        return None
    name = facts.edited[0]
    return Step(
        "edited_session",
        f"the file of session '{name}' was changed or removed after it was added; restore the measured file, or set "
        "the session aside",
        facts.command("session", name, "--set-aside", "edited"),
    )


def _file_to_take_in(facts: CellFacts) -> Step | None:
    if not facts.not_taken_in:
        return None
    name = facts.not_taken_in[0]
    command = facts.import_command(f"{facts.folder}/{SESSIONS}/{name}")
    refusals = [one for one in facts.checks if one.command == "import" and f"{one.session}.csv" == name]
    if refusals and refusals[-1].verdict == FOREIGN:
        why = f"{SESSIONS}/{name} is not a measurement file, but may be imported"
        return Step("file_refused", why, command)
    if refusals:
        why = f"{refusals[-1].summary.rstrip('.')}; correct the file, or set it aside"
        return Step("file_refused", why, facts.command("session", name[:-4], "--set-aside", "refused"))
    return Step("not_taken_in", f"the file {SESSIONS}/{name} has not been added to the cell", command)


def _no_session(facts: CellFacts) -> Step | None:
    if facts.valid_sessions:
        return None
    ended = [one for one in facts.events if one.kind in ARM_EVENTS] if facts.sessions else []
    why = f"{ended[-1].kind} on {ended[-1].day} ended the validity of all sessions" if ended else ""
    if any(not one.set_aside and not facts.controller.is_present(one) for one in facts.sessions):
        why = "all sessions were measured with other joint zeros than those that are active on the controller"
    if not facts.plans or why:
        return Step("no_plan", why or "there is no plan and no session", facts.command("plan"))
    return _to_measure(facts, facts.unmeasured_plan or f"plan '{facts.plans[-1]}'")


def _not_calibrated(facts: CellFacts) -> Step | None:
    if facts.newest_model is not None or facts.in_use is not None:
        return None
    rows = sum(one.rows for one in facts.valid_sessions)
    return _calibrate(facts, "not_calibrated", f"there are {rows} measured rows, but no model")


def _calibrate(facts: CellFacts, state: State, reason: str) -> Step:
    """Return the step "calibrate"; more rows are measured instead if these must not be trusted."""
    calibrations = [one for one in facts.checks if one.command == "calibrate"]
    newest = max(one.taken_in for one in facts.valid_sessions)
    if calibrations and calibrations[-1].verdict == "not_trusted" and calibrations[-1].checked >= newest:
        why = f"the calibration must not be trusted: {calibrations[-1].summary}"
        return Step("not_trusted", why, facts.import_command())
    return Step(state, reason, facts.command("calibrate"))


def _not_verified(facts: CellFacts) -> Step | None:
    if facts.in_use is not None:
        return None
    model = facts.newest_model
    assert model is not None  # else an earlier rule applies
    verdicts = facts.checks_of(model.name, "verify", "recalibrate")
    judged = {one.session for one in verdicts}
    new = [one for one in facts.new_sessions(model) if one.name not in judged]
    if new:
        return Step(
            "not_verified",
            f"model '{model.name}' is not in use; session '{new[-1].name}', to which it was not fitted, can verify it",
            facts.command("verify"),
        )
    if verdicts and (step := _after(facts, verdicts[-1], ("not_better", "undecided"))):
        return step
    return Step(
        "not_verified",
        f"model '{model.name}' has not been verified with new rows; measure {VERIFICATION_POSES} poses, import them, "
        f"and run `{facts.command('verify')}`",
        facts.command("plan"),
    )


def _after(facts: CellFacts, last: Check, failed: tuple[str, ...]) -> Step | None:
    """Return the step that follows from the last check of a model; `failed`: verdicts that ask for a calibration."""
    if last.verdict in NOT_TRUSTED:
        return Step(
            "session_not_trusted",
            f"nothing can be concluded from session '{last.session}': {last.summary}",
            facts.command("session", last.session, "--set-aside", last.verdict),
        )
    if last.recalibrate:
        if any(one.name == last.model and not one.has_posterior for one in facts.models):
            why = f"{last.summary.rstrip('.')}; record the change with `pisigma event`, then measure and calibrate"
            return Step("moved", why, facts.command("plan"))
        state: State = "older_than_evidence" if last.verdict == "unchanged" else "moved"
        return Step(state, last.summary, facts.command("recalibrate"))
    if last.verdict in failed and not any(one.made >= last.checked for one in facts.models):
        return _calibrate(facts, "verification_failed", last.summary)
    return None


def _other_joint_zeros(facts: CellFacts) -> Step | None:
    model = facts.in_use
    state: State = "other_joint_zeros"
    assert model is not None
    if facts.controller.fits(model, facts.sessions):
        return None
    why = f"model '{model.name}' needs other joint zeros than those that are active on the controller"
    if fitting := [one.name for one in facts.models if facts.controller.fits(one, facts.sessions)]:
        return Step(state, f"{why}; model '{fitting[-1]}' needs these", facts.command("use", fitting[-1]))
    if not (new := facts.new_sessions(model)):
        return Step(state, why, facts.command("plan"))
    tried = [one for one in facts.checks_of(model.name, "recalibrate") if one.session == new[-1].name]
    if tried and tried[-1].verdict in NOT_TRUSTED:
        return _calibrate(facts, state, why)
    return Step(state, why, facts.command("recalibrate" if model.has_posterior else "calibrate"))


def _session_not_judged(facts: CellFacts) -> Step | None:
    model = facts.in_use
    assert model is not None
    judged = {one.session for one in facts.checks_of(model.name, "verify", "monitor", "recalibrate")}
    new = [one for one in facts.new_sessions(model) if one.name not in judged]
    if not new:
        return None
    verb = "monitor" if model.has_posterior else "verify"
    if facts.limit_mm is not None and _p95(facts, model) is None:
        verb = "verify"
    return Step(
        "session_not_judged",
        f"session '{new[-1].name}' has not been compared with model '{model.name}'",
        facts.command(verb),
    )


def _last_verdict(facts: CellFacts) -> Step | None:
    """Return the step that follows from the last session that was compared with the model in use."""
    model = facts.in_use
    assert model is not None
    checks = facts.checks_of(model.name, "verify", "monitor", "recalibrate")
    return _after(facts, checks[-1], ("not_better",)) if checks else None


def _better_model(facts: CellFacts) -> Step | None:
    newest, model = facts.newest_model, facts.in_use
    assert model is not None
    if newest is None or newest.name == model.name or newest.made <= model.made:
        return None
    judged = {one.session for one in facts.checks_of(newest.name, "verify")}
    new = [one for one in facts.new_sessions(newest) if one.name not in judged]
    if not new:
        return None
    return Step(
        "better_model",
        f"model '{newest.name}' is not in use; session '{new[-1].name}', to which it was not fitted, can verify it",
        facts.command("verify", "--model", newest.name),
    )


def _fitted_to_set_aside(facts: CellFacts) -> Step | None:
    model, newest = facts.in_use, facts.newest_model
    assert model is not None
    if not (wrong := [one.name for one in facts.sessions if one.set_aside and one.name in model.made_of]):
        return None
    why = f"model '{model.name}' was fitted to session '{wrong[-1]}', which was set aside"
    if newest is None or newest.made <= model.made:
        return _calibrate(facts, "fitted_to_set_aside", why)
    why = f"{why}; measure {VERIFICATION_POSES} poses, import them, and verify model '{newest.name}'"
    return Step("fitted_to_set_aside", why, facts.command("plan"))


def _p95(facts: CellFacts, model: ModelEntry) -> float | None:
    """Return the last known 95 % quantile of the position errors of a model [mm]; None if it is unknown."""
    found = [one.p95_mm for one in facts.errors_of(model.name, "verify") if one.p95_mm is not None]
    return found[-1] if found else model.p95_mm


def _outside_limit(facts: CellFacts) -> Step | None:
    model, limit = facts.in_use, facts.limit_mm
    assert model is not None
    p95 = _p95(facts, model)
    if limit is None or (p95 is not None and p95 <= limit):
        return None
    if p95 is None:
        return Step(
            "verification_due",
            f"it is not known whether model '{model.name}' meets the limit of {limit:g} mm; measure "
            f"{VERIFICATION_POSES} poses, import them, and run `{facts.command('verify')}`",
            facts.command("plan"),
        )
    scatter = P95_PER_SCATTER * (model.scatter_mm or 0.0)
    if scatter > limit:
        return Step(
            "limit_below_scatter",
            f"the 95 % quantile of the position errors is {p95:.3f} mm, above the limit of {limit:g} mm; the scatter "
            f"of the sensor and of the robot alone makes {scatter:.3f} mm, which more poses do not reduce; use a more "
            "accurate sensor, or raise limit_mm",
        )
    return Step(
        "outside_limit",
        f"the 95 % quantile of the position errors is {p95:.3f} mm, above the limit of {limit:g} mm; more poses reduce "
        "it until the repeatability of the robot is reached",
        facts.command("plan"),
    )


def _verification_due(facts: CellFacts) -> Step | None:
    model = facts.in_use
    assert model is not None
    newest = max(one.day for one in facts.valid_sessions)
    age = (datetime.date.fromisoformat(facts.today) - datetime.date.fromisoformat(newest)).days
    if age <= MAX_DAYS_UNVERIFIED:
        return None
    return Step(
        "verification_due",
        f"the last session is {age} days old; measure {VERIFICATION_POSES} poses and run "
        f"`{facts.command('monitor' if model.has_posterior else 'verify')}`",
        facts.command("plan"),
    )


def _up_to_date(facts: CellFacts) -> Step:
    assert facts.in_use is not None
    newest = datetime.date.fromisoformat(max(one.day for one in facts.valid_sessions))
    due = newest + datetime.timedelta(days=MAX_DAYS_UNVERIFIED)
    return Step(
        "up_to_date",
        f"model '{facts.in_use.name}' is in use (`{facts.command('serve')}`, `ik` or `export`); measure again by "
        f"{due}",
    )


RULES: tuple[Callable[[CellFacts], Step | None], ...] = (
    _edited_session,
    _file_to_take_in,
    _no_session,
    _not_calibrated,
    _not_verified,
    _other_joint_zeros,
    _session_not_judged,
    _last_verdict,
    _better_model,
    _fitted_to_set_aside,
    _outside_limit,
    _verification_due,
    _up_to_date,
)
