"""The bad files of `fleet_kills.py` among two good ones, without its kills."""

from hostile.fleet_kills import BAD, faults_of, write_plant
from testing.models import no_type_checker

from pisigma.files.errors import PisigmaError
from pisigma.lifetime.cell.layout import cells_in
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.fleet.run import advance_cell


def test_every_bad_file_is_named_with_its_reason(tmp_path):
    refused = write_plant(tmp_path, tmp_path / "cells", len(BAD) + 2)
    with no_type_checker():
        for folder in cells_in(tmp_path / "cells"):
            try:
                advance_cell(Cell.open(folder))
            except PisigmaError as problem:
                refused[folder.name] = str(problem)
    assert not faults_of(refused)
