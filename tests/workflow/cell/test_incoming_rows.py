"""Files on their way into a cell: setup faults are named, and the settings that correct them give the same rows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.cell_rows import measured
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.files.errors import AcceptanceError
from pisigma.measurement.dataset import Measurements
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.incoming_rows import IncomingRows
from pisigma.workflow.settings.importing import ImportSettings

NAMES = tuple(f"q{joint}_deg" for joint in range(1, 7))
MOVED_LINE = 17


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Cell:
    return Cell.create(tmp_path_factory.mktemp("cells") / "cell", "ur10")


def written(path: Path, rows: Measurements, names: tuple[str, ...]) -> Path:
    """Write rows under some names of the columns."""
    values = np.concatenate([np.rad2deg(rows.q.numpy()), 1e3 * rows.position.numpy()], 1)
    np.savetxt(path, values, delimiter=",", header=",".join(names), comments="", fmt="%.17g")
    return path


def mistaken(mistake: str) -> tuple[Measurements, dict[str, object]]:
    """Rows with a mistake, and the values of the finding that name it."""
    rows = measured(30, 0)
    match mistake:
        case "inches":
            return replace(rows, position=rows.position / 25.4), {"ratio": 25.4}
        case "sign":
            signs = torch.tensor([1, 1, 1, -1, 1, 1])
            return replace(rows, q=rows.q * signs), {"columns": (1, 2, 3, -4, 5, 6)}
        case "order":
            return replace(rows, q=rows.q[:, [0, 1, 4, 3, 2, 5]]), {"columns": (1, 2, 5, 4, 3, 6)}
    is_moved = torch.arange(30)[:, None] >= MOVED_LINE - 2
    return replace(rows, position=rows.position + is_moved * torch.tensor([0.4, 0.3, 0.1])), {
        "first_line": MOVED_LINE
    }


@pytest.mark.parametrize(
    ("mistake", "headings"),
    [
        ("inches", "x_mm y_mm z_mm"),
        ("inches", "X Y Z"),
        ("sign", "X Y Z"),
        ("order", "x_mm y_mm z_mm"),
        ("moved", "X Y Z"),
    ],
)
def test_a_mistake_is_named_and_the_settings_that_correct_it(cell, tmp_path, mistake, headings):
    rows, named = mistaken(mistake)
    file = written(tmp_path / "rows.csv", rows, (*NAMES, *headings.split()))
    with no_type_checker():
        incoming = IncomingRows((file,), cell, ImportSettings(units="mm" if headings == "X Y Z" else ""))
        (finding, *_) = incoming.check()
        assert finding.severity == "implausible"
        ((name, value),) = named.items()
        assert finding.values[name] == (pytest.approx(value) if name == "ratio" else value)
        repair = incoming.repair(finding)
        with pytest.raises(AcceptanceError) as refusal:
            incoming.add()
        assert repair.options in refusal.value.remedy
        corrected = IncomingRows((file,), cell, repair.settings).imported_rows.measurements
    right = rows if mistake == "moved" else measured(30, 0)
    assert_close(corrected.q, right.q, atol=1e-12)
    assert_close(corrected.position, right.position, atol=1e-12)
    assert len(set(corrected.frame)) == (2 if mistake == "moved" else 1)


def test_the_session_records_how_its_rows_were_read(cell, tmp_path):
    file = written(tmp_path / "rows.csv", mistaken("sign")[0], (*NAMES, "x_mm", "y_mm", "z_mm"))
    with no_type_checker():
        incoming = IncomingRows((file,), cell, ImportSettings(maps=({"q4_deg": "-q4_deg"},)))
        entry = incoming.add()
    assert "--map q4_deg=-q4_deg" in entry.remark
