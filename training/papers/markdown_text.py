"""Markdown for the page: commands, pictures, anchors, numbers."""

import re

from jig_recipe import JIGS

FIGURES = "figures"
"""Folder of the pictures, next to the page."""

DATA = {"ur10_inverse": "series_c_train.csv", "ur10_hybrid": "series_c_train.csv", "ur5_hybrid": "grid.csv"}
"""File names of the measured data that recipes need."""


def command_of(name: str) -> str:
    """Return the command that runs a recipe."""
    if name == JIGS.stem:
        return f"python training/papers run {name}"
    data = f" --data {DATA[name]}" if name in DATA else ""
    return f"pisigma train training/{name}.yaml{data}"


def command_block(*names: str) -> str:
    """Return commands as a shell block."""
    return "```bash\n" + "\n".join(command_of(name) for name in names) + "\n```"


def picture(file: str, alt: str) -> str:
    """Return a picture from the folder of figures."""
    return f"![{alt}]({FIGURES}/{file})"


def link_to(heading: str) -> str:
    """Return a link to a heading of the same page, by the rules of GitHub and MkDocs."""
    anchor = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
    return f"[{heading}](#{anchor})"


def scientific(value: float) -> str:
    """Format a number with three digits, with an exponent if that is shorter."""
    return f"{value:.3f}" if value == 0 or 0.01 <= abs(value) < 1000 else f"{value:.2e}"


def plain(value: float) -> str:
    """Format a number without trailing zeros."""
    return f"{value:.6g}"


def folded(summary: str, text: str) -> str:
    """Return a collapsible part of the page."""
    return f"<details><summary>{summary}</summary>\n\n{text}\n\n</details>"
