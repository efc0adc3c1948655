"""Forms of the page in headless Chromium: the commands that they show, and texts that people edit at the same time."""

import shlex

import pytest
import typer.main
from testing.cell_rows import day, measured
from testing.models import no_type_checker
from testing.workbench_page import opened, show, upload_file

pytest.importorskip("viser", reason="the extra view is not installed")

from pisigma.cli.main import app
from pisigma.workbench.tabs import TABS
from pisigma.workbench.workbench import Workbench
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.cell_file import CellFile

FILL = """(form, last) => { for (const one of form.elements) {
  if (one.type === "checkbox") one.checked = true;
  else if (one.tagName === "SELECT") one.selectedIndex = Math.min(last ? 99 : 1, one.options.length - 1);
  else if (one.type === "date") one.value = "2026-11-01";
  else if (one.tagName === "INPUT" && one.type !== "file" && one.type !== "hidden") one.value = "1";
  one.dispatchEvent(new Event("input", { bubbles: true }));
} return form.querySelector(".command code").textContent; }"""


@pytest.fixture
def cell(tmp_path, blank_pictures):
    """A cell with a space in its path, a session, one that was set aside, and a plan."""
    made = Cell.create(tmp_path / "my cell", "ur10", limit_mm=0.5)
    for number, ago in enumerate((20, 10)):
        made.add_session(measured(20, number), day=day(ago))
    made.sessions.set_aside(day(10), "loose reflector")
    made.plan(count=4, check=0, candidates=50)
    return made


@pytest.fixture
def bench(cell):
    with no_type_checker(), Workbench(cell.folder, port=0) as started:
        yield started


def test_every_command_that_a_form_shows_can_be_read(browser, bench, tmp_path, cell):
    commands = typer.main.get_command(app).commands
    (tmp_path / "a b; c.csv").write_text("P,A1,A2,A3,A4,A5,A6,X,Y,Z\n1,1,2,3,4,5,6,1000,20,30\n")
    shown, every = {}, []
    with opened(browser, bench.url) as page:
        for tab in TABS:
            show(page, tab)
            if tab == "measure":
                upload_file(page, tmp_path / "a b; c.csv")
            for form in page.query_selector_all("form[data-command]:not([data-fixed])"):
                for last in (False, True):
                    line = form.evaluate(FILL, last)
                    program, step, *words = shlex.split(line)
                    assert program == "pisigma"
                    commands[step].make_context(step, [*words])
                    shown.setdefault((step, last), words)
                    every.append([step, *words])
    assert {step for step, _ in shown} >= {
        "plan",
        "calibrate",
        "verify",
        "monitor",
        "import",
        "measure",
        "export",
    }
    set_aside = f"{cell.folder}/sessions/{day(10)}.csv"
    assert [
        "import",
        "--accept-implausible",
        set_aside,
        "--cell",
        str(cell.folder),
        "--date",
        day(10),
    ] in every
    assert "fit_frame=false" in shown["verify", True]
    assert "fit_frame=true" in shown["verify", False]
    assert shown["measure", True][-1] == f"{cell.folder}/sessions/{day(20)}.csv"
    words = shown["import", True]
    assert words[0] == "a b; c.csv"
    assert words[words.index("--map") + 1].startswith("P=1,A1=1,")
    assert words[words.index("--cell") + 1] == str(cell.folder)


def test_a_text_is_kept_until_it_is_saved_and_no_other_is_replaced(browser, bench, cell):
    from playwright.sync_api import expect

    text = cell.file.path.read_text()
    changed = text.replace("limit_mm: 0.5", "limit_mm: 0.25")
    with opened(browser, bench.url) as first, opened(browser, bench.url) as second:
        for page in (first, second):
            show(page, "cell")
            page.click("summary >> text=Edit as text")
        first.fill("[name=text]", "limit_mm: 'wrong")
        press(first, bench)
        assert first.query_selector(".refusal") is not None
        assert first.input_value("[name=text]") == "limit_mm: 'wrong"
        expect(first.locator("form[data-name=text] button[type=submit]")).to_be_focused()
        second.fill("[name=text]", f"{text}\n# of the second\n")
        first.fill("[name=text]", changed)
        second.fill("[name=limit_mm]", "0.75")
        show(second, "plan")
        second.fill("[name=count]", "17")
        show(second, "cell")
        press(first, bench)
        assert first.query_selector(".refusal") is None
        assert first.input_value("[name=text]") == changed
        press(second, bench)
        assert "changed since" in second.inner_text(".refusal")
        assert second.input_value("[name=text]").endswith("# of the second\n")
        assert cell.file.path.read_text() == changed
        assert second.input_value("[name=limit_mm]") == "0.75"
        second.press("form[data-name=text] [data-discard]", "Enter")
        expect(second.locator("[name=limit_mm]")).to_have_value("0.25")
        assert second.input_value("[name=text]") == changed
        show(second, "plan")
        assert second.input_value("[name=count]") == "17"
        press(first, bench)
        assert first.query_selector(".refusal") is None
    assert CellFile.read(cell.folder).document.limit_mm == 0.25


def press(page, bench):
    """Save the text, and wait for the end of the step."""
    before = bench.jobs.ended
    page.press("form[data-name=text] button[type=submit]", "Enter")
    page.wait_for_selector(f"body[data-ended='{before + 1}']")
