"""Pages of control charts, comparisons of two models, and fleets; one file each."""

import datetime
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from pisigma.lifetime.comparison.model_pair import Displacement
from pisigma.lifetime.comparison.parameter_differences import ParameterDifferences
from pisigma.lifetime.fleet.status import FleetStatus, urgency
from pisigma.lifetime.monitoring.charts import FALSE_ALARMS_PER_YEAR, SESSIONS_PER_YEAR, Chart
from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.recalibration.movement import NORMAL_95
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.comparison_tables import comparison_tables
from pisigma.reporting.fleet_tables import ERRORS_NOTE, cell_table, state_table
from pisigma.reporting.lifetime_tables import chart_table, difference_table, session_table
from pisigma.reporting.page.figures import AFTER, BEFORE, OTHER, Drawing, draw_map, drawing_style, make_panel
from pisigma.reporting.page.page import html_page
from pisigma.reporting.tables import pose_rows
from pisigma.validation.held_out.model_comparison import ModelComparison
from pisigma.validation.report.error_map import Layer

PAGE_WIDTH = 10_000
"""[characters] Width of tables on a page, which scroll."""


def monitoring_page(
    model: CalibratedModel,
    records: Sequence[Record],
    charts: Sequence[Chart],
    sentences: Sequence[str],
    warnings: Sequence[str],
) -> str:
    """Render sessions and charts as HTML; texts are escaped.

    Args:
        model: model that the sessions were compared with.
        records: all sessions sorted by date.
        charts: control charts of the sessions.
        sentences: sentences on all sessions together.
        warnings: warnings, one sentence each.
    """
    days = [datetime.date.fromisoformat(one.date) for one in records]
    return html_page(
        "monitoring.html.j2",
        model=model,
        records=records,
        sentences=sentences,
        warnings=warnings,
        alarm=any(chart.alarm is not None for chart in charts),
        values=[draw_values(chart, days) for chart in charts],
        statistics=[draw_statistics(chart, days) for chart in charts],
        sessions=session_table(records),
        charts=chart_table(charts),
        rate=f"{FALSE_ALARMS_PER_YEAR:g}",
        per_year=SESSIONS_PER_YEAR,
    )


def draw_values(chart: Chart, days: Sequence[datetime.date]) -> Drawing:
    """Draw a quantity over the sessions with 95 % intervals."""
    with drawing_style():
        figure, axes = make_panel()
        values, half = chart.values.numpy(), NORMAL_95 * chart.deviations.numpy()
        axes.errorbar(days, values, half, fmt="o", color=AFTER, markersize=4, capsize=2, linewidth=1.2)  # type: ignore[arg-type]
        if chart.alarm is not None:
            late = slice(chart.alarm, None)
            axes.plot(days[late], values[late], "s", color=BEFORE, markersize=6, label="outside the limits")  # type: ignore[arg-type]
            axes.legend(loc="upper left")
        if not chart.one_sided:
            axes.axhline(0.0, color="black", linewidth=0.6)
        quantity = "RMS error" if chart.one_sided else f"shift of {chart.what}"
        axes.set(ylabel=f"{quantity} [{chart.unit}]")
        _dates(axes)
    last = "unobservable" if np.isnan(values[-1]) else f"{values[-1]:.4f} {chart.unit}"
    alt = f"{quantity} of {len(days)} sessions with 95 % intervals; the last is {last}."
    return Drawing(f"{_key(chart)}_values", chart.what, alt, figure)


def draw_statistics(chart: Chart, days: Sequence[datetime.date]) -> Drawing:
    """Draw both statistics of a chart as shares of their limits."""
    with drawing_style():
        figure, axes = make_panel()
        for share, name, color, line in (
            (chart.ewma_share, "EWMA", AFTER, "o-"),
            (chart.cusum_share, "CUSUM", OTHER, "s--"),
        ):
            axes.plot(days, share.numpy(), line, color=color, label=name, markersize=3.5)  # type: ignore[arg-type]
        axes.axhline(1.0, color=BEFORE, linewidth=1.2, label="limit")
        axes.set(ylabel="share of the limit", ylim=(min(0.0, float(chart.ewma_share.min()) * 1.1), None))
        axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.1)
        _dates(axes)
    largest = float(np.maximum(chart.ewma_share.numpy()[-1], chart.cusum_share.numpy()[-1]))
    alt = (
        f"EWMA and CUSUM of {chart.what} over their limits; the larger is {largest:.2f} at the last session."
    )
    return Drawing(f"{_key(chart)}_statistics", chart.what, alt, figure)


def _key(chart: Chart) -> str:
    return chart.what.replace(" ", "_")


def _dates(axes: Axes) -> None:
    locator = AutoDateLocator(minticks=2, maxticks=6)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]


def fleet_page(status: FleetStatus) -> str:
    """Render the cells of a fleet as HTML, the most urgent first; texts are escaped.

    Args:
        status: status of the fleet.
    """
    place = {one.name: number for number, (one, _) in enumerate(status.by_error)}
    cells = sorted(status.cells, key=lambda one: (*urgency(one), place.get(one.name, len(place))))
    return html_page(
        "fleet.html.j2",
        name=status.folder.resolve().name,
        status=status,
        today=datetime.date.today().isoformat(),
        states=state_table(status),
        cells=cells,
        table=cell_table(cells),
        note=ERRORS_NOTE,
    )


def comparison_page(
    models: Mapping[str, CalibratedModel],
    parameters: ParameterDifferences,
    displacements: Mapping[str, Displacement],
    rows: ModelComparison | None,
    texts: tuple[Sequence[str], Sequence[str]],
) -> str:
    """Render a comparison of two models as HTML; texts are escaped.

    Args:
        models: two models by name.
        parameters: differences of the parameters.
        displacements: displacements of the tool, by description of the poses.
        rows: errors of both models on rows; None if none were given.
        texts: sentences of the result, and warnings.
    """
    first, second = models
    sentences, warnings = texts
    return html_page(
        "comparison.html.j2",
        names=(first, second),
        models=models,
        robot=models[first].robot,
        parameters=difference_table(parameters, (first, second)),
        differs=bool(parameters.differing),
        level=f"{parameters.level:.2g}",
        maps=[draw_displacement(what, one) for what, one in displacements.items()],
        displacements=pose_rows({what: one.errors.figures for what, one in displacements.items()}),
        rows=() if rows is None else comparison_tables(rows, "the rows", PAGE_WIDTH),
        sentences=sentences,
        warnings=warnings,
    )


def draw_displacement(what: str, displacement: Displacement) -> Drawing:
    """Draw distances between the poses of two models from above and from the side.

    Args:
        what: description of the poses.
        displacement: displacement of the tool at the poses.
    """
    errors = displacement.errors
    layers = [Layer("distance", "mm", errors.position.numpy() * 1e3)]
    if errors.rotation is not None:
        layers.append(Layer("turn", "deg", np.rad2deg(errors.rotation.numpy())))
    seen = f"Distance and rotation between the poses of both models, {what},"
    title = f"{what[:1].upper()}{what[1:]}"
    return draw_map(f"displacement_{what}", title, seen, displacement.place.numpy() * 1e3, layers)
