"""Contents of the tabs of a page, read from the cell."""

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from pisigma.deployment.export.registry import BUILT_IN
from pisigma.deployment.export.targets import POSE_COLUMNS
from pisigma.files.errors import ModelError, check_choice
from pisigma.files.templates import template_environment
from pisigma.lifetime.cell.events import EventKind
from pisigma.lifetime.cell.layout import EXPORTS, MODELS, PLANS, REPORTS
from pisigma.lifetime.cell.status import CellStatus
from pisigma.measurement.csv.columns import POSITION
from pisigma.planning.plan_file import joint_columns, yaml_of
from pisigma.reporting.rendering import markup_with_code
from pisigma.reporting.result_text import merge_alike_warnings
from pisigma.robot.robot_file import catalogue
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.workbench.forms import (
    cell_file_text,
    digest_of,
    form_of,
    form_of_cell,
    form_of_command,
    form_of_new_cell,
)
from pisigma.workbench.job import Jobs
from pisigma.workbench.model_server import ModelServer
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.incoming_rows import IncomingRows, Repair

TABS = {
    "status": "Status",
    "cell": "Cell",
    "plan": "Plan",
    "measure": "Measure",
    "calibrate": "Calibrate",
    "verify": "Verify & watch",
    "deliver": "Deliver",
}
"""Titles of the tabs by name."""
_TAB_OF = {
    "import": "measure",
    "monitor": "verify",
    "recalibrate": "verify",
    "session": "measure",
    "use": "status",
}
"""Tab of every command whose name is not the name of a tab."""
_FORMATS = tuple(
    name for name in BUILT_IN if name not in ("staubli", "xacro", "library", "ur-calibration", "rsi")
)
"""Formats that need no file from the controller."""
CHARTS = "-monitoring.html"
"""End of the names of pages with control charts in the reports of a cell."""
_FIGURES = (".png", ".svg")
_FIRST_ROWS, _MAX_ROWS, MAX_LINES = 8, 40, 2000
"""Number of first rows of an upload that are shown, and largest numbers of rows with findings and of lines in a
sentence."""
_LINES = re.compile(r"\blines? ((?:\d{1,9}(?:, | to | and )?)+)")
_RANGES = re.compile(r"(\d+)(?: to (\d+))?")


@dataclass(frozen=True)
class TimelineEntry:
    """Something that happened to a cell.

    Attributes:
        day: day or time (ISO 8601).
        kind: "session", "event", "model", "check" or "use".
        text: what happened.
        alarm: whether it requires attention.
    """

    day: str
    kind: str
    text: str
    alarm: bool = False


def ticks(maximum: float) -> list[float]:
    """Return round numbers for an axis from 0: multiples of 1, 2 or 5 times a power of ten, 3 to 6 of them."""
    power = 10.0 ** math.floor(math.log10(maximum))
    step = next(one * power for one in (0.2, 0.5, 1, 2) if maximum < 5.5 * one * power)
    return [round(number * step, 9) for number in range(int(maximum / step + 1e-9) + 1)]


class Tabs:
    """Renders the page and its tabs.

    Attributes:
        live: state of the session that is being followed, with the number of unchecked rows; None if there is none.
        serving: the server of the model in use.
    """

    def __init__(self, jobs: Jobs, serving: ModelServer, growing: Path | None = None) -> None:
        self._jobs, self.serving, self._growing = jobs, serving, growing
        self.live: dict[str, Any] | None = None
        self._environment = template_environment(
            "pisigma.workbench",
            {
                "together": merge_alike_warnings,
                "lines": line_numbers_in,
                "name": lambda path: Path(path).name,
                "tab_of": lambda step: _TAB_OF.get(step, step),
                "code": markup_with_code,
                "ticks": ticks,
            },
        )

    def render_page(self, folder: Path, cell: Cell | None, is_broken: bool = False) -> str:
        """Return the page without the content of its tabs; without a cell, there is only one tab.

        Args:
            folder: folder of the cell.
            cell: the cell; None before there is one, and if its `cell.yaml` cannot be used.
            is_broken: whether the `cell.yaml` of the folder cannot be used.
        """
        robot, tabs = ("", {"status": "New cell"}) if cell is None else (cell.robot.name, TABS)
        tabs = {"cell": "Repair"} if is_broken else tabs
        template = self._environment.get_template("page.html.j2")
        return template.render(tabs=tabs, name=folder.resolve().name, robot=robot, folder=folder)

    def render_new_cell_form(self, folder: Path) -> str:
        """Render the form that creates the cell."""
        return self._environment.get_template("new.html.j2").render(
            path=folder.absolute(),
            folder=shlex.quote(str(folder)),
            robots=catalogue(),
            settings=form_of_new_cell(),
            outcomes=self._jobs.outcomes,
        )

    def render_repair_form(self, folder: Path, fault: str) -> str:
        """Render the text of a `cell.yaml` that cannot be used, with what is wrong with it."""
        text = cell_file_text(folder)
        return self._environment.get_template("repair.html.j2").render(
            fault=fault, text=text, seen=digest_of(text), outcomes=self._jobs.outcomes
        )

    def render_tab(self, name: str, cell: Cell, status: CellStatus, earlier_texts: Mapping[str, str]) -> str:
        """Render the content of a tab.

        Args:
            name: name of the tab.
            cell: the cell.
            status: status of the cell.
            earlier_texts: the text of `cell.yaml` before a change of the page, by the digest of the text after it.
        """
        context: dict[str, Any] = {
            "facts": status.facts,
            "step": status.step,
            "outcomes": self._jobs.outcomes,
            "folder": shlex.quote(str(cell.folder)),
            "forms": lambda step: form_of(step, cell.file),
            "growing": self._growing,
            "serving": self.serving,
            "live": self.live,
            "words": form_of_command(status.step.command) if status.step.command else None,
        }
        return self._environment.get_template(f"{name}.html.j2").render(
            context | _more(name, cell, status, earlier_texts)
        )

    def render_proposal(self, incoming: IncomingRows, file_numbers: str) -> str:
        """Render the proposed meaning of the columns of uploaded files.

        Args:
            incoming: the files.
            file_numbers: numbers of the files, separated by commas.
        """
        names = [one.name for one in incoming.files]
        return self._environment.get_template("proposal.html.j2").render(
            mappings=() if incoming.needs_no_conversion else incoming.proposal.mappings,
            forms=form_of("import", incoming.cell.file),
            files=names,
            words=shlex.join(names),
            numbers=file_numbers,
        )

    def render_findings(
        self, incoming: IncomingRows, diagnostics: Sequence[Diagnostic], problem: str = ""
    ) -> str:
        """Return HTML with the findings of the check of uploaded rows next to the rows, with repairs.

        Args:
            incoming: the files.
            diagnostics: the findings.
            problem: reason why the rows cannot be read; "" if they can.
        """
        repairs = {one.sentence: incoming.repair(one) for one in diagnostics if one.severity == "implausible"}
        fields = {
            sentence: repaired_fields(incoming, repair) for sentence, repair in repairs.items() if repair
        }
        lines = {line for one in diagnostics for line in line_numbers_in(" ".join(one.row_places))}
        tables = []
        for mapping in () if problem else incoming.proposal.mappings:
            rows = sorted(
                zip(mapping.file.lines, mapping.file.records, strict=True),
                key=lambda row: row[0] not in lines,
            )
            tables.append((mapping, rows[: _FIRST_ROWS + min(len(lines), _MAX_ROWS)]))
        template = self._environment.get_template("findings.html.j2")
        return template.render(
            found=diagnostics, repairs=repairs, fields=fields, problem=problem, tables=tables, lines=lines
        )


def repaired_fields(incoming: IncomingRows, repair: Repair) -> dict[str, str]:
    """Return the values that a repair enters into the form of the proposal."""
    fields = {
        f"column {number} {one.index}": stated[mapping.key(one)]
        for stated in repair.settings.maps
        for number, mapping in enumerate(incoming.proposal.mappings)
        for one in mapping.columns
        if mapping.key(one) in stated
    }
    return fields | {"new_frame_at": " ".join(map(str, repair.settings.new_frame_at))}


def line_numbers_in(text: str) -> list[int]:
    """Return the line numbers of the rows that a sentence names, such as "line 12" or "lines 3, 7 to 9"."""
    found: list[int] = []
    for first, last in _RANGES.findall(" ".join(_LINES.findall(text))):
        found += range(int(first), min(int(last or first), int(first) + MAX_LINES) + 1)
    return found[:MAX_LINES]


def _more(name: str, cell: Cell, status: CellStatus, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return the values for the template that only this tab shows."""
    match name:
        case "status":
            return {"timeline": timeline(status), "kinds": get_args(EventKind)}
        case "cell":
            text = cell_file_text(cell.folder)
            seen = digest_of(text)
            return {"text": text, "seen": seen, "settings": form_of_cell(cell.file), "undo": seen in texts}
        case "plan":
            plans = sorted((cell.folder / PLANS).glob("*.csv"), reverse=True)
            return {"plans": [(one.name, yaml_of(one).name) for one in plans]}
        case "measure":
            return {"columns": [*joint_columns(cell.robot), *(f"{one}_mm" for one in POSITION)]}
        case "calibrate":
            return {"figures": newest_model_drawings(cell, status)}
        case "verify":
            return {"charts": [one for one in _names(cell.folder / REPORTS) if one.endswith(CHARTS)][:1]}
        case "deliver":
            return {
                "formats": {one: BUILT_IN[one][1] for one in _FORMATS},
                "downloads": _names(cell.folder / EXPORTS),
                "reports": [one for one in _names(cell.folder / REPORTS) if not one.endswith(CHARTS)],
                "columns": POSE_COLUMNS,
            }
    return {}


def timeline(status: CellStatus) -> list[TimelineEntry]:
    """Return what happened to a cell, newest first."""
    facts = status.facts
    entries = [
        TimelineEntry(
            one.taken_in,
            "session",
            f"{one.name}: {one.rows} rows, {one.sensor}{f'; set aside: {one.set_aside}' if one.set_aside else ''}",
            bool(one.set_aside),
        )
        for one in facts.sessions
    ]
    entries += [TimelineEntry(one.day, "event", one.sentence) for one in facts.events]
    entries += [TimelineEntry(one.made, "model", f"{one.name}: {one.remark}") for one in facts.models]
    entries += [
        TimelineEntry(
            one.checked,
            "check",
            f"{one.command}{f' of {one.model}' if one.model else ''}: {one.verdict.replace('_', ' ')}"
            f"{f'; {one.summary}' if one.summary else ''}",
            one.verdict not in ("planned", "trusted", "better", "unchanged", "recalibrated"),
        )
        for one in facts.checks
    ]
    return sorted(entries, key=lambda one: one.day, reverse=True)


def newest_model_drawings(cell: Cell, status: CellStatus) -> list[tuple[str, str]]:
    """Return the newest model and the names of its figures."""
    models = status.facts.models
    if not models:
        return []
    folder = cell.folder / MODELS / models[-1].name
    return [(models[-1].name, one.name) for one in sorted(folder.rglob("*")) if one.suffix in _FIGURES]


def _names(folder: Path) -> list[str]:
    """Return the names of the files in a folder, newest first; none if the folder does not exist."""
    files = [one for one in folder.glob("*") if one.is_file() and not one.name.startswith(".")]
    return [one.name for one in sorted(files, key=lambda one: one.stat().st_mtime, reverse=True)]


_FOLDERS = {"plan": PLANS, "model": MODELS, "export": EXPORTS, "report": REPORTS}
"""Folders of downloads by their kind."""


def download_of(cell: Cell, kind: str, names: tuple[str, ...]) -> Path:
    """Return a file of the cell that a page may download: a plan, an export, or a figure or the card of a model.

    Names are compared with the names of existing files, so that no other path can be chosen.

    Args:
        cell: the cell.
        kind: a key of `_FOLDERS`.
        names: name of the file; for a model, name of the model and of the file.

    Raises:
        ModelError: the file does not exist.
    """
    check_choice(ModelError, "download", kind, tuple(_FOLDERS))
    folder = cell.folder / _FOLDERS[kind]
    for one in folder.glob("*/**/*" if kind == "model" else "*"):
        parts = one.relative_to(folder).parts
        if (parts[0], *one.parts[-1:][: len(parts) - 1]) == names and one.is_file() and not one.is_symlink():
            return one
    raise ModelError("there is no such file", value="/".join(names))
