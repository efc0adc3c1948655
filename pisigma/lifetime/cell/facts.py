"""Read the facts about a cell without reading its robot, so that the status of many cells can be read quickly."""

import datetime
import hashlib
import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from pisigma.files.errors import PlanningError
from pisigma.files.model_files import is_unchanged
from pisigma.files.yaml_file import read_yaml
from pisigma.lifetime.cell.controller import ControllerHistory, valid_sessions
from pisigma.lifetime.cell.events import CHANGING_EVENTS, Event
from pisigma.lifetime.cell.history import HISTORY, Check, History, ModelEntry, SessionEntry
from pisigma.lifetime.cell.layout import (
    CELL_FILE,
    MODELS,
    PLANS,
    SESSIONS,
    is_cell_of_arms,
    newest_plan,
)
from pisigma.measurement.dates import date_in_name

_BEFORE_FIT = ("plan", "import")
"""Commands whose checks draw no conclusions from measured rows."""
_MIN_MEASURED_SHARE = 0.9
"""Smallest measured share of a plan's poses with which the plan is treated as complete; some poses may be out of
sight."""
NOT_TRUSTED = ("implausible", "setup_fault", "not_trusted")
"""Verdicts of `verify`, `monitor` and `recalibrate` after which no conclusions are drawn from a session."""


@dataclass(frozen=True)
class CellFacts:
    """Facts about a cell from which the rules derive its next step.

    Attributes:
        folder: folder of the cell, as the user named it.
        plans: names of the plans.
        sessions: all sessions in the order of their days.
        edited_sessions: names of sessions whose files were changed or removed after they were added.
        events: all events in the order of their days.
        models: all models in the order in which they were made.
        checks: all checks in the order in which they were made.
        in_use: the model in use; None if there is none.
        limit_mm: limit on the 95 % quantile of the position errors [mm]; None if there is none.
        today: day (ISO 8601).
        unrecorded_files: names of the files in `sessions/` that are not yet in the history, by their dates.
        foreign_files: names of the files in `sessions/` that are not measurement files and were not imported.
        no_plan_reason: reason why no poses can be planned; "" if they can be planned.
        settings_sha256: SHA-256 of the current settings of a calibration; see `Check`.
        changed_models: names of the model in use and of the newest model, if these were changed or removed after they
            were made.
        too_few_poses_text: number of measured poses of the newest plan as text, if there are too few; otherwise "".
        controller: exports that were active on the controller, with the times.
        has_several_arms: whether `cell.yaml` lists several arms, for which no steps are kept.
    """

    folder: str
    plans: tuple[str, ...]
    sessions: tuple[SessionEntry, ...]
    edited_sessions: tuple[str, ...]
    events: tuple[Event, ...]
    models: tuple[ModelEntry, ...]
    checks: tuple[Check, ...]
    in_use: ModelEntry | None
    limit_mm: float | None
    today: str
    unrecorded_files: tuple[str, ...] = ()
    foreign_files: tuple[str, ...] = ()
    no_plan_reason: str = ""
    settings_sha256: str = ""
    changed_models: tuple[str, ...] = ()
    too_few_poses_text: str = ""
    controller: ControllerHistory = field(default_factory=ControllerHistory)
    has_several_arms: bool = False

    @cached_property
    def valid_sessions(self) -> tuple[SessionEntry, ...]:
        """Sessions that describe the current state of the arm; see `valid_sessions`."""
        return valid_sessions(self.sessions, self.events, self.controller)

    @property
    def newest_model(self) -> ModelEntry | None:
        """The newest unchanged model that was fitted only to valid sessions; None if there is none."""
        valid = {one.name for one in self.valid_sessions}
        made = [one for one in self.unchanged_models if one.made_of and valid.issuperset(one.made_of)]
        return made[-1] if made else None

    @property
    def unchanged_models(self) -> list[ModelEntry]:
        """Models that were not changed or removed after they were made."""
        return [one for one in self.models if one.name not in self.changed_models]

    def later_event(self, model: ModelEntry) -> str:
        """Return the event that was recorded after a model had been fitted to rows before and after it, or "".

        A recalibration finds what has moved since its parent was made, so only the original calibration is considered.
        """
        models = {one.name: one for one in self.models}
        while (parent := models.pop(model.parent, None)) is not None:
            model = parent
        first = min((one.day for one in self.sessions if one.name in model.made_of), default=model.day)
        changes: list[tuple[str, str, str]] = [
            (one.day, one.recorded, one.kind) for one in self.events if one.kind in CHANGING_EVENTS
        ]
        changes += [(one.day, one.recorded, "controller") for one in self.controller.joint_zero_changes]
        late = [(kind, day) for day, at, kind in changes if at > model.made and first < day <= model.day]
        return f"the event '{late[-1][0]}' of {late[-1][1]}" if late else ""

    @property
    def unmeasured_plan(self) -> str:
        """Contents of the newest plan, if no session was added after it was made; otherwise ""."""
        planned = [one for one in self.checks if one.command == "plan"]
        newest = max((one.taken_in for one in self.sessions), default="")
        return planned[-1].summary if planned and planned[-1].checked > newest else ""

    def command(self, verb: str, *words: str) -> str:
        """Return a command line for this cell."""
        return shlex.join(["pisigma", verb, self.folder, *words])

    def import_command(self, rows: str = "ROWS.csv") -> str:
        """Return the command that adds rows to the cell."""
        return shlex.join(["pisigma", "import", rows, "--cell", self.folder])

    def checks_of(self, model: str, *commands: str) -> list[Check]:
        """Return the checks of a model by given commands, newest last, except those of excluded sessions."""
        aside = {one.name for one in self.sessions if one.set_aside}
        checks = [one for one in self.checks if one.model == model and one.command in commands]
        return [one for one in checks if one.session not in aside]

    def trusted_checks_of(self, model: str, *commands: str) -> list[Check]:
        """Return the checks of a model whose rows are trusted, so that their errors are errors of the model."""
        return [one for one in self.checks_of(model, *commands) if one.verdict not in NOT_TRUSTED]

    def new_sessions(self, model: ModelEntry) -> list[SessionEntry]:
        """Return the valid sessions to which a model was not fitted, measured on its newest day or later."""
        return [one for one in self.valid_sessions if one.name not in model.made_of and one.day >= model.day]


class _Stated(BaseModel):
    """Keys of `cell.yaml` that determine the next step; the other keys are checked by the commands that use them."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    sensor: str = "tracker"
    limit_mm: Annotated[float, Field(gt=0)] | None = None
    surroundings: dict[str, Any] | None = None
    robot: Any = None
    base: Any = None
    tip: Any = None
    camera: Any = None
    calibrate: Any = None

    def settings_hash(self, folder: Path) -> str:
        """Return the SHA-256 of the settings on which a calibration depends and of the files that they name."""
        camera = self.camera if isinstance(self.camera, dict) else {}
        names = [str(self.robot), *map(str, (*camera.get("camera", ()), *camera.get("board", ())))]
        stated = [self.robot, self.base, self.tip, self.camera, self.calibrate or None]
        hashes = [sha256_of(folder / name) for name in names]
        return hashlib.sha256(json.dumps([stated, hashes], sort_keys=True, default=str).encode()).hexdigest()

    def no_plan_reason(self, model: ModelEntry | None) -> str:
        """Return the reason why no poses can be planned; "" if they can be planned.

        Args:
            model: the model in use, which states the pose of the board; None if there is no model.
        """
        view = (self.surroundings or {}).get("view")
        if self.sensor != "camera" or (view and (model is not None or "frame" in view)):
            return ""
        return f"{CELL_FILE} does not state where the board is (surroundings, view)"


def settings_hash(folder: Path) -> str:
    """Return the SHA-256 of the settings of a calibration of a cell; see `Check`.

    Raises:
        PlanningError: `cell.yaml` cannot be read.
    """
    return read_yaml(folder / CELL_FILE, _Stated, PlanningError).settings_hash(folder)


def facts_of(folder: Path) -> CellFacts:
    """Read the facts about a cell.

    Args:
        folder: folder of the cell.

    Raises:
        PlanningError: `cell.yaml` cannot be read.
        OutputError: the history cannot be read.
    """
    history = History(folder / HISTORY)
    with history.database.snapshot():
        return _facts(folder, history)


def _facts(folder: Path, history: History) -> CellFacts:
    sessions, checks = history.sessions(), history.checks()
    stated, in_use = read_yaml(folder / CELL_FILE, _Stated, PlanningError), history.in_use
    models = history.models()
    checked = {one.name: one.sha256 for one in (*models[-1:], *([] if in_use is None else [in_use]))}
    return CellFacts(
        folder=os.fspath(folder),
        plans=tuple(sorted(path.stem for path in (folder / PLANS).glob("*.csv"))),
        sessions=sessions,
        edited_sessions=edited_sessions(folder / SESSIONS, sessions),
        events=history.events(),
        models=models,
        checks=checks,
        in_use=in_use,
        limit_mm=stated.limit_mm,
        today=datetime.date.today().isoformat(),
        unrecorded_files=unrecorded_files(folder / SESSIONS, sessions),
        foreign_files=foreign_files(folder / SESSIONS, sessions),
        no_plan_reason=stated.no_plan_reason(in_use),
        settings_sha256=stated.settings_hash(folder),
        changed_models=tuple(
            name for name, sha256 in checked.items() if not is_unchanged(folder / MODELS / name, sha256)
        ),
        too_few_poses_text=_incomplete(folder, sessions, checks),
        controller=ControllerHistory.from_history(history),
        has_several_arms=is_cell_of_arms(folder),
    )


def _incomplete(folder: Path, sessions: Sequence[SessionEntry], checks: Sequence[Check]) -> str:
    """Return a text with the number of measured poses of the newest plan if there are too few; otherwise ""."""
    planned = [one.checked for one in checks if one.command == "plan"]
    if not planned or not any((folder / PLANS).glob("*.csv")):
        return ""
    made = planned[-1]
    if any(one.checked > made and one.command not in _BEFORE_FIT for one in checks):
        return ""
    measured = sum(one.poses or one.rows for one in sessions if one.taken_in > made and not one.set_aside)
    with newest_plan(folder).open(encoding="utf-8") as file:
        poses = sum(bool(line.strip()) for line in file) - 1
    if not 0 < measured < _MIN_MEASURED_SHARE * poses:
        return ""
    return f"{measured} of {poses} poses of the newest plan have been measured"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file; "" if it is missing."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def unrecorded_files(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Return the names of the files in the folder of sessions that are not yet in the history, by their dates."""
    names = {one.name for one in sessions}
    found = [path.name for path in folder.glob("*.csv") if path.stem not in names]
    return tuple(sorted(found, key=lambda name: (date_in_name(name), name)))


def foreign_files(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Return the names of the files in the folder of sessions that are not measurement files and were not imported."""
    names = {one.name for one in sessions}
    found = [path.name for path in folder.glob("[!.]*") if path.is_file() and path.suffix != ".csv"]
    return tuple(sorted(name for name in found if name not in names))


def edited_sessions(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Return the names of sessions in use whose files were changed or removed after they were added."""
    used = [one for one in sessions if not one.set_aside]
    return tuple(one.name for one in used if sha256_of(folder / f"{one.name}.csv") != one.sha256)
