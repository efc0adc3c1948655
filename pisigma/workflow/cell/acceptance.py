"""Collect the statements on which the acceptance of a cell's robot is based."""

from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, PisigmaError, Place
from pisigma.lifetime.cell.acceptance import Acceptance, MeasuredAccuracy, missing_statements
from pisigma.lifetime.cell.history import ModelEntry, SessionEntry
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.model.folder.model_folder import load_model
from pisigma.validation.iso9283.repeats import repeated_poses
from pisigma.validation.uncertainty.components import uncertainty_budget
from pisigma.validation.uncertainty.instrument import Instrument
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.setup_names import RowsWithModelNames
from pisigma.workflow.evaluate import evaluate

_JUDGED = frozenset(("position", "rotation", "pose", "corner"))
"""Kinds of readings that yield positions."""
_NO_SESSION = "no independent session has been measured since the calibration of the model."


def acceptance_of(cell: Cell) -> Acceptance:
    """Collect instrument, uncertainty budget, measured figures and acceptances of the model in use.

    Measured figures and poses of the budget are from the newest valid session to which the model was not fitted;
    if there is none, the budget is for the poses of the calibration.

    Args:
        cell: cell to read; nothing is added to it.

    Raises:
        ModelError: no model is in use.
        MeasurementError: the file of a session was changed, or there is no session of the model.
    """
    model = load_model(folder := cell.model_folder())
    entry = cell.history.model(folder.name)
    document = cell.file.document
    facts, made_of = cell.status().facts, entry.made_of
    sessions, later = facts.valid_sessions, facts.new_sessions(entry)
    known = later or [one for one in cell.history.sessions() if one.name in made_of[-1:]]
    if not known:  # the model was made outside the cell
        remedy = "import rows that were measured with it"
        raise MeasurementError(
            f"the cell has no session of model '{entry.name}'", at=Place(cell.folder), remedy=remedy
        )
    new = known[-1]
    seen = cell.sessions.rows_with_model_names(entry, cell.sessions.rows_of_file(new), new.day)
    measured, problem = _measured(cell, entry, new, seen) if later else (None, _NO_SESSION)
    instrument = document.instrument or Instrument()
    repeats = tuple(
        pose
        for one in sessions
        for pose in repeated_poses(*_attained(cell, model, one, seen if one == new else None))
    )
    temperatures = {
        one.name: one.temperature_c
        for one in cell.history.sessions()
        if one in sessions or one.name in made_of
    }
    budget = uncertainty_budget(
        model,
        seen.rows,
        f"session {new.name}",
        instrument,
        temperatures,
        made_of,
        document.expansion_per_k,
        document.pose_repeatability_mm,
    )
    return Acceptance(
        model=entry.name,
        limit_mm=document.limit_mm,
        instrument=instrument,
        repeatability_mm=document.pose_repeatability_mm,
        temperatures=temperatures,
        budget=budget,
        measured=measured,
        repeats=repeats,
        acceptance_events=tuple(one for one in cell.history.events() if one.kind == "accepted"),
        missing_statements=missing_statements(instrument, document.pose_repeatability_mm, problem, repeats),
    )


def _measured(
    cell: Cell, entry: ModelEntry, session: SessionEntry, seen: RowsWithModelNames
) -> tuple[MeasuredAccuracy | None, str]:
    """Evaluate the model on a session; return the reason if this is not possible."""
    if others := seen.rows.kinds - _JUDGED:
        return None, f"session {session.name} has readings without a position ({', '.join(sorted(others))})."
    settings = seen.settings_to_fit(cell.file.settings_of_step("evaluate"))
    try:
        found = evaluate(cell.model_folder(entry.name), seen.rows, settings)
    except PisigmaError as problem:
        return None, str(problem)
    errors = found.comparison.models[-1].position
    doubt = "" if not found.diagnostics else found.diagnostics[0].sentence
    return MeasuredAccuracy(session.name, session.day, found.rows, seen.changed_frames, errors, doubt), ""


def _attained(
    cell: Cell, model: CalibratedModel, session: SessionEntry, seen: RowsWithModelNames | None
) -> tuple[Measurements, Float64[Tensor, "rows 3"] | None]:
    """Return the rows of a session and the commanded positions; None if the frames may have changed."""
    if seen is None or seen.changed_frames:
        return cell.sessions.rows_of_file(session), None
    return seen.rows, poses_of_rows(model, seen.rows)[:, :3, 3]
