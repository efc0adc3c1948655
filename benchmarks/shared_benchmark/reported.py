"""What papers and repositories reported of the series or their methods, beside what such a method gives here."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shared_benchmark.results import Results, table


@dataclass(frozen=True)
class ReportedFigure:
    """A published figure and the stored result that is nearest to it.

    Attributes:
        source: where the figure is published.
        subject: the robot and the method of the figure.
        reported_mm: the figure [mm]; None if it was not available to us.
        metric: "mean" or "rms" of the position errors.
        series: series of the stored result.
        split: split of the stored result.
        method: method of the stored result.
        difference: how the protocols differ.
    """

    source: str
    subject: str
    reported_mm: float | None
    metric: Literal["mean", "rms"]
    series: str
    split: str
    method: str
    difference: str


_MUKCA = "Franzese, Spahn, Kober and Della Santina 2025, arXiv 2503.12584"
_JACOBI = "P. Jacobi 2025, master's thesis, Tsinghua University (README of the series)"
_BURAKOV = "D. Burakov 2020, `docs/GeometricCalibration.md` of the series"
_LANDGRAF = "Landgraf and others 2021, IEEE CASE"

FIGURES = (
    ReportedFigure(
        _BURAKOV,
        "this FANUC, least squares on an irreducible model, one step",
        0.5315,
        "rms",
        "fanuc",
        "configurations",
        "scipy_dh",
        "reported for the rows that were fitted; here for configurations that were not. "
        "One linear step from the nominal arm; here until convergence.",
    ),
    ReportedFigure(
        _JACOBI,
        "this UR5, nominal parameters",
        2.5664,
        "mean",
        "ur5_grid",
        "random",
        "nominal",
        "reported without fitting base and tool; here both are fitted, which hides most of the error.",
    ),
    ReportedFigure(
        _JACOBI,
        "this UR5, modified DH and a graph network on the residuals",
        0.1549,
        "mean",
        "ur5_grid",
        "random",
        "lm_network",
        "reported for 20 random poses that the arm reached with the compensation, after a fit of all 1,000 rows; "
        "here for held-out rows of the grid, predicted, with a smaller network. The 20 poses are not in the series.",
    ),
    ReportedFigure(
        _MUKCA + " (README of its repository)",
        "another Panda (`panda_1`), placements of all joints by consistency and distance, other placements",
        0.347,
        "mean",
        "panda",
        "placements",
        "scipy_dh",
        "reported as the mean absolute error from the mean of the socket, which contains the row itself; "
        "here from the mean of the other rows. Another arm of the same type.",
    ),
    ReportedFigure(
        _LANDGRAF,
        "this UR10, network with forward kinematics",
        None,
        "mean",
        "ur10_c",
        "random",
        "lm_network",
        "the figures are not part of the published repository, and the paper was not available to us; "
        "its split of the rows is not published either.",
    ),
)
"""Published figures, by series."""


def reported_table(results: Results) -> str:
    """Return the table of reported figures beside stored results."""

    def here(one: ReportedFigure, method: str) -> str:
        errors = results.errors.get((one.series, one.split, method))
        if errors is None:
            return "not run"
        length = np.linalg.norm(errors.error, axis=1)
        return f"{length.mean() if one.metric == 'mean' else errors.rms:.3f}"

    rows = [
        [
            one.source,
            one.subject,
            "not available" if one.reported_mm is None else f"{one.reported_mm:.3f}",
            one.metric,
            f"`{one.method}` on `{one.series}`, `{one.split}`",
            here(one, one.method),
            here(one, "hybrid"),
            one.difference,
        ]
        for one in FIGURES
    ]
    head = ["source", "robot and method", "reported [mm]", "metric", "nearest result here", "here [mm]"]
    return table([*head, "pisigma's hybrid here [mm]", "how the protocols differ"], rows)
