"""`pisigma status`, `use`, `session`, `event`, `pack` and `unpack`: the commands of cells."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.endings import NOT_ACCEPTED
from pisigma.cli.fleet.commands import show_fleet
from pisigma.cli.output import print_json, print_line, print_lines, print_table, wrap_lines
from pisigma.cli.settings_options import Group, StatedSettings

if TYPE_CHECKING:
    from pisigma.lifetime.cell.status import CellStatus
    from pisigma.workflow.cell.cell import Cell

CellFolder = Annotated[Path, typer.Argument(metavar="CELL", help="Folder of a cell.")]
Reason = Annotated[str, typer.Option(help="Reason to record in the history.")]
_MAX_LINES = 12
"""Largest number of sessions that are printed, newest first."""


def status(
    cell: Annotated[Path, typer.Argument(metavar="CELL|FOLDER", help="Cell or folder of cells.")],
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="Exit with status 3 if a step is due.")
    ] = False,
    watch: Annotated[
        float | None, typer.Option(min=1, help="Interval at which to print the status again [s].")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the state of a cell, or of every cell in a folder, and the command to run next."""
    while True:
        states = _status(cell, as_json)
        if watch is None:
            break
        time.sleep(watch)
    if exit_code and states != {"up_to_date"}:
        raise typer.Exit(NOT_ACCEPTED)


def _status(path: Path, as_json: bool) -> set[str]:
    """Print the status of a cell or of a folder of cells; return the states."""
    if (cell := cell_at(path)) is None:
        return set(show_fleet(path, as_json=as_json).states)
    one = cell.status()
    if as_json:
        print_json(one.to_json())
    else:
        _print_status(one)
    return {one.step.state}


def _print_status(status: "CellStatus") -> None:
    """Print the status of a cell."""
    facts, model = status.facts, status.facts.in_use
    limit = "there is no limit" if facts.limit_mm is None else f"the limit is {facts.limit_mm:g} mm"
    if model is None:
        print_lines([f"{facts.folder}: no model is in use; {limit}."])
    else:
        accuracy = (
            "" if model.p95_mm is None else f", 95 % of held-out position errors below {model.p95_mm:.3f} mm"
        )
        count = len(model.made_of)
        made = f"fitted to {count} session{'s' if count > 1 else ''} until {model.day}"
        print_lines([f"{facts.folder}: model '{model.name}' is in use, {made}{accuracy}; {limit}."])
    verdicts = {one.session: one.verdict for one in facts.checks}
    rows = [
        (
            one.name,
            str(one.rows),
            one.sensor,
            f"set aside: {one.set_aside}" if one.set_aside else verdicts.get(one.name, ""),
        )
        for one in facts.sessions[-_MAX_LINES:]
    ]
    if rows:
        print_table(f"sessions ({len(facts.sessions)})", ("session", "rows", "sensor", "verdict"), rows)
    print_lines(one.sentence for one in facts.events)
    print_lines(_controller_lines(status))
    print_lines(
        f"sessions/{name} will be added by the next command that reads rows."
        for name in facts.unrecorded_files
    )
    print_lines(
        f"sessions/{name} is not read, because it is not a measurement file (.csv); import it if it contains rows."
        for name in facts.foreign_files
    )
    print_next(status)


def _controller_lines(status: "CellStatus") -> list[str]:
    """Return a line for every export that is active on the controller."""
    active = status.facts.controller.active_exports().values()
    return [f"{one.export.contains.replace('_', ' ')} on the controller: {one}." for one in active]


def cell_at(path: str | Path) -> "Cell | None":
    """Return the cell at a path; None if the path is not a cell."""
    from pisigma.lifetime.cell.layout import is_cell

    if not is_cell(path):
        return None
    from pisigma.workflow.cell.cell import Cell

    return Cell.open(path)


def report_overrides(cell: "Cell", step: str, settings: StatedSettings[Any]) -> Mapping[str, Any]:
    """Print to stderr which settings of a step the command line overrides; return the stated settings by key."""
    for key in sorted(settings.values.keys() & cell.file.stated_values(step).keys()):
        print_line(f"The command line overrides {key} of {cell.file.path}.", to_stderr=True)
    return settings.values


def settings_at(path: str | Path, step: str, settings: StatedSettings[Group]) -> Group:
    """Return the settings of the command line; for a cell, together with the settings in its file."""
    cell = cell_at(path)
    if cell is None:
        return settings.build()
    chosen: Group = cell.file.settings_of_step(step, **report_overrides(cell, step, settings))
    return chosen


def refuse_with_cell(**given: object) -> None:
    """Refuse arguments whose values a cell already contains.

    Args:
        **given: values of options and arguments, by their names.
    """
    for name, value in given.items():
        if value:
            raise typer.BadParameter(
                f"remove {name.replace('_', '-')}: a cell contains its robot, rows and models"
            )


def output_in_cell(cell: "Cell | None", subfolder: str, suffix: str) -> Path:
    """Return a path for an output in a folder of a cell; refuse a missing `--out` without a cell."""
    from pisigma.workflow.cell.new_files import output_path

    if cell is None:
        raise typer.BadParameter(
            "expected the path of the output, because no cell is given", param_hint="'--out'"
        )
    return output_path(cell.folder, subfolder, suffix)


def next_step_lines(status: "CellStatus") -> list[str]:
    """Return the lines that state the next step of a cell, with its command on a separate line."""
    reason = status.step.reason.rstrip(".")
    if not status.step.command:
        return wrap_lines([f"Nothing to do: {reason}."])
    return [*wrap_lines([f"Next step, because {reason}:"]), f"  {status.step.command}"]


def print_next(status: "CellStatus") -> None:
    """Print the next step of a cell."""
    for line in next_step_lines(status):
        print_line(line)


def use(
    cell: CellFolder,
    model: Annotated[str | None, typer.Argument(help="Name of the model; not with --undo.")] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Put the previous model back into use.")] = False,
    reason: Reason = "",
    as_json: AsJson = False,
) -> None:
    """Put a model of a cell into use, or undo the last change; every change is kept in the history with its reason."""
    from pisigma.workflow.cell.cell import Cell

    if (model is None) is not undo:
        raise typer.BadParameter("expected either the name of a model or --undo", param_hint="'MODEL'")
    opened = Cell.open(cell)
    before = opened.history.in_use
    warnings, now = opened.use(model, reason), opened.history.in_use
    if as_json:
        names = {"model": now and now.name, "before": before and before.name}
        print_json({**names, "warnings": list(warnings)})
    else:
        hint = "" if undo else f" (undo: pisigma use {cell} --undo)"
        print_lines([f"Model '{now.name}' is in use{hint}." if now else "No model is in use.", *warnings])


def session(
    cell: CellFolder,
    name: Annotated[str, typer.Argument(help="Name of the session.")],
    set_aside: Annotated[str, typer.Option(help="Reason for excluding the session from further use.")],
    as_json: AsJson = False,
) -> None:
    """Set a session of a cell aside; its file is kept."""
    from pisigma.workflow.cell.cell import Cell

    opened = Cell.open(cell)
    opened.sessions.set_aside(name, set_aside)
    if as_json:
        print_json({"session": name, "set_aside": set_aside})
    else:
        print_lines([f"Session '{name}' is set aside."])
        print_next(opened.status())


def event(
    cell: CellFolder,
    kind: Annotated[
        str,
        typer.Argument(
            help="Kind of event: a change (instrument, tool, mastering, encoder, collision, maintenance, firmware), "
            "accepted (a person accepted the model in use) or controller (with --export)."
        ),
    ],
    date: Annotated[str, typer.Option(help="Day of the event, such as 2026-11-22. [default: today]")] = "",
    note: Annotated[str, typer.Option(help="Remark to record with the event.")] = "",
    by: Annotated[
        str, typer.Option(help="Name of the person who accepted the model or reported the change.")
    ] = "",
    export: Annotated[
        Path | None,
        typer.Option(
            help="For the event controller: file written by `pisigma export CELL` that the controller uses from "
            "that day on, or none."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Record what was changed, that a person accepted the model in use, or what is active on the controller.

    Events determine which sessions remain valid. Rows measured after an instrument or tool event have a new frame or
    target. Sessions before a mastering, encoder, collision or maintenance event are no longer used for
    calibration, nor are those that were measured with other joint zeros of the controller.
    """
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.cell.exports import record_active_export

    if (kind == "controller") is (export is None) or (export is not None and by):
        raise typer.BadParameter(
            "the option is required for the event controller, applies to no other event, and excludes --by",
            param_hint="'--export'",
        )
    opened = Cell.open(cell)
    if export is not None:
        changed = record_active_export(opened, export, date, note)
        record, line = {"day": changed.day, "kind": kind, "note": note}, f"controller on {changed.day}."
    else:
        recorded = opened.history.record(kind, date, note, by)
        record, line = recorded.to_json(), recorded.sentence
    status = opened.status()
    if as_json:
        print_json(record if export is None else {**record, "active": status.to_json()["controller"]})
    else:
        print_lines([f"Recorded: {line}", *_controller_lines(status)])
        print_next(status)


def pack(
    cell: CellFolder,
    out: Annotated[Path, typer.Option(help="File to write (.zip).")],
    as_json: AsJson = False,
) -> None:
    """Write a cell into one ZIP file."""
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.cell.transfer import pack as workflow

    count = workflow(Cell.open(cell), out)
    if as_json:
        print_json({"file": str(out), "files": count})
    else:
        print_lines([f"{count} files of {cell} written to {out}."])


def unpack(
    file: Annotated[Path, typer.Argument(help="Packed cell (.zip).")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    as_json: AsJson = False,
) -> None:
    """Restore a cell from a file written by `pisigma pack`."""
    from pisigma.workflow.cell.transfer import unpack as workflow

    opened = workflow(file, out)
    if as_json:
        print_json({"cell": str(out), **opened.status().to_json()})
    else:
        print_lines([f"Cell written to {out}."])
        print_next(opened.status())
