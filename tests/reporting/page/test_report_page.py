"""Report page: self-contained, reproducible, and with hostile names escaped."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of
from testing.models import no_type_checker
from testing.refusals import refused
from testing.report import HOSTILE, folder_with_held_out, geometric_under_test, hybrid_under_test, measured

from pisigma.files.errors import OutputError
from pisigma.reporting.page.content import report_content
from pisigma.reporting.page.drawing import check_figures_writable, write_figures
from pisigma.reporting.page.figures import draw_dependence, draw_figures
from pisigma.reporting.page.page import render_page, script_json

pytestmark = pytest.mark.usefixtures("without_type_checker")


class Page(HTMLParser):
    """Elements of a page, its text, and what its scripts hold."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.addresses, self.scripts, self.words = [], [], [], []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag == "script":
            self.scripts.append("")
        self._inside = tag

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] += data
        else:
            self.words.append(data)


def page_of(content):
    return render_page(content, draw_figures(content))


def hostile_content(folder):
    """The report of measurements whose source, frames and targets have hostile names."""
    with no_type_checker():
        arm, model = hybrid_under_test(frames=True)
        names = {"wall": HOSTILE, "floor": "</table><b>floor"}
        rename = dict(names)
        model = replace(
            model,
            name=HOSTILE,
            bases={rename[k]: v for k, v in model.bases.items()},
            hybrid_bases={rename[k]: v for k, v in model.hybrid_bases.items()},
        )
        rows = replace(
            arm.measurements,
            frame=tuple(rename[name] for name in arm.measurements.frame),
            source=HOSTILE.replace("/", ""),
        )
        return report_content(model, folder, rows)


@pytest.fixture(scope="module")
def hostile_page(tmp_path_factory):
    """This report and its page."""
    content = hostile_content(tmp_path_factory.mktemp("none"))
    with no_type_checker():
        return content, page_of(content)


def test_hostile_names_are_text(hostile_page):
    content, text = hostile_page
    found = Page(text)
    assert found.elements.count("script") == 3
    assert "b" not in found.elements
    assert text.count("</script>") == 3
    assert "onerror=alert(2)>" not in text
    assert any(HOSTILE in word for word in found.words)
    data = json.loads(found.scripts[1])
    assert HOSTILE in data["frames"]
    assert "</table><b>floor" in data["frames"]
    assert len(content.frames.name_errors) == 2


def test_nothing_is_loaded_from_elsewhere(hostile_page):
    found = Page(hostile_page[1])
    assert all(address.startswith(("data:", "#")) for address in found.addresses)
    assert not {"link", "iframe", "object", "embed"} & (set(found.elements) - {"link"})
    assert "http" not in re.sub(r'"data:[^"]*"', "", hostile_page[1]).replace(
        "http://www.w3.org/2000/svg", ""
    )


def test_json_cannot_end_its_element():
    value = {"<&>": "</script><!--\u2028\u2029"}
    text = str(script_json(value))
    assert not set("<>&\u2028\u2029") & set(text)
    assert json.loads(text) == value


def test_the_map_contains_the_stated_content(hostile_page):
    content, text = hostile_page
    data = json.loads(Page(text).scripts[1])
    unpack = lambda packed: np.frombuffer(base64.b64decode(packed), "<f4")  # noqa: E731
    assert_close(unpack(data["place"]).reshape(-1, 3), content.map.position_mm, rtol=1e-6, atol=1e-3)
    for stored, layer in zip(data["layers"], content.map.layers, strict=True):
        assert_close(unpack(stored["values"]), layer.values, rtol=1e-6)
    named = [data["frames"][int(k)] for k in unpack(data["frame"])]
    assert tuple(named) == content.map.frame


def test_the_same_input_gives_the_same_bytes(hostile_page, tmp_path):
    assert page_of(hostile_content(tmp_path)) == hostile_page[1]


def test_every_section_is_on_the_page(tmp_path):
    arm, model = hybrid_under_test()
    kept = folder_with_held_out(arm, model, tmp_path / "arm")
    curve = [
        {"rows": n, "held_out": 9, "geometric": {"rms_mm": 0.2}, "hybrid": {"rms_mm": 0.1 + 1 / n}}
        for n in (50, 100, 200)
    ]
    kept = replace(kept, metrics=kept.metrics | {"learning_curve": curve})
    content = report_content(kept, tmp_path / "arm", arm.measurements)
    figures = draw_figures(content)
    text = render_page(content, figures)
    for section in ("verdict", "accuracy", "map", "residuals", "parameters", "observability", "corrections"):
        assert f'<section id="{section}">' in text
    for section in ("learning", "next", "provenance"):
        assert f'<section id="{section}">' in text
    assert any("200 rows" in line for line in content.advice)
    assert model.provenance.data_sha256 in text
    assert [drawing.title for drawing in figures.correlations] == ["lengths", "angles"]
    assert text.count('src="data:image/svg+xml') == len(figures.all)


def test_a_page_of_many_rows_is_small(tmp_path):
    arm, model = geometric_under_test()
    content = report_content(model, tmp_path, measured(arm, 4_000, seed=9))
    assert len(content.map.position_mm) == 4_000
    assert len(page_of(content).encode()) < 6e6


def test_of_very_many_rows_the_worst_are_shown(tmp_path, monkeypatch):
    monkeypatch.setattr("pisigma.validation.report.error_map.MAX_POINTS", 200)
    arm, model = geometric_under_test()
    content = report_content(model, tmp_path, measured(arm, 1_000, seed=9))
    after = content.rows.model_errors.position.numpy() * 1e3
    shown = next(layer for layer in content.map.layers if layer.key == "after").values
    assert len(shown) <= 200
    assert np.isin(np.sort(after)[-10:], shown).all()
    assert content.map.rows == 1_000


def test_figures_are_written_as_png_svg_and_csv(tmp_path):
    arm, model = geometric_under_test()
    drawings = draw_figures(report_content(model, tmp_path, measured(arm, 60, seed=9))).all[:3]
    written = write_figures(drawings, tmp_path / "figures")
    assert len(written) == 3 * len(drawings)
    assert all(path.stat().st_size > 500 for path in written)
    assert {path.suffix for path in written} == {".png", ".svg", ".csv"}
    (tmp_path / "file").write_text("")
    with refused(OutputError, option="--figures", file="file"):
        check_figures_writable(tmp_path / "file")
    with refused(OutputError, option="--figures", file=str(tmp_path / "none" / "figures")):
        check_figures_writable(tmp_path / "none" / "figures")


@pytest.mark.parametrize("name", ["$x$", r"\frac{$", "theta_1", "\u6f22$"])
def test_names_are_not_read_as_formulas(name, tmp_path):
    arm = hybrid_of("rb5", 200)
    model = geometric_under_test()[1]
    rows = list(model.robot.rows)
    place = model.robot.joint_rows[0]
    rows[place] = replace(rows[place], name=name)
    content = report_content(
        replace(model, robot=replace(model.robot, rows=tuple(rows))), tmp_path, measured(arm, 30, 9)
    )
    assert content.dependences[0].title == name
    svg = draw_dependence(content.dependences[0]).svg()
    assert (name if name != "\u6f22$" else "$") in svg.replace("&#36;", "$")


def test_a_page_of_three_rows(tmp_path):
    arm, model = hybrid_under_test()
    content = report_content(model, tmp_path, measured(arm, 3, seed=9))
    assert "<table" in page_of(content)
    assert torch.isfinite(content.rows.model_errors.position).all()
