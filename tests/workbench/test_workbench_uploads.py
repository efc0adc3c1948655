"""Files that are uploaded to the page: their names, columns, mistakes, and how they become sessions."""

import html
import json
import re
import shlex
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import quote

import pytest
from testing.cell_rows import ROBOT, day, measured
from testing.report import HOSTILE
from testing.workbench_requests import ended, upload

pytest.importorskip("viser", reason="the extra view is not installed")

from pisigma.workflow.cell.cell import Cell


def test_files_that_arrive_at_once_keep_their_contents(browser_with_link, bench):
    def one(number):
        content = f"{number}".encode() * 300_000
        return content, upload(browser_with_link, f"{number}.csv", content)

    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(one, range(12)))
    for content, number in found:
        (path,) = bench._uploads.paths([number])
        assert path.read_bytes() == content


@pytest.mark.parametrize("name", ["測" * 200, "a" * 1000, "..", "../..", "\0", "", "x\ny", "a; b'c\".csv"])
def test_every_name_of_an_upload_is_accepted(browser_with_link, bench, name):
    number = upload(browser_with_link, quote(name, safe=""), b"A1,X\n1,2\n")
    (path,) = bench._uploads.paths([number])
    assert path.parent.name == number
    shown = browser_with_link.ask("/propose", "POST", json.dumps({"files": number})).body.decode()
    command = re.search(r'data-command="([^"]*)"', shown)
    assert command is None or shlex.split(html.unescape(command[1])) == ["pisigma", "import", path.name]


def test_columns_state_their_keys_for_the_command(browser_with_link):
    number = upload(browser_with_link, "twice.csv", b"P,X,X\n1,2,3\n")
    shown = browser_with_link.ask("/propose", "POST", json.dumps({"files": number})).body.decode()
    assert re.findall('data-key="([^"]*)"', shown) == ["P", "2", "3"]


def test_an_upload_is_shown_and_added_as_the_command_would(browser_with_link, bench, cell, tmp_path):
    rows = measured(12, 5)
    rows.write_csv(tmp_path / "rows.csv", ROBOT)
    number = upload(browser_with_link, "..%2f..%2frows.csv", (tmp_path / "rows.csv").read_bytes())
    shown = browser_with_link.ask("/propose", "POST", json.dumps({"files": number})).body.decode()
    assert "<b>rows.csv</b>" in shown
    found = ended(browser_with_link, bench, "import", files=number, date=day(3))
    assert found.started_by == "Ada"
    entry = Cell.open(cell.folder).history.sessions()[-1]
    assert (entry.name, entry.rows) == (day(3), 12)
    assert (cell.folder / "sessions" / f"{day(3)}.csv").read_bytes() == (tmp_path / "rows.csv").read_bytes()
    again = ended(browser_with_link, bench, "import", files=number)
    assert again.text is None
    assert "rows.csv" in again.refusal
    assert "pisigma-" not in again.refusal


def test_the_meaning_of_columns_can_be_changed(browser_with_link):
    lines = ["P,A1,A2,A3,A4,A5,A6,X,Y,Z", *(f"{k},{k},2,3,4,5,6,{1000 + k},20,30" for k in range(1, 9))]
    number = upload(browser_with_link, "export.csv", "\n".join(lines).encode())

    def proposed(**form):
        return browser_with_link.ask("/propose", "POST", json.dumps({"files": number, **form}))

    assert 'placeholder="x_mm"' in proposed(unit="mm,deg").body.decode()
    assert 'placeholder="x_in"' in proposed(unit="mm,deg", **{"column 0 7": "x_in"}).body.decode()
    wrong = proposed(**{"column 0 7": HOSTILE})
    assert wrong.status == 422
    assert json.loads(wrong.body)["error"]


def test_a_mistake_is_named_with_its_repair(browser_with_link):
    rows = measured(30, 7)
    lines = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm"]
    for q, x in zip(rows.q.rad2deg().tolist(), (1e3 * rows.position).tolist(), strict=True):
        q[3] *= -1
        lines.append(",".join(map(repr, [*q, *x])))
    number = upload(browser_with_link, "rows.csv", "\n".join(lines).encode())

    def checked(**form):
        answer = browser_with_link.ask("/check", "POST", json.dumps({"files": number, **form}))
        return html.unescape(answer.body.decode())

    text = checked()
    assert 'data-cause="joint_sign"' in text
    repair = json.loads(re.search('data-repair="(.*?})"', text)[1])
    assert repair["column 0 3"] == "-q4_deg"
    assert "data-cause" not in checked(**repair)
    assert browser_with_link.ask("/show", "POST", json.dumps({"text": "lines 3, 7 to 9"})).status == 200


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 100, b"a,b\n1", HOSTILE.encode(), b"\xff\xfe\x00", b"q1_deg,x_mm\n"]
)
def test_hostile_uploads_are_refused(browser_with_link, bench, content):
    number = upload(browser_with_link, quote(f"{HOSTILE}.csv"), content)
    answer = browser_with_link.ask("/propose", "POST", json.dumps({"files": number}))
    assert answer.status in (200, 422)
    assert ended(browser_with_link, bench, "import", files=number).refusal
