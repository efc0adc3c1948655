"""Carry out the steps that are due in the cells of a folder, in processes or on Ray, and write one table of results."""

import functools
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pisigma.files.engines.engine import AbstractEngine
from pisigma.files.engines.processes import ProcessEngine
from pisigma.files.errors import PisigmaError
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.facts import CellFacts
from pisigma.lifetime.cell.layout import MODELS, cells_in
from pisigma.lifetime.cell.status import status_of
from pisigma.lifetime.cell.step import ATTENTION
from pisigma.lifetime.fleet.results import (
    RESULTS,
    ParameterValue,
    read_parameters,
    write_results,
)
from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.workflow.settings.fleet import FleetSettings

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel

CELLS_PER_CHUNK = 4
"""Cells that a worker processes at once, which takes some seconds."""
_LOST = "the process that worked on it ended twice; check the memory and its files."


@dataclass(frozen=True)
class FleetRun:
    """Result of `run_fleet`.

    Attributes:
        cells: number of cells.
        unchanged: number of cells in which nothing was due.
        refused: names of the cells that need attention, and reasons.
        results: file of the table of all checks.
        seconds: computing time [s].
    """

    cells: int
    unchanged: int
    refused: tuple[tuple[str, str], ...]
    results: Path
    seconds: float

    @property
    def done(self) -> int:
        """Number of cells that need no attention."""
        return self.cells - len(self.refused)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {
            "cells": self.cells,
            "done": self.done,
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

    See `pisigma.workflow.cell.advance.advance_cell`. A cell with bad rows is reported and does not stop the others. The
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
        import_module(extra)  # before the work, and before anything is written
    cells = cells_in(folder)
    if settings.prior is not None:
        from pisigma.model.folder.model_folder import load_model
        from pisigma.model.model_posterior import check_fleet_prior

        check_fleet_prior(load_model(settings.prior))
    before = FleetStatus.read(folder)
    reasons = dict(before.unreadable) | {
        one.name: one.step.reason for one in before.cells if one.step.state in ATTENTION
    }
    due = {one.name for one in before.cells if one.is_due}
    waiting = [cell for cell in cells if cell.name in due]
    parameters = dict(read_parameters(path))
    work = functools.partial(_advance, prior=settings.prior)
    with _engine(settings, len(waiting)) as engine:
        results = engine.results(work, waiting, CELLS_PER_CHUNK) if waiting else iter(())
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
        except PisigmaError as problem:  # one cell must not stop the others
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
    """Advance a cell; return why it needs attention, "" if it does not, and the parameters of its models."""
    from pisigma.workflow.cell.advance import (
        advance_cell,  # torch takes seconds, and most calls have nothing to do
    )
    from pisigma.workflow.cell.cell import Cell

    reason = ""
    try:
        step = advance_cell(Cell.open(folder), prior).step
        reason = step.reason if step.state in ATTENTION else ""
    except Exception as problem:  # one cell must not stop the others; a later call tries it again
        known = isinstance(problem, PisigmaError | OSError | MemoryError)
        defect = f"a defect of pisigma ({type(problem).__name__}: {problem}); please report it."
        reason = str(problem) if known else defect
    try:
        return reason, _parameters(status_of(folder).facts)
    except PisigmaError as problem:
        return reason or str(problem), {}


def _parameters(facts: CellFacts, known: Iterable[str] = ()) -> dict[str, list[ParameterValue]]:
    """Return the estimated parameters of the models of a cell, except known ones, by the SHA-256 of the models."""
    new = {one.sha256: Path(facts.folder) / MODELS / one.name for one in facts.models}
    there = {sha256: folder for sha256, folder in new.items() if sha256 not in known and folder.is_dir()}
    if not there:
        return {}
    from pisigma.model.folder.model_folder import load_model

    return {sha256: parameters_of(load_model(folder)) for sha256, folder in there.items()}


def parameters_of(model: "CalibratedModel") -> list[ParameterValue]:
    """Return the geometric parameters of a calibration, or those of which a recalibrated model has a posterior."""
    estimated = model.metrics.get("parameters")
    if estimated is not None:
        names = ("name", "unit", "estimated", "change", "standard_error")
        rows = [[one.get(name) for name in names] for one in estimated]
        return [ParameterValue(*row) for row in rows if row[-1] is not None]
    if (posterior := model.uncertainty) is None:
        return []
    from pisigma.measurement.sensors.sensor import SHOWN_UNITS

    space, values = posterior.space, posterior.geometry.robot.dh.ravel()
    changes, deviations = values - space.robot.dh.ravel(), posterior.root[: space.arm_size].norm(dim=1)
    parameters = []
    for number in deviations.nonzero()[:, 0].tolist():
        unit, scale = SHOWN_UNITS[space.parameters[number].unit]
        figures = (float(those[number]) * scale for those in (values, changes, deviations))
        parameters.append(ParameterValue(space.names[number], unit, *figures))
    return parameters


@contextmanager
def _engine(settings: FleetSettings, items: int) -> Iterator[AbstractEngine]:
    """Yield the engine that the settings choose."""
    jobs = settings.jobs or os.cpu_count() or 1
    if settings.engine == "processes" or not items:
        yield ProcessEngine(max(1, min(jobs, items)))
        return
    from pisigma.files.engines.ray_cluster import RayEngine

    engine = RayEngine(settings.jobs, settings.address)
    try:
        yield engine
    finally:
        engine.close()
