"""Next step of a cell: rules that derive a state, a reason and a command from its sessions, events and models."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pisigma.lifetime.cell.controller import export_records
from pisigma.lifetime.cell.events import ARM_EVENTS, CHANGING_EVENTS
from pisigma.lifetime.cell.facts import NOT_TRUSTED, CellFacts, facts_of
from pisigma.lifetime.cell.history import Check, ModelEntry
from pisigma.lifetime.cell.layout import SESSIONS
from pisigma.lifetime.cell.step import COMPUTED, State, Step

MAX_DAYS_UNVERIFIED = 92
"""Time without a session after which the model in use must be verified again [days]: a quarter of a year."""
VERIFICATION_POSES = 10
"""Number of poses in a session for verification or monitoring."""
_MEASURE_AND = f"measure {VERIFICATION_POSES} poses, import them, and"
_CAN_VERIFY = "is not in use; session '{}', to which it was not fitted, can verify it"
_JUDGING = ("verify", "monitor", "recalibrate")
"""Commands that compare a session with a model."""
_P95_PER_SCATTER = 2.7955
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
    def has_automatic_step(self) -> bool:
        """Whether there are steps that need neither new rows nor a decision by a person."""
        return self.step.automatic_command is not None or self.step.state in ("not_taken_in", "file_refused")

    @property
    def last_error(self) -> Check | None:
        """The last check that determined an RMS error of the model in use or, if there is none, of the newest model."""
        model = self.facts.in_use or (self.facts.models[-1] if self.facts.models else None)
        checks = [] if model is None else self.facts.trusted_checks_of(model.name, *COMPUTED)
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
            "controller": export_records(facts.controller.active_exports()),
            "plans": list(facts.plans),
            "sessions": [
                {
                    "name": one.name,
                    "day": one.day,
                    "rows": one.rows,
                    "set_aside": one.set_aside or None,
                    "controller": export_records(facts.controller.active_during(one)),
                }
                for one in facts.sessions
            ],
            "events": [one.to_json() for one in facts.events],
            "models": [{"name": one.name, "remark": one.remark} for one in facts.models],
            "not_taken_in": list(facts.unrecorded_files),
            "not_read": list(facts.foreign_files),
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
    """Return the step of the first of `RULES` and `RULES_IN_USE` that applies; an open plan is measured first."""
    step = due_step(facts)
    if facts.too_few_poses_text and step.automatic_command in ("calibrate", "verify", "monitor"):
        why = f"{facts.too_few_poses_text}; measure and import the others, or continue with `{step.command}`"
        return Step("session_incomplete", why, facts.import_command())
    if step.command != facts.command("plan"):
        return step
    if facts.unmeasured_plan:
        return _to_measure(facts, facts.unmeasured_plan)
    if facts.no_plan_reason:
        reason = f"{step.reason}; {facts.no_plan_reason}, so measure poses that you choose and import them"
        return replace(step, reason=reason, command=facts.import_command())
    return step


def due_step(facts: CellFacts) -> Step:
    """Return the step of the first rule that applies, as if every plan had been measured."""
    steps = (rule(facts) for rule in RULES)
    if (step := next(filter(None, steps), None)) is None:
        assert facts.in_use is not None  # otherwise a rule of `RULES` applies
        steps = (rule(facts, facts.in_use) for rule in RULES_IN_USE)
        step = next(filter(None, steps), None) or _up_to_date(facts, facts.in_use)
    return step


def is_check_due(facts: CellFacts) -> bool:
    """Return whether a few poses for checking the current model are due, rather than the poses of a calibration."""
    return bool(facts.models) and due_step(facts).state != "outside_limit"


def _to_measure(facts: CellFacts, plan: str) -> Step:
    why = f"{plan} has not been measured yet; ROWS.csv contains its rows with the measured columns added"
    return Step("not_measured", why, facts.import_command())


def _several_arms(facts: CellFacts) -> Step | None:
    why = f"`{facts.command('calibrate')}` calibrates its arms; other commands take the model and files of one arm"
    return Step("several_arms", why) if facts.has_several_arms else None


def _model_changed(facts: CellFacts) -> Step | None:
    if facts.in_use is None or facts.in_use.name not in facts.changed_models:
        return None
    state: State = "model_changed"
    why = f"the folder of model '{facts.in_use.name}', which is in use, was changed or removed; restore it"
    if (newest := facts.newest_model) is not None:
        return Step(state, f"{why}, or use model '{newest.name}'", facts.command("use", newest.name))
    if facts.valid_sessions:
        return _calibrate(facts, state, f"{why}, or calibrate again")
    return Step(state, f"{why}, or measure new rows", facts.command("plan"))


def _edited_session(facts: CellFacts) -> Step | None:
    if not facts.edited_sessions:
        return None
    name = facts.edited_sessions[0]
    return Step(
        "edited_session",
        f"the file of session '{name}' was changed or removed after it was added; restore the measured file, or set "
        "the session aside",
        facts.command("session", name, "--set-aside", "edited"),
    )


def _file_to_take_in(facts: CellFacts) -> Step | None:
    if not facts.unrecorded_files:
        return None
    name = facts.unrecorded_files[0]
    command = facts.import_command(f"{facts.folder}/{SESSIONS}/{name}")
    refusals = [one for one in facts.checks if one.command == "import" and f"{one.session}.csv" == name]
    if refusals and refusals[-1].verdict == FOREIGN:
        why = f"{SESSIONS}/{name} is not a measurement file; `import` can convert many formats"
        return Step("file_refused", why, command)
    if refusals:
        why = f"{refusals[-1].summary.rstrip('.')}; correct the file, or set it aside"
        return Step("file_refused", why, facts.command("session", name[:-4], "--set-aside", "refused"))
    return Step("not_taken_in", f"the file {SESSIONS}/{name} has not been added to the cell", command)


def _no_session(facts: CellFacts) -> Step | None:
    if facts.valid_sessions:
        return None
    ended = [one for one in facts.events if one.kind in ARM_EVENTS] if facts.sessions else []
    why = f"{ended[-1].kind} on {ended[-1].day} invalidated all sessions" if ended else ""
    if any(not one.set_aside and not facts.controller.matches_session(one) for one in facts.sessions):
        why = "all sessions were measured with joint zeros other than those that are active on the controller"
    if not facts.plans or why:
        return Step("no_plan", why or "there is no plan and no session", facts.command("plan"))
    return _to_measure(facts, facts.unmeasured_plan or f"plan '{facts.plans[-1]}'")


def _not_calibrated(facts: CellFacts) -> Step | None:
    if facts.newest_model is not None or facts.in_use is not None:
        return None
    rows = sum(one.rows for one in facts.valid_sessions)
    return _calibrate(facts, "not_calibrated", f"there are {rows} measured rows, but no model")


def _calibrate(facts: CellFacts, state: State, reason: str) -> Step:
    """Return the step "calibrate", or a step that measures more rows if the current rows must not be trusted."""
    last = _last_calibration(facts)
    newest = [one.taken_in for one in facts.valid_sessions]
    newest += [one.recorded for one in facts.events if one.kind in CHANGING_EVENTS]
    if last is not None and last.verdict == "not_trusted" and last.checked >= max(newest):
        why = f"the calibration must not be trusted: {last.summary}"
        return _settings_changed(facts) or Step("not_trusted", why, facts.import_command())
    return Step(state, reason, facts.command("calibrate"))


def _last_calibration(facts: CellFacts) -> Check | None:
    return next((one for one in reversed(facts.checks) if one.command == "calibrate"), None)


def _settings_changed(facts: CellFacts, _: ModelEntry | None = None) -> Step | None:
    last = _last_calibration(facts)
    if last is None or last.settings_sha256 in ("", facts.settings_sha256):
        return None
    why = "the settings of the calibration in cell.yaml, or a file that they name, changed after the last calibration"
    return Step("settings_changed", why, facts.command("calibrate"))


def _not_verified(facts: CellFacts) -> Step | None:
    if facts.in_use is not None:
        return None
    model = facts.newest_model
    assert model is not None  # otherwise an earlier rule applies
    if changed := _settings_changed(facts):
        return changed
    if wrong := _wrongly_fitted(facts, model):
        return _calibrate(facts, *wrong)
    if new := _not_judged(facts, model, "verify", "recalibrate"):
        why = f"model '{model.name}' {_CAN_VERIFY.format(new[-1])}"
        return Step("not_verified", why, facts.command("verify"))
    verdicts = facts.checks_of(model.name, "verify", "recalibrate")
    if verdicts and (step := _after(facts, verdicts[-1], ("not_better", "undecided"))):
        return step
    return Step(
        "not_verified",
        f"model '{model.name}' has not been verified with new rows; {_MEASURE_AND} run `{facts.command('verify')}`",
        facts.command("plan"),
    )


def _not_judged(facts: CellFacts, model: ModelEntry, *commands: str) -> list[str]:
    """Return the names of sessions that are new to a model and that no command has compared with it."""
    judged = {one.session for one in facts.checks_of(model.name, *commands)}
    return [one.name for one in facts.new_sessions(model) if one.name not in judged]


def _after(facts: CellFacts, last: Check, failed: tuple[str, ...]) -> Step | None:
    """Return the step that follows from the last check of a model; `failed` are verdicts that require a calibration."""
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
        if last.verdict != "unchanged":
            return Step("moved", last.summary, facts.command("recalibrate"))
        why = f"recalibrating with session '{last.session}' improves the prediction of held-out rows: {last.summary}"
        return Step("older_than_evidence", why, facts.command("recalibrate"))
    if last.verdict in failed and not any(one.made >= last.checked for one in facts.models):
        return _calibrate(facts, "verification_failed", last.summary)
    return None


def _other_joint_zeros(facts: CellFacts, model: ModelEntry) -> Step | None:
    state: State = "other_joint_zeros"
    if (matches := facts.controller.matches_model)(model, facts.sessions):
        return None
    why = f"model '{model.name}' needs joint zeros other than those that are active on the controller"
    if fitting := [one.name for one in facts.unchanged_models if matches(one, facts.sessions)]:
        return Step(state, f"{why}; model '{fitting[-1]}' needs these", facts.command("use", fitting[-1]))
    if not (new := facts.new_sessions(model)):
        return Step(state, why, facts.command("plan"))
    tried = [one for one in facts.checks_of(model.name, "recalibrate") if one.session == new[-1].name]
    if tried and tried[-1].verdict in NOT_TRUSTED:
        return _calibrate(facts, state, why)
    return Step(state, why, facts.command("recalibrate" if model.has_posterior else "calibrate"))


def _session_not_judged(facts: CellFacts, model: ModelEntry) -> Step | None:
    if not (new := _not_judged(facts, model, *_JUDGING)):
        return None
    verb = "monitor" if model.has_posterior else "verify"
    if facts.limit_mm is not None and _p95(facts, model) is None:
        verb = "verify"
    why = f"session '{new[-1]}' has not been compared with model '{model.name}'"
    return Step("session_not_judged", why, facts.command(verb))


def _last_verdict(facts: CellFacts, model: ModelEntry) -> Step | None:
    """Return the step that follows from the last session compared with the model in use."""
    checks = facts.checks_of(model.name, *_JUDGING)
    return _after(facts, checks[-1], ("not_better",)) if checks else None


def _better_model(facts: CellFacts, model: ModelEntry) -> Step | None:
    newest = facts.newest_model
    if newest is None or newest.made <= model.made or _wrongly_fitted(facts, newest):
        return None
    new = _not_judged(facts, newest, "verify")
    why = f"model '{newest.name}' {_CAN_VERIFY.format(new[-1])}" if new else ""
    return Step("better_model", why, facts.command("verify", "--model", newest.name)) if new else None


def _replaced(facts: CellFacts, model: ModelEntry) -> Step | None:
    newest = facts.newest_model
    if (wrong := _wrongly_fitted(facts, model)) is None:
        return None
    if newest is None or newest.made <= model.made or _wrongly_fitted(facts, newest):
        return _calibrate(facts, *wrong)
    return Step(wrong[0], f"{wrong[1]}; {_MEASURE_AND} verify model '{newest.name}'", facts.command("plan"))


def _wrongly_fitted(facts: CellFacts, model: ModelEntry) -> tuple[State, str] | None:
    """Return the state and the reason if a model was fitted to rows that do not belong together; otherwise None."""
    aside = [one.name for one in facts.sessions if one.set_aside and one.name in model.made_of]
    if aside:
        why = f"model '{model.name}' was fitted to session '{aside[-1]}', which was set aside"
        return "fitted_to_set_aside", why
    if late := facts.later_event(model):
        why = f"model '{model.name}' was fitted to rows before and after {late}, which was recorded later"
        return "fitted_before_event", why
    return None


def _p95(facts: CellFacts, model: ModelEntry) -> float | None:
    """Return the last known 95 % quantile of the position errors of a model [mm]; None if it is unknown."""
    found = [one.p95_mm for one in facts.trusted_checks_of(model.name, "verify") if one.p95_mm is not None]
    return found[-1] if found else model.p95_mm


def _outside_limit(facts: CellFacts, model: ModelEntry) -> Step | None:
    limit, p95 = facts.limit_mm, _p95(facts, model)
    if limit is None or (p95 is not None and p95 <= limit):
        return None
    if p95 is None:
        why = f"it is not known whether model '{model.name}' meets the limit of {limit:g} mm; {_MEASURE_AND}"
        return Step("verification_due", f"{why} run `{facts.command('verify')}`", facts.command("plan"))
    missed = f"the 95 % quantile of the position errors is {p95:.3f} mm, above the limit of {limit:g} mm"
    scatter = _P95_PER_SCATTER * (model.scatter_mm or 0.0)
    if scatter > limit:
        return Step(
            "limit_below_scatter",
            f"{missed}; the scatter of the sensor and of the robot alone accounts for {scatter:.3f} mm, which more "
            "poses cannot reduce; use a more accurate sensor, or raise limit_mm",
        )
    why = f"{missed}; more poses reduce it until the repeatability of the robot is reached"
    return Step("outside_limit", why, facts.command("plan"))


def _verification_due(facts: CellFacts, model: ModelEntry) -> Step | None:
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


def _up_to_date(facts: CellFacts, model: ModelEntry) -> Step:
    newest = datetime.date.fromisoformat(max(one.day for one in facts.valid_sessions))
    due = newest + datetime.timedelta(days=MAX_DAYS_UNVERIFIED)
    why = f"model '{model.name}' is in use (`{facts.command('serve')}`, `ik` or `export`); measure again by {due}"
    return Step("up_to_date", why)


RULES: tuple[Callable[[CellFacts], Step | None], ...] = (
    _several_arms,
    _model_changed,
    _edited_session,
    _file_to_take_in,
    _no_session,
    _not_calibrated,
    _not_verified,
)
"""Rules that apply until a model is in use, in order."""
RULES_IN_USE: tuple[Callable[[CellFacts, ModelEntry], Step | None], ...] = (
    _other_joint_zeros,
    _session_not_judged,
    _last_verdict,
    _settings_changed,
    _better_model,
    _replaced,
    _outside_limit,
    _verification_due,
)
"""Rules for a model in use, in order; without a step, the cell is up to date."""
