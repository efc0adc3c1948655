"""Estimate the prior of a fleet of robots, as a model from which calibrations with few rows start."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pisigma.estimation.population import MIN_ROBOTS
from pisigma.files.errors import FleetError, MeasurementError, RobotError
from pisigma.files.progress import Progress
from pisigma.lifetime.fleet.members import Member, read_fleet
from pisigma.lifetime.fleet.prior import FleetPrior, fleet_prior
from pisigma.lifetime.fleet.prior_summary import FleetPriorSummary, summarise_prior
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joint_range import row_warnings, with_limits_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.derived_cards import write_fleet_prior_card
from pisigma.robot.description import Robot
from pisigma.validation.checks.setup_fault import setup_diagnostics
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
    source: str | os.PathLike[str],
    robot: str | None = None,
    progress: Progress = lambda what: None,
) -> FleetPriorResult:
    """Estimate means and covariances of the errors of robots of one type from the first session of each.

    Args:
        source: manifest (CSV) or folder; see `pisigma.lifetime.fleet.members.read_fleet`.
        robot: nominal robot of those robots that do not state one.
        progress: called with the current step.

    Raises:
        FleetError: the fleet cannot be used, its robots are of several types, or too few have readable files. Single
            unreadable files are listed in the figures.
        IdentificationError: the rows of a robot do not determine its base.
    """
    started = time.perf_counter()
    members = read_fleet(source, robot)
    robots, refused = _robots(members)
    readable = [one for one in members if one.id in robots]
    nominal = _common_robot(robots)
    progress(f"{len(members)} robots")
    rows: dict[str, Measurements] = {}
    for one in readable:
        try:
            some = read_rows(one.sessions[0].data, nominal, one.cameras).split_sets()[0]
        except MeasurementError as problem:  # one bad file does not stop the others
            refused[one.id] = str(problem)
            continue
        causes = [cause for cause in setup_diagnostics(nominal, some) if cause.severity == "implausible"]
        if causes:  # a wrong unit would count as a large scatter between robots
            refused[one.id] = f"{some.source}: {causes[0].sentence}"
        else:
            rows[one.id] = some
    if refused and len(rows) < MIN_ROBOTS:
        raise FleetError(
            f"expected {MIN_ROBOTS} robots or more, got {len(rows)} with readable files; the first refused file: "
            f"{next(iter(refused.values()))}",
            value=len(rows),
        )
    remarks = tuple(f"Robot '{one}': {said}" for one in rows for said in row_warnings(nominal, rows[one]))
    wide = nominal
    for some in rows.values():
        wide = with_limits_of_rows(wide, some)
    prior = fleet_prior(Path(source).resolve().stem, wide, list(rows.values()))
    summary = summarise_prior(prior, list(rows)).with_figures(
        command=f"pisigma.estimate_fleet_prior({Path(source).name!r})", refused=refused, remarks=remarks
    )
    model = replace(prior.model, metrics=summary.to_json())
    return FleetPriorResult(model, prior, summary, time.perf_counter() - started)


def _robots(members: tuple[Member, ...]) -> tuple[dict[str, Robot], dict[str, str]]:
    """Return the nominal robots by their ids, and why others cannot be read.

    Raises:
        FleetError: none can be read.
    """
    robots: dict[str, Robot] = {}
    refused: dict[str, str] = {}
    for member in members:
        try:
            if member.fault:
                raise FleetError(member.fault)
            robots[member.id] = Robot.load(member.robot)
        except (FleetError, RobotError) as problem:  # one bad file does not stop the others
            refused[member.id] = str(problem)
    if not robots:
        raise FleetError(f"no description of a robot can be read: {next(iter(refused.values()))}")
    return robots, refused


def _common_robot(robots: Mapping[str, Robot]) -> Robot:
    """Return the nominal robot that all robots share.

    Raises:
        FleetError: there are several.
    """
    (name, first), *others = robots.items()
    for other_name, other in others:
        if other.dh.shape != first.dh.shape or not np.array_equal(other.dh, first.dh):
            raise FleetError(
                f"expected robots of one type, got '{name}' ({first.name}) and '{other_name}' ({other.name})",
                value=other_name,
                remedy="give a manifest of the robots of one type only",
            )
    return first
