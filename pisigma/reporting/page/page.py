"""The report on a model as one self-contained HTML page."""

import base64
import json
from importlib.resources import files
from typing import Any

import numpy as np
from markupsafe import Markup

from pisigma.lifetime.cell.acceptance import Acceptance
from pisigma.measurement.groups import numbers_of_names
from pisigma.reporting.acceptance_tables import (
    acceptance_sentences,
    budget_table,
    comparison_table,
    iso_table,
    statement_table,
)
from pisigma.reporting.calibration_tables import parameter_table
from pisigma.reporting.page.content import ReportContent
from pisigma.reporting.page.drawing import Drawing
from pisigma.reporting.page.figures import ReportFigures
from pisigma.reporting.page.wording import (
    LAYER_LABELS,
    MODEL_LABELS,
    TITLES,
    arm_sentence,
    frame_or_target_text,
    layer_text,
    map_text,
    rows_text,
    zeros_table,
)
from pisigma.reporting.rendering import render
from pisigma.robot.description import Robot
from pisigma.validation.report.error_map import ErrorMap

_ESCAPED = {ord(mark): f"\\u{ord(mark):04x}" for mark in "<>&\u2028\u2029"}
_PACKAGE = "pisigma.reporting.page"
_RESOURCES = {"style": "style.css", "common_script": "copies.js"}
"""Files of this folder that every page contains, by their names in templates."""


def render_page(content: ReportContent, figures: ReportFigures, acceptance: Acceptance | None = None) -> str:
    """Render the report as HTML; texts are escaped.

    Args:
        content: findings of the report.
        figures: figures of the report.
        acceptance: statements for the acceptance of the robot of a cell; None without a cell.
    """
    return html_page(
        "page.html.j2",
        c=content,
        a=acceptance,
        accepted={} if acceptance is None else _acceptance(acceptance),
        arm_sentence=None if content.images is None else arm_sentence(content.images),
        zeros=None if content.images is None else zeros_table(content.images),
        figures=figures,
        labels=MODEL_LABELS,
        titles=TITLES,
        rows_text=rows_text,
        frame_or_target_text=frame_or_target_text,
        map_text=map_text(content.map),
        parameter_table=parameter_table,
        png=lambda png: _address("png", png),
        map_data=script_json(map_data(content.map, content.model.robot)),
        script=Markup(read_resource("viewer.js")),
    )


def html_page(template: str, **content: object) -> str:
    """Render a page with the style, the script and the images of all pages; texts are escaped.

    Args:
        template: file of the folder `templates` that extends `base.html.j2`.
        content: values by the names in the template.
    """
    ours = {name: Markup(read_resource(file)) for name, file in _RESOURCES.items()}
    return render(template, image=data_url, **ours, **content)


def _acceptance(acceptance: Acceptance) -> dict[str, Any]:
    """Return the sentences and tables of an acceptance."""
    return {
        "sentences": acceptance_sentences(acceptance),
        "statements": statement_table(acceptance),
        "budget": budget_table(acceptance),
        "comparison": comparison_table(acceptance),
        "iso": iso_table(acceptance.repeats),
    }


def script_json(value: Any) -> Markup:
    """Return a value as JSON for a script element, escaped so that it cannot end the element or a line."""
    return Markup(json.dumps(value, allow_nan=False, ensure_ascii=True).translate(_ESCAPED))


def map_data(error_map: ErrorMap, robot: Robot) -> dict[str, Any]:
    """Pack the data of the viewer; arrays as base64 of little-endian float32."""
    return {
        "place": _packed(error_map.position_mm),
        "layers": [
            {
                "key": layer.key,
                "label": LAYER_LABELS[layer.key],
                "unit": layer.unit,
                "values": _packed(layer.values),
                "summary": layer_text(layer, error_map),
            }
            for layer in error_map.layers
        ],
        "row": _packed(error_map.row),
        "numberings": list(dict.fromkeys(error_map.row_numbering)),
        "numbering": _packed(numbers_of_names(error_map.row_numbering)),
        "q": _packed(error_map.controller_values),
        "joints": [
            {"name": axis.name, "unit": "°" if axis.type == "revolute" else "mm"} for axis in robot.axes
        ],
        "frames": list(dict.fromkeys(error_map.frame)),
        "frame": _packed(numbers_of_names(error_map.frame)),
        "targets": list(dict.fromkeys(error_map.target)),
        "target": _packed(numbers_of_names(error_map.target)),
        "inside": _packed(error_map.is_inside_range),
    }


def read_resource(name: str) -> str:
    """Read a file of this folder, such as the style of all pages."""
    return files(_PACKAGE).joinpath(name).read_text(encoding="utf-8")


def _packed(values: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()


def data_url(drawing: Drawing) -> str:
    """Return the data URL of a figure."""
    return _address("svg+xml", drawing.svg().encode())


def _address(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
