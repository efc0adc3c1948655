"""`pisigma report CELL`: the page and the JSON have what the acceptance needs."""

import json

import pytest
from testing.cell_before import MODEL, cell_of_schema_1
from testing.models import no_type_checker


@pytest.fixture(scope="module", autouse=True)
def quick_pictures(blank_pictures):
    with no_type_checker():
        yield


def test_errors_that_the_budget_does_not_explain_end_with_3(run, tmp_path):
    cell, page = cell_of_schema_1(tmp_path), tmp_path / "report.html"
    with (cell / "cell.yaml").open("a", encoding="utf-8") as file:
        file.write(
            "\ninstrument: {name: Tracker <b>7</b>, expanded_uncertainty_mm: 0.03, coverage_factor: 2}\n"
        )
    run("event", cell, "accepted", "--by", "Ada <i>", "--note", "on site")
    done = run("report", cell, "--out", page, "--json")
    assert done.exit_code == 3, done.output
    found = json.loads(done.stdout)["acceptance"]
    assert found["contradicted"]
    assert [(one["person"], one["model"]) for one in found["accepted"]] == [("Ada <i>", MODEL)]
    assert len(found["budget"]["components"]) == 3
    text = page.read_text(encoding="utf-8")
    assert 'id="acceptance"' in text
    assert all(
        name in text.partition("By ISO 9283")[2]
        for name in ("accuracy AP", "repeatability RP", "accuracy AT")
    )
    assert "Ada &lt;i&gt;" in text
    assert "<b>7</b>" not in text
    screen = run("report", cell, "--out", page)
    assert screen.exit_code == 3
    assert "Trust: no: the measured errors" in screen.stdout


def test_a_cell_whose_errors_are_explained_ends_with_0(run, tmp_path):
    cell = cell_of_schema_1(tmp_path)
    run("session", cell, "2026-08-01", "--set-aside", "joint 3 had slipped")
    done = run("report", cell)
    assert done.exit_code == 0, done.output
    (page,) = (cell / "reports").iterdir()
    assert page.suffix == ".html"
