"""Use the page of a cell with clicks and keys alone: open it, show a tab, carry out a step and upload rows."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page
from typer.testing import CliRunner

from pisigma.cli.main import app
from pisigma.workbench.workbench import Workbench

WAIT = 300_000
"""Longest time to wait for the page [ms]."""


def measured(sim: Any, arm: str, rows: int, seed: int, path: Path) -> Path:
    """Write simulated rows of an arm."""
    true = sim.True_(arm, seed=3)
    q = true.sample(rows, seed)
    x, _ = true.measure(q, rng=np.random.default_rng(seed))
    sim.write_csv(path, true, q, x)
    return path


@contextlib.contextmanager
def opened(
    browser: Browser, folder: Path, scene: bool = False, rows: Path | None = None, hostile: bool = False
) -> Iterator[tuple[Page, Workbench, float]]:
    """Open the page of a folder; yield it, the server, and the time until it was shown [s]."""
    faults: list[str] = []
    with (
        Workbench(folder, port=0, growing=rows) as bench,
        contextlib.closing(browser.new_context(viewport={"width": 1280, "height": 800})) as context,
    ):
        page = context.new_page()
        page.set_default_timeout(WAIT)
        expected = "status of 4" if hostile else "status of 422"
        page.on(
            "console",
            lambda one: faults.append(one.text) if one.type == "error" and expected not in one.text else None,
        )
        page.on("pageerror", lambda error: faults.append(str(error)))
        if not scene:
            page.route("**/scene/**", lambda route: route.fulfill(body="", content_type="text/html"))
        begun = time.perf_counter()
        page.goto(bench.url)
        page.wait_for_selector("#content h2")
        yield page, bench, time.perf_counter() - begun
        assert not faults, faults


def show(page: Page, tab: str) -> None:
    """Open a tab."""
    page.press(f"#tab-{tab}", "Enter")
    page.wait_for_selector(f"#tab-{tab}[aria-selected=true]")


def do(page: Page, step: str, **fields: str) -> None:
    """Fill a form, press its button with a key, and wait for the end of the step."""
    for name, value in fields.items():
        field = f"form[data-step={step}] [name='{name}']"
        if page.locator(field).evaluate("one => one.tagName") == "SELECT":
            page.select_option(field, value)
        else:
            page.fill(field, value)
    before = int(page.get_attribute("body", "data-ended") or 0)
    page.press(f"form[data-step={step}] button[type=submit]", "Enter")
    page.wait_for_selector(f"body[data-ended='{before + 1}']")
    refusal = page.query_selector(f"form[data-step={step}] + .outcome .refusal")
    assert refusal is None, refusal.inner_text()


def upload(page: Page, path: Path) -> tuple[float, float]:
    """Upload rows; return the times until their columns and the findings of the check are shown [s]."""
    begun = time.perf_counter()
    page.set_input_files("#files", path)
    page.wait_for_selector(f"#proposal form:has-text('{path.name}')")
    read = time.perf_counter() - begun
    page.wait_for_selector("#findings > div, #findings > .good, #findings > .refusal")
    return read, time.perf_counter() - begun


def command(*words: object) -> None:
    """Run a command."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
