"""Two models of one robot beside each other, as one page that loads nothing from elsewhere."""

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from pisigma.lifetime.comparison.displacement import Displacement
from pisigma.lifetime.comparison.parameter_differences import ParameterDifferences
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.comparison_tables import comparison_tables
from pisigma.reporting.difference_tables import difference_table
from pisigma.reporting.page.error_map import Layer
from pisigma.reporting.page.figures import Drawing, draw_map
from pisigma.reporting.page.page import image, resource
from pisigma.reporting.rendering import render
from pisigma.reporting.tables import pose_rows
from pisigma.validation.held_out.model_comparison import ModelComparison

WIDE = 10_000
"""Characters: tables of a page scroll."""


def comparison_page(
    models: Mapping[str, CalibratedModel],
    parameters: ParameterDifferences,
    displacements: Mapping[str, Displacement],
    rows: ModelComparison | None,
    says: tuple[Sequence[str], Sequence[str]],
) -> str:
    """Lay a comparison out as HTML; every text is shown as it is, whatever it holds.

    Args:
        models: the two, by name.
        parameters: side by side.
        displacements: distances between both models' poses, by what the poses are.
        rows: errors of both models; None where none were given.
        says: sentences, and what to heed.
    """
    first, second = models
    sentences, warnings = says
    return render(
        "comparison.html.j2",
        names=(first, second),
        models=models,
        robot=models[first].robot,
        parameters=difference_table(parameters, (first, second)),
        differs=bool(parameters.differing),
        level=f"{parameters.level:.2g}",
        maps=[draw_displacement(what, one) for what, one in displacements.items()],
        displacements=pose_rows({what: one.errors.figures for what, one in displacements.items()}),
        rows=() if rows is None else comparison_tables(rows, "the rows", WIDE),
        sentences=sentences,
        warnings=warnings,
        image=image,
        style=Markup(resource("style.css")),  # ours
    )


def draw_displacement(what: str, displacement: Displacement) -> Drawing:
    """Draw distances between both models' poses from above and from the side.

    Args:
        what: the poses are.
        displacement: at the poses.
    """
    errors = displacement.errors
    layers = [Layer("distance", "distance", "mm", errors.position.numpy() * 1e3, "")]
    if errors.rotation is not None:
        layers.append(Layer("turn", "turn", "deg", np.rad2deg(errors.rotation.numpy()), ""))
    seen = f"Distance and turn between the poses of both models, {what},"
    title = f"{what[:1].upper()}{what[1:]}"
    return draw_map(f"displacement_{what}", title, seen, displacement.place.numpy() * 1e3, layers)
