"""A cell that was calibrated and verified, with files that were exported from its model."""

import shutil
from dataclasses import replace

import pytest
from testing.cell_rows import day, measured
from testing.hybrid import few_choices
from testing.models import no_type_checker
from testing.pictures import no_pictures

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.exports import export_from_cell


@pytest.fixture(scope="package")
def used(tmp_path_factory):
    """A cell with a model in use; files that were exported from it are next to its folder."""
    folder = tmp_path_factory.mktemp("cells")
    cell = Cell.create(folder / "cell", "ur10")
    with no_type_checker(), no_pictures(), few_choices():
        cell.add_session(measured(60, 1), day=day(60))
        cell.calibrate(folds=0)
        cell.add_session(measured(12, 2), day=day(30))
        cell.verify()
        for form, name in (("dh", "dh.csv"), ("offsets", "offsets.csv")):
            export_from_cell(cell, form, ExportRequest(cell.folder, folder / name))
    cell.history.add(*(replace(one, exported=f"{day(25)}T08:00:00+00:00") for one in cell.history.exports()))
    return cell


@pytest.fixture
def cell(used, tmp_path):
    """A copy of the cell; its exports are next to the original."""
    shutil.copytree(used.folder, tmp_path / "cell")
    return Cell.open(tmp_path / "cell")


@pytest.fixture(scope="module")
def quick_pictures(blank_pictures):
    with no_type_checker():
        yield
