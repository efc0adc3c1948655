"""Calibrate a base, a tool or a hand-eye transform of a cell with its newest session."""

from functools import partial

from pisigma.calibration.frames.frame_fit import FrameChoice
from pisigma.lifetime.cell.history import Check, ModelEntry, now
from pisigma.lifetime.cell.layout import MODELS
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.model_choice import model_entry
from pisigma.workflow.cell.new_files import save_new
from pisigma.workflow.frames.calibrate_frame import FrameCalibration, calibrate_frame


def calibrate_frame_of_cell(
    cell: Cell, only: FrameChoice, accept_implausible: bool = False
) -> tuple[FrameCalibration, ModelEntry | None]:
    """Calibrate base, tool or both with the newest session and the arm of the model in use, and store the model.

    If no model is in use, the newest model of the cell is used or, if there is none, its nominal robot. `verify` puts
    the new model into use.

    Args:
        cell: the cell.
        only: what to calibrate.
        accept_implausible: store the model even if it must not be trusted.

    Returns:
        The calibration and the entry of its model; the entry is None if an untrusted model was not stored.

    Raises:
        MeasurementError: there is no valid session, or none to which the model was not fitted.
        IdentificationError: the session has too few rows.
    """
    started = now()
    parent = cell.history.in_use or next(reversed(cell.history.models()), None)
    if parent is None:
        session = cell.sessions.valid_sessions()[-1]
        found = calibrate_frame(cell.robot, cell.sessions.rows_of([session]), only)
    else:
        cell.controller_warnings("calibrate", parent)
        session = cell.sessions.choose(parent, None)
        rows = cell.sessions.as_measured(session)
        seen = cell.sessions.rows_with_model_names(parent, rows, session.day)
        found = calibrate_frame(cell.model_folder(parent.name), seen.rows, only)
    doubt = "" if found.trusted else found.diagnostics[0].sentence
    if doubt and not accept_implausible:
        refused = ("calibrate", "", session.name, "not_trusted", doubt)
        cell.history.add(Check(*refused, None, False, started))
        return found, None
    taken = [one.name for one in cell.history.models()]
    save = partial(found.save, accept_implausible=accept_implausible)
    path = save_new(cell.folder / MODELS, save, taken)
    events = cell.history.events() if parent is None else ()
    remark = f"{only} calibrated with session '{session.name}'"
    entry = model_entry(events, started, path, [session], remark, found, parent)
    verdict = "accepted_implausible" if doubt else "trusted"
    check = Check("calibrate", entry.name, session.name, verdict, doubt or remark, None, False, started)
    cell.history.add(entry, check)
    return found, entry
