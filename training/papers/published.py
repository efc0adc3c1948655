"""Published figures of the papers: `training/papers/published.yaml`."""

from pathlib import Path
from typing import Literal

from pydantic import model_validator

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Section, read_yaml

PUBLISHED = Path("papers") / "published.yaml"
"""File name in the folder of the recipes."""


class Item(Section):
    """A table or figure of a paper.

    Attributes:
        number: Number in the paper.
        shows: What it shows.
        section: Heading of the section that compares it with ours.
        absent: Reason why no section compares it with ours.
    """

    number: int
    shows: str
    section: str | None = None
    absent: str | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> "Item":
        if (self.section is None) == (self.absent is None):
            raise ValueError("expected either section or absent")
        return self


class Paper(Section):
    """A paper.

    Attributes:
        key: Short name.
        heading: Heading of its section.
        citation: Authors, title, journal.
        recipes: Names of the recipes that reproduce it.
        tables: All tables.
        figures: All figures.
        differences: Sentences on the differences from our results, and why.
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
        table: Number of the table in the paper.
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
        table: Number of the table in the paper.
        names: The parameters.
        lower: Lower triangle with its diagonal; None where NaN is printed.
    """

    table: int
    names: tuple[str, ...]
    lower: tuple[tuple[float | None, ...], ...]

    @model_validator(mode="after")
    def _triangle(self) -> "CorrelationTriangle":
        if [len(row) for row in self.lower] != list(range(1, len(self.names) + 1)):
            raise ValueError("expected a lower triangle with one row per name")
        return self


class Correlations(Section):
    """Correlations of one robot: of lengths and of angles."""

    lengths: CorrelationTriangle
    angles: CorrelationTriangle


class Convergence(Section):
    """RMSE over iterations.

    Attributes:
        table: Number of the table in the paper.
        iterations: Iterations of the rows.
        rmse_mm: One row per iteration, one column per elimination case, without elimination last [mm].
    """

    table: int
    iterations: tuple[int, ...]
    rmse_mm: tuple[tuple[float, ...], ...]


class RedundantSums(Section):
    """Values of redundant parameters after calibration, and their sums.

    Attributes:
        table: Number of the table in the paper.
        members: The parameters.
        unit: Unit of the figures.
        parameters: Number of estimated parameters, per case.
        cases: Eliminated parameters of the arm; a last case has none.
        values: Values of the members, per case.
        sums: Their sums, per case.
    """

    table: int
    members: tuple[str, ...]
    unit: Literal["mm", "rad"]
    parameters: tuple[int, ...]
    cases: tuple[tuple[str, ...], ...]
    values: tuple[tuple[float, ...], ...]
    sums: tuple[float, ...]


class Published(Section):
    """All published figures except those in the `paper` sections of the recipes.

    Attributes:
        papers: The papers.
        dh_tables: DH tables by robot.
        correlations: Correlations by robot.
        convergence: Convergence by robot.
        redundant_sums: Redundant sums by robot.
        nominal_frames: Base per jig and tool, as printed.
        notes: Notes on the figures, by recipe.
    """

    papers: tuple[Paper, ...]
    dh_tables: dict[str, DhTable]
    correlations: dict[str, Correlations]
    convergence: dict[str, Convergence]
    redundant_sums: dict[str, RedundantSums]
    nominal_frames: dict[str, dict[str, float]]
    notes: dict[str, str]

    def paper(self, key: str) -> Paper:
        """Return the paper with a key."""
        return next(paper for paper in self.papers if paper.key == key)


def read_published(recipes: Path) -> Published:
    """Read the published figures.

    Args:
        recipes: The folder of the recipes.

    Raises:
        RecipeError: The file is missing or invalid; it names file, line and key.
    """
    return read_yaml(recipes / PUBLISHED, Published, RecipeError)
