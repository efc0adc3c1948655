"""Report page in headless Chromium: no errors, nothing loaded, a rotating map, no horizontal scrolling."""

from contextlib import contextmanager

import pytest
from testing.models import no_type_checker
from testing.report import HOSTILE, hybrid_under_test, measured

from pisigma.reporting.page.content import report_content
from pisigma.reporting.page.figures import draw_figures
from pisigma.reporting.page.page import render_page


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    """A report of rows with a hostile source."""
    folder = tmp_path_factory.mktemp("page")
    with no_type_checker():
        arm, model = hybrid_under_test()
        from dataclasses import replace

        rows = replace(measured(arm, 120, seed=9), source=HOSTILE.replace("/", ""))
        content = report_content(replace(model, name=HOSTILE), folder, rows)
        (folder / "report.html").write_text(render_page(content, draw_figures(content)), encoding="utf-8")
    return folder / "report.html"


@contextmanager
def opened(browser, path, width, **options):
    """The page, and what went wrong on it while it was open."""
    page = browser.new_page(viewport={"width": width, "height": 900}, **options)
    faults = []
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("dialog", lambda dialog: (faults.append("a dialog"), dialog.dismiss()))
    own = path.as_uri()
    page.on(
        "request",
        lambda asked: None if asked.url.startswith((own, "data:")) else faults.append(f"loads {asked.url}"),
    )
    try:
        page.goto(own)
        page.wait_for_selector("canvas[data-drawn]")
        yield page
        assert faults == []
    finally:
        page.close()


def canvas(page, name):
    return page.evaluate(f"document.getElementById('canvas').dataset.{name}")


def picture(page):
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.evaluate("document.getElementById('canvas').toDataURL()")


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1600, "dark")])
def test_the_page_opens_without_errors_and_fits(browser, page_file, width, scheme):
    with opened(browser, page_file, width, color_scheme=scheme) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert canvas(page, "drawn") == "120"
        assert page.title().startswith(HOSTILE)
        loaded = "[...document.images].every((image) => image.complete && image.naturalWidth > 0)"
        assert page.evaluate(loaded)
        if width >= 1280:  # the tables of errors are side by side and not cut
            cut = "[...document.querySelectorAll('.accuracy')].map((t) => t.scrollWidth - t.parentElement.clientWidth)"
            cuts = page.evaluate(cut)
            assert len(cuts) == 2
            assert max(cuts) <= 0


@pytest.mark.parametrize("width", [390, 1600])
def test_the_map_turns_and_zooms(browser, page_file, width):
    with opened(browser, page_file, width) as page:
        box = page.locator("#canvas")
        box.scroll_into_view_if_needed()
        views, pictures = {canvas(page, "view")}, {picture(page)}
        area = box.bounding_box()
        x, y = area["x"] + area["width"] / 2, area["y"] + area["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 60, y + 25, steps=4)
        page.mouse.up()
        pictures.add(picture(page))
        views.add(canvas(page, "view"))
        box.focus()
        for key in ("ArrowLeft", "ArrowUp", "+"):
            page.keyboard.press(key)
            pictures.add(picture(page))
            views.add(canvas(page, "view"))
        page.mouse.wheel(0, -300)
        page.wait_for_timeout(100)
        pictures.add(picture(page))
        views.add(canvas(page, "view"))
        assert len(views) == len(pictures) == 6
        page.keyboard.press("0")
        picture(page)
        assert canvas(page, "view") == "-0.700 0.450 1.000"


def test_the_switch_shows_other_errors(browser, page_file):
    with opened(browser, page_file, 1600) as page:
        legends, pictures = set(), set()
        for key in ("before", "after", "predicted"):
            page.click(f"button[data-layer={key}]")
            pictures.add(picture(page))
            assert canvas(page, "layer") == key
            assert page.get_attribute(f"button[data-layer={key}]", "aria-pressed") == "true"
            legends.add(page.inner_text("#legend"))
        assert len(legends) == len(pictures) == 3
        page.select_option("#share", "0.1")
        picture(page)
        assert canvas(page, "drawn") == "12"


def test_the_legend_counts_every_point(browser, page_file):
    with opened(browser, page_file, 1600) as page:
        counts = page.evaluate(
            "[...document.querySelectorAll('#legend tbody tr')].map((r) => +r.cells[2].textContent)"
        )
        assert sum(counts) == 120


def test_points_show_their_values(browser, page_file):
    with opened(browser, page_file, 1600) as page:
        page.click("button[data-view=worst]")
        first = page.inner_text("#point")
        assert "row" in first
        assert "joints" in first
        page.click("button[data-view=worst]")
        assert page.inner_text("#point") != first
        page.click("button[data-view=reset]")
        # the worst point lies under its ring: pointing at it shows the same as the button
        page.focus("#canvas")
        page.keyboard.press("w")
        assert page.inner_text("#point") == first


def test_the_page_reads_without_scripts(browser, page_file):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(page_file.as_uri())
    assert "from above and from the side" in page.inner_text("#map")
    assert "120 rows" in page.inner_text("#verdict")
    context.close()
