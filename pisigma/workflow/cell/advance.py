"""Carry out the steps of a cell that its status names, until rows have to be measured or a person has to decide."""

import shlex
from dataclasses import replace
from pathlib import Path

from pisigma.files.progress import Progress
from pisigma.lifetime.cell.facts import facts_of
from pisigma.lifetime.cell.status import CellStatus, next_step, status_of
from pisigma.workflow.cell.cell import Cell


def advance_cell(cell: Cell, prior: Path | None = None, progress: Progress = lambda what: None) -> CellStatus:
    """Calibrate, verify, monitor and recalibrate a cell as its status says, for every new session in turn.

    New files in `sessions/` are added one by one in the order of their dates, each after all steps that the earlier
    ones make possible: a model of the first session is verified with the second, and monitored with the third. A cell
    whose status names no such step is not changed.

    Args:
        cell: the cell.
        prior: model folder of `pisigma fleet prior` to start calibrations from; None: calibrate from scratch.
        progress: called with the name of each step.

    Returns:
        The status afterwards.

    Raises:
        PisigmaError: the rows of a session cannot be used, or a step refuses them.
    """
    cell.sessions.one_by_one = True
    done: set[str] = set()
    while True:
        step = next_step(replace(facts_of(cell.folder), not_taken_in=()))
        if step.verb is not None and step.command not in done:
            done.add(step.command)
            progress(step.verb)
            _take(cell, step.verb, shlex.split(step.command)[3:], prior)
        elif not cell.sessions.add_next_file():
            return status_of(cell.folder)
        else:
            done.clear()


def _take(cell: Cell, verb: str, options: list[str], prior: Path | None) -> None:
    """Carry out a step."""
    if verb == "verify":
        cell.verify(model=options[1] if options else None)
    elif verb == "calibrate":
        cell.calibrate(prior=prior)
    elif verb == "monitor":
        cell.monitor()
    else:
        cell.recalibrate()
