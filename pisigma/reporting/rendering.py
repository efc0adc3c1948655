"""Cards and pages from templates: layout and wording are in the folder `templates`."""

import functools
import re
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from pisigma.files.model_files import CARD
from pisigma.files.templates import template_environment
from pisigma.reporting.result_text import Table
from pisigma.reporting.tables import (
    distance_table,
    joint_table,
    markdown_table,
    number_text,
    p_text,
    percent_text,
    pose_table,
)
from pisigma.reporting.verdict import rounded_text

_WRAPPED = 24
"""Characters of a text above which its column is wrapped."""


def render(template: str, **content: object) -> str:
    """Fill in a template.

    Args:
        template: file of the folder `templates`; values are escaped in HTML templates.
        content: values by the names in the template.
    """
    return _environment().get_template(template).render(content)


def render_sentences(template: str, macro: str, *values: object) -> tuple[str, ...]:
    """Fill in a macro of a template and return its paragraphs, which are separated by empty lines."""
    text = getattr(_environment().get_template(template).module, macro)(*values)
    return tuple(paragraph.strip() for paragraph in text.split("\n\n") if paragraph.strip())


def write_card(folder: Path, template: str, **content: object) -> None:
    """Write the card of a model folder from a template; see `render`."""
    (folder / CARD).write_text(render(template, **content) + "\n", encoding="utf-8")


def markup_with_code(line: str) -> Markup:
    """Escape a sentence for a page, and show its commands, which are in backquotes, as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(line))))


def column_classes(table: Table) -> tuple[str, ...]:
    """Return the style of each column of a table: "" for numbers, "text", or "text long" for texts that are wrapped."""
    classes = []
    for place in range(len(table.columns)):
        cells = [Markup(row[place]).striptags() for row in table.rows if row[place]]
        texts = [one for one in cells if re.search(r"[^\W\d_]{2}", one)]
        is_long = max(map(len, cells), default=0) > _WRAPPED
        classes.append("" if 2 * len(texts) <= len(cells) else "text long" if is_long else "text")
    return tuple(classes)


def file_name(text: str) -> str:
    """Replace the characters that file names cannot have."""
    return re.sub(r"[^\w.-]", "_", text) or "figure"


@functools.cache
def _environment() -> jinja2.Environment:
    return template_environment(
        "pisigma.reporting",
        {
            "figure": number_text,
            "digits": "{:.4g}".format,
            "code": markup_with_code,
            "column_classes": column_classes,
            "pose_table": pose_table,
            "joint_table": joint_table,
            "distance_table": lambda distances: markdown_table(*distance_table(distances)),
            "p_value": p_text,
            "percent": percent_text,
            "rounded": rounded_text,
            "table": lambda table: markdown_table(*table),
        },
    )
