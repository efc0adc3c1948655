"""Take the pictures of the tour: all tabs of `pisigma open`, 1280 and 800 px wide, light and dark.

`python docs/hooks/tour_pictures.py FOLDER_OF_SIM` needs Chromium, playwright and the extra `view`; FOLDER_OF_SIM
contains `kr10.urdf`, `kr10.csv` and `kr10_check.csv`. A cell is taken from its plan to an export by the buttons of the
page. Every tab is checked: no error in the console, nothing fetched from elsewhere, no text cut off, and no violation
that axe-core finds outside of the scene.
"""

import argparse
import io
import os
import shutil
import sys
import tempfile
from importlib import resources
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from pisigma.workbench.tabs import TABS
from pisigma.workbench.workbench import Workbench
from pisigma.workflow.cell.cell import Cell

FOLDER = Path(__file__).resolve().parent.parent / "figures" / "tour"
CHROMIUM = "--headless --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
SIZES = {1280: 800, 800: 1100}
"""Height of the window by its width [px]."""
POSE = {"x_mm": 600, "y_mm": 100, "z_mm": 800, "roll_deg": 0, "pitch_deg": 90, "yaw_deg": 0}
QUALITY = 28
"""Quality of the pictures (WebP)."""
CUT = """
const left = "#scene, textarea, input, [hidden], .table";
return [...document.querySelectorAll("body *")]
  .filter(one => !one.closest(left) && one.offsetWidth > 0 && one.scrollWidth > one.clientWidth + 1)
  .filter(one => getComputedStyle(one).overflowX !== "visible")
  .map(one => `${one.tagName} ${one.className} ${one.textContent.trim().slice(0, 60)}`);"""
"""JavaScript that lists the elements whose text is cut off, except tables, which scroll."""
AXE = 'axe.run({exclude: ["#scene"]}, {iframes: false, resultTypes: ["violations"]})'


def opened(browser: Browser, url: str, width: int, scheme: Any, faults: list[str]) -> Page:
    """Open the page in a new window; errors on it are added to `faults`."""
    size: Any = {"width": width, "height": SIZES[width]}
    page = browser.new_context(viewport=size, color_scheme=scheme).new_page()
    page.set_default_timeout(180_000)
    origin = url.partition("/open/")[0]
    page.on("console", lambda one: faults.append(one.text) if one.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    ours = (origin, f"blob:{origin}", "data:", "ws://127.0.0.1")
    page.on("request", lambda one: None if one.url.startswith(ours) else faults.append(f"loads {one.url}"))
    page.goto(url)
    page.wait_for_selector("#content form")
    # viser warns that there is no graphics card
    page.frame_locator("#scene").get_by_text("Software WebGL").locator("xpath=../..").locator(
        "button"
    ).click()
    return page


def show(page: Page, tab: str) -> None:
    """Open a tab."""
    page.click(f"#tab-{tab}")
    page.wait_for_selector(f"#tab-{tab}[aria-selected=true]")


def do(page: Page, tab: str, step: str, **fields: object) -> None:
    """Fill in the form of a step, press its button and wait for the end."""
    show(page, tab)
    for name, value in fields.items():
        page.fill(f"form[data-step={step}] [name={name}]", str(value))
    before = int(page.get_attribute("body", "data-ended") or 0)
    page.press(f"form[data-step={step}] button[type=submit]", "Enter")
    page.wait_for_selector(f"body[data-ended='{before + 1}']")


def upload(page: Page, rows: Path) -> None:
    """Upload rows and add them to the cell."""
    show(page, "measure")
    page.set_input_files("#files", rows)
    page.wait_for_selector("#proposal form")
    do(page, "measure", "import")


def work(page: Page, rows: list[Path]) -> None:
    """Take the cell from its plan to an export."""
    page.fill("#person", "A. Engineer")
    page.keyboard.press("Tab")
    do(page, "plan", "plan", count=30, check=8)
    upload(page, rows[0])
    do(page, "calibrate", "calibrate")
    upload(page, rows[1])
    do(page, "verify", "verify")
    upload(page, rows[2])
    do(page, "verify", "monitor")
    do(page, "measure", "measure")
    do(page, "deliver", "export")
    do(page, "deliver", "ik", **POSE)


def take(page: Page, name: str, axe: str) -> list[str]:
    """Take the picture of the present tab, and return its faults."""
    page.wait_for_timeout(1_500)
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    image.save(FOLDER / f"{name}.webp", quality=QUALITY, method=6)
    wrong = [f"{name}: cut off: {one}" for one in page.evaluate(f"() => {{{CUT}}}")]
    width = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    wrong += [f"{name}: {width} px wider than the window"] if width > 0 else []
    page.evaluate(axe)
    found = page.evaluate(AXE)["violations"]
    wrong += [f"{name}: {one['id']}: {node['html'][:100]}" for one in found for node in one["nodes"]]
    return wrong


def main() -> int:
    """Take all pictures; return 1 if one of them has a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    stated = parser.parse_args()
    simulated = stated.folder.resolve()
    axe = resources.files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")
    FOLDER.mkdir(exist_ok=True)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as running:
        os.chdir(scratch)  # commands on the page name the cell by a short path
        cell = Cell.create(Path("cells") / "welder7", simulated / "kr10.urdf", limit_mm=0.5)
        rows = [Path(scratch) / f"2026-11-{day}.csv" for day in ("01", "10", "20")]
        rows[0].write_bytes((simulated / "kr10.csv").read_bytes())
        header, *lines = (simulated / "kr10_check.csv").read_text().splitlines()
        rows[1].write_text("\n".join([header, *lines[:20]]) + "\n")
        rows[2].write_text("\n".join([header, *lines[20:32]]) + "\n")
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = running.chromium.launch(executable_path=chromium, args=CHROMIUM.split())
        with Workbench(cell.folder, port=0) as bench:
            work(opened(browser, bench.url, 1280, "light", wrong), rows)
            for width in SIZES:
                for scheme in ("light", "dark"):
                    page = opened(browser, bench.url, width, scheme, wrong)
                    for tab in TABS:
                        show(page, tab)
                        wrong += take(page, f"{tab}_{width}_{scheme}", axe)
                    page.context.close()
    total = sum(one.stat().st_size for one in FOLDER.iterdir())
    print(f"{len(list(FOLDER.iterdir()))} pictures, {total / 1e6:.2f} MB", *wrong, sep="\n")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
