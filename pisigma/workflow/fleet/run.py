"""Run the steps that are due in the cells of a folder, in processes or on Ray, and write a table of results."""

import functools
import io
import os
import shlex
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pisigma.files.engines.engine import AbstractEngine
from pisigma.files.engines.processes import ProcessEngine
from pisigma.files.errors import PisigmaError
from pisigma.files.output_file import write_atomically
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.facts import CellFacts, facts_of
from pisigma.lifetime.cell.layout import MODELS, cells_in
from pisigma.lifetime.cell.status import CellStatus, next_step, status_of
from pisigma.lifetime.cell.step import ATTENTION
from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.workflow.settings.fleet import FleetSettings

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel
    from pisigma.workflow.cell.cell import Cell

_CELLS_PER_CHUNK = 4
"""Number of cells that a worker processes at a time, which takes a few seconds."""
_LOST = (
    "the process that worked on this cell ended unexpectedly twice; check the free memory and the files of the "
    "cell."
)
RESULTS = "results.parquet"
"""Name of the table in the folder of the cells."""


def advance_cell(
    cell: "Cell", prior: Path | None = None, progress: Progress = lambda what: None
) -> CellStatus:
    """Calibrate, verify, monitor and recalibrate a cell as its status requires, for one new session after the other.

    New files in `sessions/` are added one by one in the order of their dates, each after all steps that earlier
    files make possible: a model of the first session is verified with the second, and monitored with the third. A
    cell whose status names no such step is not changed.

    Args:
        cell: the cell.
        prior: model folder of `pisigma fleet prior` from which calibrations start; None to calibrate from scratch.
        progress: called with the name of each step.

    Returns:
        The status afterwards.

    Raises:
        PisigmaError: the rows of a session cannot be used, or a step refuses them.
    """
    cell.sessions.one_by_one = True
    done: set[str] = set()
    while True:
        step = next_step(replace(facts_of(cell.folder), unrecorded_files=()))
        if step.automatic_command is not None and step.command not in done:
            done.add(step.command)
            progress(step.automatic_command)
            _take(cell, step.automatic_command, shlex.split(step.command)[3:], prior)
        elif not cell.sessions.add_next_file():
            return status_of(cell.folder)
        else:
            done.clear()


def _take(cell: "Cell", verb: str, options: list[str], prior: Path | None) -> None:
    """Carry out a step."""
    if verb == "verify":
        cell.verify(model=options[1] if options else None)
    elif verb == "calibrate":
        cell.calibrate(prior=prior)
    elif verb == "monitor":
        cell.monitor()
    else:
        cell.recalibrate()


@dataclass(frozen=True)
class ParameterValue:
    """An estimated geometric parameter.

    Attributes:
        name: name of the parameter, such as "theta_1".
        unit: "mm" or "deg", of the three figures.
        value: identified value.
        change: difference from the nominal value.
        standard_error: standard error of the estimate.
        remark: "identified", the sum with other parameters that is identified instead, or "" if it is not known.
    """

    name: str
    unit: str
    value: float
    change: float
    standard_error: float
    remark: str = ""


Parameters = Mapping[str, Sequence[ParameterValue]]
"""Estimated parameters of models, by the SHA-256 of their `model.yaml`."""


def read_parameters(path: Path) -> Parameters:
    """Read the parameters of the models in a table; empty if there is no table, or it cannot be read."""
    from pyarrow import ArrowException, parquet

    try:
        table = parquet.read_table(path, columns=["model_sha256", "parameters"]).to_pylist()
    except (OSError, ArrowException):
        return {}
    return {
        row["model_sha256"]: [ParameterValue(**one) for one in row["parameters"]]
        for row in table
        if row["parameters"]
    }


def write_results(path: Path, cells: Sequence[CellFacts], parameters: Parameters) -> None:
    """Write one row for every check of every cell; the row of a new model contains its parameters.

    Args:
        path: file to write.
        cells: facts about the cells.
        parameters: estimated parameters of the models.

    Raises:
        OutputError: the file cannot be written; an existing file remains unchanged.
        ImportError: pyarrow is not installed.
    """
    import pyarrow
    from pyarrow import parquet

    text, number = pyarrow.string(), pyarrow.float64()
    estimates = ((name, number) for name in ("value", "change", "standard_error"))
    parameter = pyarrow.struct([("name", text), ("unit", text), *estimates, ("remark", text)])
    schema = pyarrow.schema(
        [
            *((name, text) for name in ("cell", "command", "session", "day")),
            ("rows", pyarrow.int64()),
            ("temperature_c", number),
            *((name, text) for name in ("model", "model_sha256", "verdict", "summary")),
            ("rms_mm", number),
            ("p95_mm", number),
            ("recalibrate", pyarrow.bool_()),
            ("parameters", pyarrow.list_(parameter)),
        ]
    )
    rows = [row for facts in cells for row in _rows(facts, parameters)]
    content = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema), content)
    write_atomically(path, content.getvalue())


def _rows(facts: CellFacts, parameters: Parameters) -> list[dict[str, object]]:
    """Return a row for every check of a cell, in the order in which they were made."""
    sessions = {one.name: one for one in facts.sessions}
    models = {one.name: one for one in facts.models}
    rows = []
    for check in facts.checks:
        session, model = sessions.get(check.session), models.get(check.model)
        new = model is not None and check.command in ("calibrate", "recalibrate")
        row = {
            "cell": Path(facts.folder).name,
            "day": session.day if session else model.day if model else "",
            "rows": session.rows if session else None,
            "temperature_c": session.temperature_c if session else None,
            "model_sha256": model.sha256 if model else "",
            "parameters": [asdict(one) for one in parameters.get(model.sha256, ())] if model and new else [],
        }
        rows.append(asdict(check) | row)
    return rows


@dataclass(frozen=True)
class FleetRun:
    """Result of `run_fleet`.

    Attributes:
        cells: number of cells.
        unchanged: number of cells without due steps.
        refused: names of the cells that need attention, with the reasons.
        results: file of the table of all checks.
        seconds: computing time [s].
    """

    cells: int
    unchanged: int
    refused: tuple[tuple[str, str], ...]
    results: Path
    seconds: float

    @property
    def cells_not_refused(self) -> int:
        """Number of cells that were not refused."""
        return self.cells - len(self.refused)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {
            "cells": self.cells,
            "done": self.cells_not_refused,
            "unchanged": self.unchanged,
            "refused": [{"cell": cell, "reason": reason} for cell, reason in self.refused],
            "seconds": round(self.seconds, 3),
            "results": str(self.results),
        }


def run_fleet(
    folder: str | os.PathLike[str],
    settings: FleetSettings = FleetSettings(),
    progress: Progress = lambda what: None,
) -> FleetRun:
    """Advance all cells in a folder: calibrate, verify, monitor and recalibrate as the status of each requires.

    See `advance_cell`. A cell with bad rows is reported and does not stop other cells. The
    contents of a cell are always complete, so a later call continues after an interruption; a cell whose status names
    no step is not opened.

    Args:
        folder: folder of cells; `results.parquet` is written there.
        settings: see `FleetSettings`.
        progress: called with the number of processed cells.

    Raises:
        PlanningError: the folder contains no cell.
        ModelError: the prior is not a model of `pisigma fleet prior`.
        OutputError: the table cannot be written.
        ImportError: the extra of the engine or of the table is not installed.
    """
    started, path = time.perf_counter(), Path(folder) / RESULTS
    for extra in ("pyarrow", *(("ray",) if settings.engine == "ray" else ())):
        import_module(extra)  # checked first, before any step and any writing
    cells = cells_in(folder)
    if settings.prior is not None:
        from pisigma.model.folder.model_folder import load_model
        from pisigma.model.model_posterior import check_fleet_prior

        check_fleet_prior(load_model(settings.prior))
    before = FleetStatus.read(folder)
    reasons = dict(before.unreadable) | {
        one.name: one.step.reason for one in before.cells if one.step.state in ATTENTION
    }
    due = {one.name for one in before.cells if one.has_automatic_step}
    waiting = [cell for cell in cells if cell.name in due]
    parameters = dict(read_parameters(path))
    work = functools.partial(_advance, prior=settings.prior)
    with _engine(settings, len(waiting)) as engine:
        results = engine.results(work, waiting, _CELLS_PER_CHUNK) if waiting else iter(())
        for number, (cell, result) in enumerate(results, len(cells) - len(waiting) + 1):
            reason, found = (_LOST, {}) if result is None else result
            parameters |= found
            reasons.pop(cell.name, None)
            reasons |= {cell.name: reason} if reason else {}
            progress(f"{number} of {len(cells)} cells")
    after = [one.facts for one in FleetStatus.read(folder).cells]
    for facts in after:
        try:
            parameters |= _parameters(facts, parameters.keys())
        except PisigmaError as problem:  # a fault of one cell must not stop other cells
            reasons.setdefault(Path(facts.folder).name, str(problem))
    write_results(path, after, parameters)
    return FleetRun(
        cells=len(cells),
        unchanged=len(cells) - len(waiting),
        refused=tuple(sorted(reasons.items())),
        results=path,
        seconds=time.perf_counter() - started,
    )


def _advance(folder: Path, prior: Path | None) -> tuple[str, dict[str, list[ParameterValue]]]:
    """Advance a cell; return the reason why it needs attention (or "") and the parameters of its models."""
    # importing torch takes seconds, and most calls have nothing to do
    from pisigma.workflow.cell.cell import Cell

    reason = ""
    try:
        step = advance_cell(Cell.open(folder), prior).step
        reason = step.reason if step.state in ATTENTION else ""
    except Exception as problem:  # a fault of one cell must not stop other cells; a later call tries again
        known = isinstance(problem, PisigmaError | OSError | MemoryError)
        defect = f"a defect in pisigma ({type(problem).__name__}: {problem}); please report it."
        reason = str(problem) if known else defect
    try:
        return reason, _parameters(status_of(folder).facts)
    except PisigmaError as problem:
        return reason or str(problem), {}


def _parameters(facts: CellFacts, known: Iterable[str] = ()) -> dict[str, list[ParameterValue]]:
    """Return the estimated parameters of a cell's models that are not yet known, by the SHA-256 of the models."""
    new = {one.sha256: Path(facts.folder) / MODELS / one.name for one in facts.models}
    there = {sha256: folder for sha256, folder in new.items() if sha256 not in known and folder.is_dir()}
    if not there:
        return {}
    from pisigma.model.folder.model_folder import load_model

    return {sha256: parameters_of(load_model(folder)) for sha256, folder in there.items()}


def parameters_of(model: "CalibratedModel") -> list[ParameterValue]:
    """Return the geometric parameters of a calibration, or of the posterior of a recalibrated model."""
    estimated = model.metrics.get("parameters")
    if estimated is not None:
        names = ("name", "unit", "estimated", "change", "standard_error", "remark")
        rows = [[one.get(name) for name in names] for one in estimated]
        return [ParameterValue(*row) for row in rows if row[4] is not None]
    if (posterior := model.uncertainty) is None:
        return []
    from pisigma.measurement.sensors.sensor import SHOWN_UNITS

    space, values = posterior.space, posterior.geometry.robot.dh.ravel()
    changes, deviations = (
        values - space.robot.dh.ravel(),
        posterior.dense_root[: space.arm_parameter_count].norm(dim=1),
    )
    parameters = []
    for number in deviations.nonzero()[:, 0].tolist():
        unit, scale = SHOWN_UNITS[space.parameters[number].unit]
        value, change, error = (float(those[number]) * scale for those in (values, changes, deviations))
        parameters.append(ParameterValue(space.names[number], unit, value, change, error))
    return parameters


@contextmanager
def _engine(settings: FleetSettings, items: int) -> Iterator[AbstractEngine]:
    """Yield the engine that the settings choose."""
    jobs = settings.jobs or os.cpu_count() or 1
    if settings.engine == "processes" or not items:
        yield ProcessEngine(max(1, min(jobs, items)))
        return
    from pisigma.files.engines.processes import RayEngine

    engine = RayEngine(settings.jobs, settings.address)
    try:
        yield engine
    finally:
        engine.close()
