"""Page of a measuring session in headless Chromium: all rows, no errors, nothing loaded from elsewhere."""

import re
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.report import HOSTILE
from testing.sessions import arm_with_tracker, session_state

from pisigma.planning.session.state import Advice, Alarm

pytest.importorskip("viser", reason="the extra view is not installed")

from pisigma.workbench.viewing.session_view import SessionView, color_scale_maximum, first_view


@pytest.fixture(scope="module")
def view():
    """A page that is served while a module is tested; viser's annotations are not checked."""
    with no_type_checker(), SessionView(arm_with_tracker(), limit=1.5e-4, port=0) as view:
        yield view


@contextmanager
def opened(browser, view):
    """The page, and what went wrong on it while it was open."""
    page = browser.new_page(viewport={"width": 480, "height": 270})
    page.set_default_timeout(
        90_000
    )  # without a graphics card a busy machine takes long for the first picture
    faults = []
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("dialog", lambda dialog: (faults.append("a dialog"), dialog.dismiss()))
    origin = view.url.partition("/open/")[0]
    allowed = (origin, f"blob:{origin}", "data:")
    page.on(
        "request",
        lambda asked: None if asked.url.startswith(allowed) else faults.append(f"loads {asked.url}"),
    )
    try:
        page.goto(view.url)
        yield page
        assert faults == []
    finally:
        page.close()


def text_with(page, rows):
    """Return the text of the page once it shows a number of rows."""
    page.wait_for_selector(f"[data-rows='{rows}']")
    return re.sub(r"\s+", " ", page.inner_text("body"))


def test_rows_appear_as_they_come(browser, view):
    arm = arm_with_tracker()
    view.show_state(session_state(arm, 5))
    with opened(browser, view) as page:
        first = text_with(page, 5)
        assert "Next: pose 6 of 30 (check)" in first
        assert "RMS 0." not in first
        page.wait_for_selector("canvas")
        view.show_state(replace(session_state(arm, 20, wrong=19), base=np.eye(4)))
        shown = text_with(page, 20)
        for sentence in (
            "20 rows (3 of them check), 1 of them not used",
            "predicted: RMS 0.224 mm, 95 % below 0.380 mm",
            "cross-validated: RMS 0.268 mm",
            "line 21: the position is off by 5 mm",
            "theta_6",
            "Coverage of the joints",
        ):
            assert sentence in shown
        view.show_state(session_state(arm, 30))
        assert "Next" not in text_with(page, 30)
        assert page.inner_text("[data-action=stop]").strip() == "Stop: the limit is reached."
        alarm = Alarm(3, "unreadable", HOSTILE, False)
        view.show_state(replace(session_state(arm, 9), advice=Advice("repeat", HOSTILE), alarms=(alarm,)))
        text_with(page, 9)
        assert "</script><script>alert(1)</script>" in page.inner_text("[data-action=repeat]")


def test_nothing_is_printed_to_stdout(capfd):
    with no_type_checker(), SessionView(arm_with_tracker(), port=0) as view:
        assert view.url.startswith("http://127.0.0.1:")
    assert capfd.readouterr().out == ""


def test_the_colour_scale_covers_the_used_rows():
    state = session_state(arm_with_tracker(), 20, wrong=19)
    assert_close(color_scale_maximum(state.rows), 5e-4, rtol=1e-12)
    assert_close(color_scale_maximum(session_state(arm_with_tracker(), 3).rows), 1e-3)


def test_the_first_view_contains_robot_and_tracker():
    arm = arm_with_tracker()
    position, middle = first_view(arm)
    tracker = arm.surroundings.tracker.position.numpy()
    for point in (tracker, 0 * tracker):
        toward = (point - position) / (((point - position) ** 2).sum()) ** 0.5
        ahead = (middle - position) / (((middle - position) ** 2).sum()) ** 0.5
        assert toward @ ahead > 0.85
