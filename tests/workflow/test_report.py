"""`pisigma.report`: the command's outputs in one call."""

import json

import pytest
from testing.refusals import refused
from testing.report import geometric_under_test, measured

import pisigma
from pisigma.files.errors import MeasurementError, OutputError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import save_model

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model folder and rows to evaluate it on."""
    path = tmp_path_factory.mktemp("report")
    arm, model = geometric_under_test()
    (path / "plain").mkdir()
    save_model(model, path / "plain")
    measured(arm, 30, seed=9).write_csv(path / "rows.csv", model.robot)
    return path


def test_a_report_is_written_with_its_figures(folder, tmp_path):
    steps = []
    report = pisigma.report(folder / "plain", folder / "rows.csv", steps.append)
    assert len(steps) == 2
    assert report.verdict in json.dumps(report.to_json(), ensure_ascii=False)
    written = report.save(tmp_path / "page.html", tmp_path / "figures")
    assert len(written) == 3 * len(report.figures.all)  # PNG, SVG and CSV
    assert report.verdict.split(";")[0] in (tmp_path / "page.html").read_text()
    with refused(OutputError, file="page.pdf"):
        report.save(tmp_path / "page.pdf")


def test_rows_without_measurements_are_refused(folder):
    q = geometric_under_test()[1].starts[:5]
    with pytest.raises(MeasurementError):
        pisigma.report(folder / "plain", Measurements(q=q))
