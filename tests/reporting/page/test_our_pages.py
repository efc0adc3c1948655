"""All pages, made once: no NaN, nothing from elsewhere, accessible, and as wide as a phone."""

import csv
import io
import re
from collections import Counter
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from testing.aged import original_model, rows_after_change
from testing.cell_models import cell_of_two_models
from testing.compared import after_collision
from testing.hybrid import few_choices, few_robots
from testing.models import no_type_checker
from testing.report import folder_with_held_out, hybrid_under_test

from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.reporting.page.content import report_content
from pisigma.reporting.page.drawing import csv_of
from pisigma.reporting.page.figures import draw_figures, draw_map
from pisigma.reporting.page.lifetime import fleet_page
from pisigma.reporting.page.page import render_page
from pisigma.validation.report.error_map import Layer
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.compare import compare
from pisigma.workflow.monitor import monitor

NAMES = ("report", "monitoring", "comparison", "fleet")
DAYS = {"2026-01-10": 9, "2026-02-10": 8, "2026-03-10": 3}
"""Rows by day; the last ones do not determine every joint."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The folder of the pages."""
    folder = tmp_path_factory.mktemp("pages")
    with no_type_checker(), few_choices(), few_robots():
        arm, model = hybrid_under_test()
        content = report_content(folder_with_held_out(arm, model, folder / "arm"), folder / "arm")
        (folder / "report.html").write_text(render_page(content, draw_figures(content)), encoding="utf-8")
        sessions = [
            replace(rows_after_change(count, 30 + count), date=(day,) * count) for day, count in DAYS.items()
        ]
        metres = replace(sessions[1], position=sessions[1].position * 1e-3)
        monitor(original_model(), [*sessions, metres]).save_page(folder / "monitoring.html")
        compare(original_model(), after_collision()).save_page(folder / "comparison.html")
        cell_of_two_models(folder / "cells" / "a")
        Cell.create(folder / "cells" / "new", "ur5")
        (folder / "cells" / "broken").mkdir()
        (folder / "cells" / "broken" / "cell.yaml").write_text("robot: [\n")
        status = FleetStatus.read(folder / "cells")
        (folder / "fleet.html").write_text(fleet_page(status, folder), encoding="utf-8")
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_pages_have_no_nan_and_load_nothing(name, pages):
    text = (pages / f"{name}.html").read_text(encoding="utf-8")
    shown = re.sub("<[^>]*>", " ", re.sub("<(script|style).*?</\\1>", "", text, flags=re.DOTALL))
    assert re.findall(r".{20}\b(?:nan|inf|None)\b", shown) == []
    assert name != "monitoring" or "unobservable" in shown
    addresses = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert [one for one in addresses if re.match(r"\w+:|//", one) and not one.startswith("data:")] == []
    assert not re.search(r"@import|url\((?!data:)", text)


def test_the_fleet_links_models_and_colours_states(pages):
    text = (pages / "fleet.html").read_text(encoding="utf-8")
    (link,) = re.findall('<a href="(cells[^"]*)">kiro4</a>', text)
    assert (pages / link).is_file()
    assert '<span class="badge bad">unreadable</span>' in text


@pytest.mark.parametrize("name", NAMES)
def test_pages_are_accessible_and_fit_a_phone(name, pages, browser):
    axe = pytest.importorskip("axe_playwright_python", reason="axe is not installed")
    script = resources.files(axe).joinpath("axe.min.js").read_text(encoding="utf-8")
    page, faults = browser.new_page(viewport={"width": 390, "height": 900}, color_scheme="dark"), []
    page.on("console", lambda one: faults.append(one.text) if one.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto((pages / f"{name}.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.evaluate(script)
    for scheme, options in (("dark", {}), ("light", {"runOnly": ["color-contrast"]})):
        page.emulate_media(color_scheme=scheme)
        found = page.evaluate("(options) => axe.run(options)", options | {"resultTypes": ["violations"]})
        assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found["violations"]] == []
    shown = "[...document.querySelectorAll('table:not(.legend, .point table), figure')]"
    assert page.evaluate(f"{shown}.every(one => one.closest('.data, figure').querySelector('.copies'))")
    with page.expect_download() as started:
        page.locator("[data-csv]").first.click()
    assert len(Path(started.value.path()).read_text(encoding="utf-8").splitlines()) > 2
    assert faults == []
    page.close()


def test_the_values_of_a_figure_are_those_drawn():
    axes = (figure := Figure()).add_subplot()
    axes.set(xlabel="q [deg]", ylabel="error [mm]")
    axes.plot([1.0, 2.0, 3.0], [0.1, float("nan"), 0.3], label="RMS")
    axes.axhline(0.2)
    axes.stairs([5.0], [0.0, 2.0], baseline=None, label="_bins")
    assert csv_of(figure).splitlines() == [
        "series,q [deg],error [mm],q [deg] from,to",
        "RMS,1,0.1,,",
        "RMS,3,0.3,,",
        "bins,,5,0,2",
    ]


def test_every_value_of_a_map_has_its_quantity_and_unit():
    layers = [Layer("before", "mm", np.arange(1.0, 9002.0)), Layer("after_deg", "deg", np.arange(2.0))]
    layers[1] = replace(layers[1], values=np.resize([7.0, np.nan], 9001))
    drawn = csv_of(draw_map("map", "map", "Errors", np.zeros((9001, 3)), layers).figure)
    series = Counter(row["series"] for row in csv.DictReader(io.StringIO(drawn)))
    assert series == {
        "before (nominal) [mm] (3000 of 9001, largest included)": 6000,
        "orientation, after [deg] (2251 of 4501, largest included)": 4502,
    }
