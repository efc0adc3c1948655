"""Read the facts about a cell from its folder, without its robot: the status of many cells is read quickly."""

import datetime
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from pisigma.files.errors import PlanningError
from pisigma.files.yaml_file import read_yaml
from pisigma.lifetime.cell.controller import Controller, records
from pisigma.lifetime.cell.history import HISTORY, Check, History, ModelEntry, SessionEntry
from pisigma.lifetime.cell.layout import CELL_FILE, PLANS, SESSIONS, newest_plan
from pisigma.lifetime.cell.status import CellFacts, next_step
from pisigma.lifetime.cell.step import COMPUTED, Step
from pisigma.measurement.dates import date_in_name

BEFORE_FIT = ("plan", "import")
"""Commands whose checks conclude nothing from measured rows."""
MIN_MEASURED_SHARE = 0.9
"""Smallest share of the poses of a plan after which it counts as measured; some poses may be out of sight."""


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


class _Stated(BaseModel):
    """Keys of `cell.yaml` from which the next step follows; commands that use the other keys check them."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    sensor: str = "tracker"
    limit_mm: Annotated[float, Field(gt=0)] | None = None
    surroundings: dict[str, Any] | None = None

    def plans_nothing(self, model: ModelEntry | None) -> str:
        """Return why no poses can be planned; "" if they can.

        Args:
            model: the model in use, which states the pose of the board; None without a model.
        """
        view = (self.surroundings or {}).get("view")
        if self.sensor != "camera" or (view and (model is not None or "frame" in view)):
            return ""
        return f"{CELL_FILE} does not state where the board is (surroundings, view)"


def status_of(folder: Path) -> CellStatus:
    """Return the status of a cell and its next step.

    Args:
        folder: folder of the cell.

    Raises:
        PlanningError: `cell.yaml` cannot be read.
        OutputError: the history cannot be read.
    """
    facts = facts_of(folder)
    return CellStatus(facts, next_step(facts))


def facts_of(folder: Path) -> CellFacts:
    """Read the facts about a cell; see `status_of`."""
    history = History(folder / HISTORY)
    with history.database.snapshot():
        return _facts(folder, history)


def _facts(folder: Path, history: History) -> CellFacts:
    sessions, checks = history.sessions(), history.checks()
    stated, in_use = read_yaml(folder / CELL_FILE, _Stated, PlanningError), history.in_use
    return CellFacts(
        folder=os.fspath(folder),
        plans=tuple(sorted(path.stem for path in (folder / PLANS).glob("*.csv"))),
        sessions=sessions,
        edited=edited_sessions(folder / SESSIONS, sessions),
        events=history.events(),
        models=history.models(),
        checks=checks,
        in_use=in_use,
        limit_mm=stated.limit_mm,
        today=datetime.date.today().isoformat(),
        not_taken_in=not_taken_in(folder / SESSIONS, sessions),
        not_read=unimported_files(folder / SESSIONS, sessions),
        plans_nothing=stated.plans_nothing(in_use),
        incomplete=_incomplete(folder, sessions, checks),
        controller=Controller.from_history(history),
    )


def _incomplete(folder: Path, sessions: Sequence[SessionEntry], checks: Sequence[Check]) -> str:
    """Return how many poses of the newest plan were measured, if too few and nothing was concluded yet; else ""."""
    planned = [one.checked for one in checks if one.command == "plan"]
    if not planned or not any((folder / PLANS).glob("*.csv")):
        return ""
    made = planned[-1]
    if any(one.checked > made and one.command not in BEFORE_FIT for one in checks):
        return ""
    measured = sum(one.poses or one.rows for one in sessions if one.taken_in > made and not one.set_aside)
    with newest_plan(folder).open(encoding="utf-8") as file:
        poses = sum(bool(line.strip()) for line in file) - 1
    if not 0 < measured < MIN_MEASURED_SHARE * poses:
        return ""
    return f"{measured} of {poses} poses of the newest plan have been measured"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file; "" if it is missing."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def not_taken_in(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Return the names of the files in the folder of sessions that are not in the history yet, by their dates."""
    names = {one.name for one in sessions}
    found = [path.name for path in folder.glob("*.csv") if path.stem not in names]
    return tuple(sorted(found, key=lambda name: (date_in_name(name), name)))


def unimported_files(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Return the names of the files in the folder of sessions that are not measurement files and were not imported."""
    names = {one.name for one in sessions}
    found = [path.name for path in folder.glob("[!.]*") if path.is_file() and path.suffix != ".csv"]
    return tuple(sorted(name for name in found if name not in names))


def edited_sessions(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Return the names of sessions in use whose files were changed or removed after they were added."""
    used = [one for one in sessions if not one.set_aside]
    return tuple(one.name for one in used if sha256_of(folder / f"{one.name}.csv") != one.sha256)
