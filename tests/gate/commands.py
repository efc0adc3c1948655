"""Every command that reads rows, called in this process: its exit status, and its diagnostics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from testing.aged import original_model
from testing.measured_plans import measured_plan
from testing.models import no_type_checker

from pisigma.files.errors import AcceptanceError, PisigmaError
from pisigma.lifetime.cell.step import ATTENTION
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import save_model
from pisigma.planning.plan_settings import PlanSettings
from pisigma.robot import Robot
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.new_cell import NewCell, cell_from_model
from pisigma.workflow.compare import compare
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.fleet.run import advance_cell
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.monitor import monitor
from pisigma.workflow.plan import plan
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.report import report
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.verify import verify

ROBOT = "rb5"


@dataclass(frozen=True)
class Answer:
    """Result of a command: exit status 0, 2 or 3, and the reason."""

    status: int
    said: str = ""


Command = Callable[[Measurements, Path], Answer]


def _of(trusted: bool, sentences: object) -> Answer:
    return Answer(0 if trusted else 3, str(sentences))


def _calibrate(rows: Measurements, folder: Path) -> Answer:
    done = calibrate(ROBOT, rows, CalibrationSettings(model="geometric", folds=0))
    return _of(done.trusted, [one.sentence for one in done.diagnostics])


def _recalibrate(rows: Measurements, folder: Path) -> Answer:
    done = recalibrate(original_model(), rows)
    return _of(done.trusted, [one.sentence for one in done.diagnostics])


def _monitor(rows: Measurements, folder: Path) -> Answer:
    done = monitor(original_model(), [rows])
    return _of(not done.untrusted_sessions, [one.sentence for one in done.untrusted_sessions])


def _compare(rows: Measurements, folder: Path) -> Answer:
    done = compare(original_model(), "nominal", rows)
    return _of(not done.diagnostics, [one.sentence for one in done.diagnostics])


def _verify(rows: Measurements, folder: Path) -> Answer:
    done = verify(original_model(), rows)
    return _of(done.verdict in ("better", "undecided", "not_better"), done.sentence)


def _evaluate(rows: Measurements, folder: Path) -> Answer:
    done = evaluate(original_model(), rows)
    return _of(done.accepted, [one.sentence for one in done.diagnostics])


def _report(rows: Measurements, folder: Path) -> Answer:
    done = report(model_folder(folder), rows)
    return _of(not done.diagnostics, [one.sentence for one in done.diagnostics])


def _plan(rows: Measurements, folder: Path) -> Answer:
    rows.write_csv(folder / "measured.csv", Robot.load(ROBOT))
    plan(model_folder(folder), PlanSettings(count=6, candidates=40, measured=folder / "measured.csv"))
    return Answer(0)


def _measure(rows: Measurements, folder: Path) -> Answer:
    measured_plan(ROBOT).stored.write(folder / "plan.csv")
    document = folder / "plan.plan.yaml"
    document.write_text(f"{document.read_text()}\nmodel: {model_folder(folder).name}\n")
    session = MeasuringSession.read(folder / "plan.csv")
    session.add(rows)
    session.check_setup()
    state = session.state
    return _of(state.advice.action != "correct", state.advice.sentence)


def _advance(rows: Measurements, folder: Path) -> Answer:
    cell_from_model(model_folder(folder), NewCell("")).write(folder / "cell")
    rows.write_csv(folder / "cell" / "sessions" / "s1.csv", Robot.load(ROBOT))
    try:
        step = advance_cell(Cell.open(folder / "cell")).step
    except AcceptanceError as refusal:
        return Answer(3, str(refusal))
    return _of(step.state not in ATTENTION, step.reason)


def model_folder(folder: Path) -> Path:
    """Write the model that rows are added to, unless it exists."""
    path = folder / "model"
    if not path.exists():
        path.mkdir()
        save_model(original_model(), path)
    return path


COMMANDS: Mapping[str, Command] = {
    "calibrate": _calibrate,
    "recalibrate": _recalibrate,
    "monitor": _monitor,
    "compare": _compare,
    "verify": _verify,
    "evaluate": _evaluate,
    "report": _report,
    "plan --measured": _plan,
    "measure": _measure,
    "fleet run": _advance,
}


def answer(command: str, rows: Measurements, folder: Path) -> Answer:
    """Run a command; a refusal is status 2."""
    torch.manual_seed(0)
    try:
        with no_type_checker():
            return COMMANDS[command](rows, folder)
    except PisigmaError as refusal:
        return Answer(2, str(refusal))
