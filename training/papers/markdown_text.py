"""Pieces of Markdown of the page: commands, pictures, anchors, numbers."""

import re

from jig_recipe import JIGS

FIGURES = "figures"
"""Folder of the pictures, beside the page."""

DATA = {"ur10_inverse": "series_c_train.csv", "ur10_hybrid": "series_c_train.csv", "ur5_hybrid": "grid.csv"}
"""Measured data that recipes ask for, by the names of their files."""


def command_of(name: str) -> str:
    """The command that runs a recipe."""
    if name == JIGS.stem:
        return f"python training/papers run {name}"
    data = f" --data {DATA[name]}" if name in DATA else ""
    return f"pisigma train training/{name}.yaml{data}"


def command_block(*names: str) -> str:
    """Commands as a block of shell."""
    return "```bash\n" + "\n".join(command_of(name) for name in names) + "\n```"


def picture(file: str, alt: str) -> str:
    """A picture of the folder of figures."""
    return f"![{alt}]({FIGURES}/{file})"


def link_to(heading: str) -> str:
    """A link to a heading of the same page, by the rules of GitHub and MkDocs."""
    anchor = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
    return f"[{heading}](#{anchor})"


def scientific(value: float) -> str:
    """Three digits, with an exponent where that is shorter."""
    return f"{value:.3f}" if value == 0 or 0.01 <= abs(value) < 1000 else f"{value:.2e}"


def plain(value: float) -> str:
    """A number as people write it: no trailing zeros."""
    return f"{value:.6g}"


def folded(summary: str, text: str) -> str:
    """A part of the page that opens with a click."""
    return f"<details><summary>{summary}</summary>\n\n{text}\n\n</details>"
