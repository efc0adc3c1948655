"""Requests of a browser to the page of a cell."""

import json
import re
import time

from pisigma.workbench.job import Outcome


def state(browser):
    return json.loads(browser.ask("/state").body)


def do(browser, name, **form):
    """Start a step, and return its answer."""
    return browser.ask(f"/step/{name}?person=Ada", "POST", json.dumps(form), Content_Type="application/json")


def ended(browser, bench, name, **form) -> Outcome:
    """Run a step to its end."""
    before = bench.jobs.ended
    answer = do(browser, name, **form)
    assert answer.status == 200, answer.body
    while bench.jobs.ended == before:
        time.sleep(0.02)
    return bench.jobs.outcomes[name]


def seen(browser):
    """Return the digest of `cell.yaml` that the page shows."""
    return re.search('name="seen" value="([^"]*)"', browser.ask("/tab/cell").body.decode())[1]


def upload(browser, name, content):
    answer = browser.ask(f"/upload?name={name}", "POST", content)
    return json.loads(answer.body)["file"]
