"""The page of a cell in headless Chromium."""

from contextlib import closing, contextmanager


@contextmanager
def opened(browser, url):
    """The page without its scene, which has a test of its own, and what went wrong on it."""
    faults = []
    with closing(browser.new_context(viewport={"width": 800, "height": 900})) as context:
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("console", lambda one: faults.append(one.text) if one.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        origin = url.partition("/open/")[0]
        page.on(
            "request", lambda one: None if one.url.startswith((origin, "data:")) else faults.append(one.url)
        )
        page.route("**/scene/**", lambda route: route.fulfill(body="", content_type="text/html"))
        page.goto(url)
        page.wait_for_selector("#content form")
        yield page
        assert faults == []


def show(page, tab):
    """Open a tab."""
    page.click(f"#tab-{tab}")
    page.wait_for_selector(f"#tab-{tab}[aria-selected=true]")


def upload_file(page, path):
    """Upload a file, and wait for its columns; the tab Measure is open."""
    page.set_input_files("#files", path)
    page.wait_for_selector("#proposal form")
