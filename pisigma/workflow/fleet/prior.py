"""Estimate the prior of a fleet of robots, a model from which calibrations with few rows start."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pisigma.estimation.population import MIN_ROBOTS
from pisigma.files.errors import FleetError, PisigmaError
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.layout import cells_in
from pisigma.lifetime.fleet.prior import FleetPrior, fleet_prior
from pisigma.lifetime.fleet.prior_summary import FleetPriorSummary, summarise_prior
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings, with_limits_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.derived_cards import write_fleet_prior_card
from pisigma.robot.description import Robot
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.result import AbstractModelResult


@dataclass(frozen=True, eq=False)
class FleetPriorResult(AbstractModelResult):
    """Result of `estimate_fleet_prior`: the prior of a fleet, and all figures.

    Attributes:
        model: the mean robot, with the covariance between robots as its uncertainty.
        prior: means and covariances.
        summary: all figures.
        seconds: computing time [s].
    """

    model: CalibratedModel
    prior: FleetPrior
    summary: FleetPriorSummary
    seconds: float

    def _describe(self, model: CalibratedModel, summary: Any, folder: Path) -> None:
        write_fleet_prior_card(model, summary, folder)


def estimate_fleet_prior(
    folder: str | os.PathLike[str], progress: Progress = lambda what: None
) -> FleetPriorResult:
    """Estimate means and covariances of the errors of one type of robot from the first valid session of each cell.

    Args:
        folder: folder of cells; files in their `sessions/` that have not been added yet are added.
        progress: called with the current step.

    Raises:
        PlanningError: the folder contains no cell.
        FleetError: the robots are of several types, or too few of them have rows. Single cells without rows are listed
            in the figures.
        IdentificationError: the rows of a robot do not determine its base.
    """
    started = time.perf_counter()
    cells = cells_in(folder)
    robots, rows, refused = dict[str, Robot](), dict[str, Measurements](), dict[str, str]()
    for number, path in enumerate(cells, 1):
        progress(f"{number} of {len(cells)} cells")
        try:
            cell = Cell.open(path)
            some = cell.sessions.rows_of_file(cell.sessions.valid_sessions()[0]).split_sets()[0]
            causes = [one for one in setup_diagnostics(cell.robot, some) if one.severity == "implausible"]
            if causes:  # a wrong unit would look like a large scatter between robots
                raise FleetError(f"{some.source}: {causes[0].sentence}")
            robots[path.name], rows[path.name] = cell.robot, some
        except PisigmaError as problem:  # a fault of one cell does not stop other cells
            refused[path.name] = str(problem)
    if len(rows) < MIN_ROBOTS and refused:
        raise FleetError(
            f"expected at least {MIN_ROBOTS} robots with usable rows, got {len(rows)}; the first refused cell: "
            f"{next(iter(refused.values()))}",
            value=len(rows),
        )
    nominal = _common_robot(robots)
    remarks = tuple(f"Robot '{one}': {said}" for one in rows for said in row_warnings(nominal, rows[one]))
    wide = nominal
    for some in rows.values():
        wide = with_limits_of_rows(wide, some)
    name = Path(folder).resolve().name
    prior = fleet_prior(name, wide, list(rows.values()))
    summary = summarise_prior(prior, list(rows)).with_figures(
        command=f"pisigma.estimate_fleet_prior({name!r})", refused=refused, remarks=remarks
    )
    model = replace(prior.model, metrics=summary.to_json())
    return FleetPriorResult(model, prior, summary, time.perf_counter() - started)


def _common_robot(robots: Mapping[str, Robot]) -> Robot:
    """Return the nominal robot that all robots share.

    Raises:
        FleetError: there are several nominal robots.
    """
    (name, first), *others = robots.items()
    for other_name, other in others:
        if other.dh.shape != first.dh.shape or not np.array_equal(other.dh, first.dh):
            raise FleetError(
                f"expected robots of one type, got '{name}' ({first.name}) and '{other_name}' ({other.name})",
                value=other_name,
                remedy="put the cells of each type into a folder of their own",
            )
    return first
