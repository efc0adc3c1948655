"""Exports that are active on the controller of a cell, and the consequences for every command.

Two kinds of exports are active on a controller. *Kinematics* convert joint values to poses; the joint values of the arm
keep their meaning, so measured rows do not depend on them. *Joint zeros* change the meaning of joint values: a model
describes the arm with the zeros that were active when its rows were measured; with any others, it corrects twice or not
at all. All other exports contain corrected values or are used by other programs, and are not active on the controller.
"""

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pisigma.files.errors import MeasurementError, ModelError, Phrase, Place
from pisigma.lifetime.cell.events import ARM_EVENTS, Event
from pisigma.lifetime.cell.exports import ON_CONTROLLER, Contents, ControllerEntry, ExportEntry
from pisigma.lifetime.cell.history import HISTORY, History, ModelEntry, SessionEntry, day_of, now
from pisigma.lifetime.cell.layout import is_cell, model_folder
from pisigma.measurement.dates import EXPECTED_DATE, is_date

Situation = Literal["kinematics", "same_zeros", "other_zeros"]
"""Situations: the controller computes with exported kinematics; the active joint zeros are exported ones with which the
rows of the model were measured; the active joint zeros differ from those with which the rows of the model were
measured."""
Effect = Literal["allow", "warn", "refuse"]

RULES: dict[str, tuple[Effect, Effect, Effect]] = {
    # command               kinematics  same_zeros  other_zeros
    "serve": ("warn", "allow", "refuse"),
    "load": ("warn", "allow", "refuse"),
    "ik": ("warn", "allow", "refuse"),
    "export joint_values": ("warn", "allow", "refuse"),
    "export poses": ("refuse", "allow", "refuse"),
    "export description": ("allow", "allow", "refuse"),
    "export kinematics": ("allow", "allow", "refuse"),
    "export joint_zeros": ("refuse", "warn", "refuse"),
    "verify": ("allow", "allow", "refuse"),
    "evaluate": ("allow", "allow", "refuse"),
    "measure": ("allow", "allow", "warn"),
    "import": ("allow", "allow", "warn"),
    "monitor": ("allow", "allow", "warn"),
    "recalibrate": ("allow", "allow", "warn"),
    "use": ("allow", "allow", "warn"),
    "calibrate": ("allow", "warn", "allow"),
}
"""Effect of every situation on every command. `calibrate` uses only sessions measured with the current joint zeros."""

_TWICE = "a correction would be applied twice"
_MEANING = {
    (
        "export poses",
        "kinematics",
    ): f"{_TWICE}, because the poses are for a controller that computes with the nominal robot",
    (
        "export joint_zeros",
        "kinematics",
    ): f"{_TWICE}, because these kinematics already contain the offsets of the joints",
    ("export joint_zeros", "same_zeros"): "the exported offsets must be added to these",
    ("calibrate", "same_zeros"): "the model is valid only while they are active",
    ("measure", "other_zeros"): "the rows will differ from the model by these joint zeros",
    ("import", "other_zeros"): "the rows differ from the model by these joint zeros",
    ("monitor", "other_zeros"): "the motion that is found includes the shift of the joint zeros",
    ("recalibrate", "other_zeros"): "the motion that is found includes the shift of the joint zeros",
}
_ELSE: dict[Situation, str] = {
    "kinematics": "command the joint values as joint motions; if a pose is computed from them and commanded, "
    + _TWICE.replace("would be", "is"),
    "same_zeros": "the model describes the arm with these joint zeros",
    "other_zeros": "a correction would be applied twice or not at all",
}


@dataclass(frozen=True)
class ActiveExport:
    """An export that is active on a controller.

    Attributes:
        export: the export.
        since: day from which the export is active (ISO 8601).
    """

    export: ExportEntry
    since: str

    def __str__(self) -> str:
        """Return the name of the export for messages."""
        one = self.export
        return f"'{one.file}' ({one.format} of model '{one.model}', active since {self.since})"

    def to_json(self) -> dict[str, str]:
        """Return the export as plain values."""
        one = self.export
        return {
            "contains": one.contains,
            "format": one.format,
            "file": one.file,
            "sha256": one.sha256,
            "model": one.model,
            "since": self.since,
        }


@dataclass(frozen=True)
class ControllerHistory:
    """History of the exports that were active on a controller.

    Attributes:
        changes: all changes, in the order of their days.
        exports: all exports.
    """

    changes: tuple[ControllerEntry, ...] = ()
    exports: tuple[ExportEntry, ...] = ()

    @staticmethod
    def from_history(history: History) -> "ControllerHistory":
        """Return the controller of a cell."""
        return ControllerHistory(history.controller(), history.exports())

    def active_exports(self, day: str = "9999", time: str = "") -> dict[Contents, ActiveExport]:
        """Return the exports that were active at the end of a day, by contents.

        Args:
            day: the day (ISO 8601).
            time: time (ISO 8601, UTC); a change on this day counts only if it was recorded by then.
        """
        exports, found = {one.sha256: one for one in self.exports}, dict[Contents, ActiveExport]()
        for one in self.changes:
            if one.day > day or (one.day == day and one.recorded > time):
                break
            if not one.sha256:
                found.clear()
            elif one.sha256 in exports:
                export = exports[one.sha256]
                found[export.contains] = ActiveExport(export, one.day)
        return found

    def active_during(self, session: SessionEntry) -> dict[Contents, ActiveExport]:
        """Return the exports that were active during a session; on its day, only those recorded before it was added."""
        return self.active_exports(session.day, session.taken_in)

    @property
    def joint_zero_changes(self) -> tuple[ControllerEntry, ...]:
        """Changes of the joint zeros."""
        hashes = [_hash(self.active_exports(one.day, one.recorded)) for one in self.changes]
        pairs = zip(self.changes, ["", *hashes], hashes, strict=False)
        return tuple(one for one, before, after in pairs if before != after)

    def matches_session(self, session: SessionEntry) -> bool:
        """Return whether a session was measured with the joint zeros that are active now."""
        return _hash(self.active_during(session)) == _hash(self.active_exports())

    def active_when_fitted(
        self, model: ModelEntry, sessions: tuple[SessionEntry, ...]
    ) -> dict[Contents, ActiveExport]:
        """Return the exports that were active when the newest rows of a model were measured."""
        newest = [one for one in sessions if one.name == model.sessions.split(",")[-1]]
        return (
            self.active_during(newest[0])
            if newest
            else self.active_exports(model.day or day_of(model.made), model.made)
        )

    def matches_model(self, model: ModelEntry, sessions: tuple[SessionEntry, ...]) -> bool:
        """Return whether the joint zeros that are active now are those with which the rows of a model were measured."""
        return _hash(self.active_when_fitted(model, sessions)) == _hash(self.active_exports())

    def findings(
        self,
        command: str,
        model: ModelEntry | None,
        sessions: tuple[SessionEntry, ...],
        active: dict[Contents, ActiveExport] | None = None,
    ) -> "Findings":
        """Apply `RULES` to a command.

        Args:
            command: a key of `RULES`.
            model: the model that the command uses; None if the command uses none.
            sessions: all sessions of the cell.
            active: exports that were active when the rows were measured; None for the exports that are active now.
        """
        present = self.active_exports() if active is None else active
        behind = present if model is None else self.active_when_fitted(model, sessions)
        which: dict[Situation, str] = {}
        if "kinematics" in present:
            which["kinematics"] = f"the controller computes poses with {present['kinematics']}"
        zeros = present.get("joint_zeros")
        if _hash(behind) != _hash(present):
            then = behind.get("joint_zeros")
            assert model is not None  # otherwise the joint zeros are the same
            which["other_zeros"] = (
                f"the rows of model '{model.name}' were measured "
                f"{'without exported joint zeros' if then is None else f'with the joint zeros of {then}'}, but now "
                f"{'none are active' if zeros is None else f'those of {zeros} are active'}"
            )
        elif zeros is not None:
            which["same_zeros"] = f"the joint zeros of {zeros} are active"
        effects = dict(zip(get_args(Situation), RULES[command], strict=True))
        said: dict[Effect, list[str]] = {"allow": [], "warn": [], "refuse": []}
        for one, what in which.items():
            said[effects[one]].append(f"{what}: {_MEANING.get((command, one), _ELSE[one])}")
        return Findings(
            "; ".join(said["refuse"]), tuple(f"{one[0].upper()}{one[1:]}." for one in said["warn"])
        )


@dataclass(frozen=True)
class Findings:
    """Consequences for a command of the exports that are active on the controller.

    Attributes:
        refusal: reason why the command is refused; empty if it is not refused.
        warnings: warnings, one sentence each.
    """

    refusal: str
    warnings: tuple[str, ...]

    def checked_warnings(self, cell: Path) -> tuple[str, ...]:
        """Return the warnings.

        Raises:
            ModelError: the command is refused.
        """
        if self.refusal:
            raise ModelError(
                self.refusal,
                at=Place(cell),
                remedy="measure rows and recalibrate, or record what is active with `pisigma event "
                f"{cell} controller --export FILE|none`",
            )
        return self.warnings


def valid_sessions(
    sessions: tuple[SessionEntry, ...], events: tuple[Event, ...], controller: ControllerHistory
) -> tuple[SessionEntry, ...]:
    """Return the sessions that describe the current state of the arm.

    These sessions are not set aside, and were measured after the last event that changed the arm, with the joint zeros
    that are now active on the controller.
    """
    since = max((one.day for one in events if one.kind in ARM_EVENTS), default="")
    present = [one for one in sessions if not one.set_aside and one.day >= since]
    return tuple(one for one in present if controller.matches_session(one))


def _hash(active: dict[Contents, ActiveExport]) -> str:
    """Return a hash that identifies the active joint zeros; empty if none are active."""
    return active["joint_zeros"].export.sha256 if "joint_zeros" in active else ""


def export_records(active: dict[Contents, ActiveExport]) -> list[dict[str, str]]:
    """Return the active exports as plain values."""
    return [one.to_json() for one in active.values()]


def findings(history: History, command: str, model: ModelEntry | None) -> Findings:
    """Apply `RULES` to a command on a cell that uses a model; see `Controller.findings`."""
    return ControllerHistory.from_history(history).findings(command, model, history.sessions())


def checked_model_folder(path: Path, command: str) -> tuple[Path, tuple[str, ...]]:
    """Return the folder of a cell's model in use, and warnings; a path that is not a cell is returned unchanged.

    Raises:
        ModelError: no model of the cell is in use, or the command is refused because of an export that is active on the
            controller.
    """
    return model_folder(path), model_in_use_warnings(path, command)


def model_in_use_warnings(path: Path, command: str) -> tuple[str, ...]:
    """Return warnings for a command on the model in use of a cell; () without a model in use or a cell.

    Raises:
        ModelError: the command is refused because of an export that is active on the controller.
    """
    if not is_cell(path):
        return ()
    history = History(path / HISTORY)
    return findings(history, command, history.in_use).checked_warnings(path)


def record_controller(history: History, sha256: str, day: str, note: str) -> ControllerEntry:
    """Record the export that is active on the controller, in addition to an active export with other contents.

    Args:
        history: history of the cell.
        sha256: SHA-256 of the exported file; empty if no export is active from then on.
        day: day from which the export is active (ISO 8601); "" for today.
        note: free text.

    Raises:
        MeasurementError: the day is not valid, or no export of the cell that is active on a controller has this hash.
    """
    today = datetime.date.today().isoformat()
    day, exports = day or today, {one.sha256: one for one in history.exports()}
    if not is_date(day):
        raise MeasurementError(expected=EXPECTED_DATE, value=day, option="--date")
    if day > today:
        raise MeasurementError(expected=f"a day no later than {today}", value=day, option="--date")
    if sha256 and sha256 not in exports:
        raise MeasurementError(
            expected="an unchanged file written by `pisigma export CELL`, or none",
            value=Phrase(f"a file with the SHA-256 {sha256[:16]}..."),
            option="--export",
            remedy="export the model again",
        )
    if sha256 and exports[sha256].contains not in ON_CONTROLLER:
        raise MeasurementError(
            expected="kinematics or joint zeros of a controller",
            value=Phrase(f"a file of --format {exports[sha256].format}"),
            option="--export",
            remedy="record only what the controller computes with, not what programs use",
        )
    first = min((day_of(one.exported) for one in history.exports() if one.sha256 == sha256), default="")
    if day < first:
        expected = f"a day since {first}, when the file was exported"
        raise MeasurementError(expected=expected, value=day, option="--date")
    entry = ControllerEntry(day, sha256, note, now())
    history.add(entry)
    return entry
