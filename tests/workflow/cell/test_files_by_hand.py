"""Files that were put into the folder of sessions by hand: every command that reads rows adds them or names them."""

import pytest
from testing.cell_rows import ROBOT, day, measured
from testing.refusals import refused

from pisigma.files.errors import AcceptanceError, MeasurementError, PisigmaError

pytestmark = pytest.mark.usefixtures("quick_pictures")

COMMANDS = {
    "calibrate": lambda cell: cell.calibrate(model="geometric", folds=0),
    "verify": lambda cell: cell.verify(),
    "monitor": lambda cell: cell.monitor(),
    "recalibrate": lambda cell: cell.recalibrate(),
    "evaluate": lambda cell: cell.evaluate(),
}


@pytest.mark.parametrize(
    ("command", "scale", "error"),
    [("verify", 1 / 25.4, AcceptanceError), *((name, None, MeasurementError) for name in COMMANDS)],
)
def test_every_command_adds_a_file_and_names_one_that_is_refused_and_leaves_it(command, scale, error, cell):
    good, path = (cell.folder / "sessions" / f"{day(ago)}.csv" for ago in (6, 5))
    measured(12, 3).write_csv(good, ROBOT)
    assert (cell.status().step.state, cell.status().to_json()["not_taken_in"]) == (
        "not_taken_in",
        [good.name],
    )
    if scale is None:
        path.write_text("q1_deg\nx\n")
    else:
        measured(12, 4, scale=scale).write_csv(path, ROBOT)
    content = path.read_bytes()
    with refused(error, file=path.name):
        COMMANDS[command](cell)
    assert (path.read_bytes(), cell.history.sessions()[-1].name) == (content, good.stem)
    assert cell.status().to_json()["not_taken_in"] == [path.name]
    step = cell.status().step
    assert step.state == "file_refused"
    if step.command.split()[1] == "import":  # of another format: its columns have to be confirmed
        assert step.command.split()[2] == str(path)
    else:
        assert step.command.split()[1:] == ["session", str(cell.folder), day(5), "--set-aside", "refused"]
    cell.sessions.set_aside(day(5), "refused")
    assert (path.read_bytes(), cell.status().step.state) == (content, "session_not_judged")
    with pytest.raises(PisigmaError):
        cell.sessions.set_aside("2026-01-01", "there is no such file")


def test_other_files_are_named_and_do_not_stop_a_command(cell):
    (cell.folder / "sessions" / "notes.txt").write_text("the floor was wet")
    assert cell.status().to_json()["not_read"] == ["notes.txt"]
    assert cell.status().step.state == "up_to_date"
    cell.sessions.set_aside("notes.txt", "notes")
    assert cell.status().to_json()["not_read"] == []
