"""What the papers published: `training/papers/published.yaml`."""

from pathlib import Path
from typing import Literal

from pydantic import model_validator

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Section, read_yaml

PUBLISHED = Path("papers") / "published.yaml"
"""Where it stands in the folder of the recipes."""


class Item(Section):
    """A table or figure of a paper.

    Attributes:
        number: its number there.
        shows: what.
        section: heading under which it stands beside ours.
        absent: why it does not.
    """

    number: int
    shows: str
    section: str | None = None
    absent: str | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> "Item":
        if (self.section is None) == (self.absent is None):
            raise ValueError("either section or absent was wanted")
        return self


class Paper(Section):
    """A paper.

    Attributes:
        key: short name.
        heading: of its part of the page.
        citation: authors, title, journal.
        recipes: names of those that repeat it.
        tables: all of them.
        figures: all of them.
        differences: what differs from ours and why, in sentences.
    """

    key: str
    heading: str
    citation: str
    recipes: tuple[str, ...]
    tables: tuple[Item, ...]
    figures: tuple[Item, ...]
    differences: tuple[str, ...]


class DhTable(Section):
    """A published DH table, row by row.

    Attributes:
        table: its number.
    """

    table: int
    theta_deg: tuple[float, ...]
    d_mm: tuple[float, ...]
    a_mm: tuple[float, ...]
    alpha_deg: tuple[float, ...]
    beta_deg: tuple[float, ...]


class CorrelationTriangle(Section):
    """A published table of correlations.

    Attributes:
        table: its number.
        names: the parameters.
        lower: the lower triangle with its diagonal; None where NaN is printed.
    """

    table: int
    names: tuple[str, ...]
    lower: tuple[tuple[float | None, ...], ...]

    @model_validator(mode="after")
    def _triangle(self) -> "CorrelationTriangle":
        if [len(row) for row in self.lower] != list(range(1, len(self.names) + 1)):
            raise ValueError("a lower triangle with one row a name was wanted")
        return self


class Correlations(Section):
    """Correlations of one robot: of lengths and of angles."""

    lengths: CorrelationTriangle
    angles: CorrelationTriangle


class Convergence(Section):
    """RMSE by iteration.

    Attributes:
        table: its number.
        iterations: the rows.
        rmse_mm: a row an iteration, a column an elimination case; without elimination last [mm].
    """

    table: int
    iterations: tuple[int, ...]
    rmse_mm: tuple[tuple[float, ...], ...]


class RedundantSums(Section):
    """Values of redundant parameters after calibration, and their sums.

    Attributes:
        table: its number.
        members: the parameters.
        unit: of the figures.
        parameters: how many were estimated, per case.
        cases: parameters of the arm that are left out; a last case leaves out none.
        values: per case, of the members.
        sums: per case.
    """

    table: int
    members: tuple[str, ...]
    unit: Literal["mm", "rad"]
    parameters: tuple[int, ...]
    cases: tuple[tuple[str, ...], ...]
    values: tuple[tuple[float, ...], ...]
    sums: tuple[float, ...]


class Published(Section):
    """All of it; what stands in a recipe's `paper` section is not repeated.

    Attributes:
        papers: the papers.
        dh_tables: by robot.
        correlations: by robot.
        convergence: by robot.
        redundant_sums: by robot.
        nominal_frames: base per jig and tool, as printed.
        notes: by recipe, what to say of its figures.
    """

    papers: tuple[Paper, ...]
    dh_tables: dict[str, DhTable]
    correlations: dict[str, Correlations]
    convergence: dict[str, Convergence]
    redundant_sums: dict[str, RedundantSums]
    nominal_frames: dict[str, dict[str, float]]
    notes: dict[str, str]

    def paper(self, key: str) -> Paper:
        """The paper with that key."""
        return next(paper for paper in self.papers if paper.key == key)


def read_published(recipes: Path) -> Published:
    """Read what was published.

    Args:
        recipes: the folder of the recipes.

    Raises:
        RecipeError: the file is missing or does not fit; the message names file, line and key.
    """
    return read_yaml(recipes / PUBLISHED, Published, RecipeError)
