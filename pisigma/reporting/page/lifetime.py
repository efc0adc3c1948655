"""Pages of control charts, comparisons of two models, and fleets; one file each."""

import datetime
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from pisigma.files.model_files import CARD
from pisigma.lifetime.cell.layout import MODELS
from pisigma.lifetime.cell.status import CellStatus
from pisigma.lifetime.cell.step import ATTENTION
from pisigma.lifetime.comparison.model_pair import Displacement
from pisigma.lifetime.comparison.parameter_differences import ParameterDifferences
from pisigma.lifetime.fleet.status import UNREADABLE, FleetStatus, urgency
from pisigma.lifetime.monitoring.charts import FALSE_ALARMS_PER_YEAR, SESSIONS_PER_YEAR, Chart
from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.recalibration.movement import NORMAL_95
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.comparison_tables import comparison_tables
from pisigma.reporting.fleet_tables import ERRORS_NOTE, cell_table
from pisigma.reporting.lifetime_tables import chart_table, difference_table, session_table
from pisigma.reporting.page.drawing import AFTER, BEFORE, OTHER, Drawing, drawing_style
from pisigma.reporting.page.figures import draw_map, make_panel
from pisigma.reporting.page.page import html_page
from pisigma.reporting.rendering import markup_with_code
from pisigma.reporting.result_text import Table
from pisigma.reporting.tables import pose_rows
from pisigma.validation.held_out.model_comparison import ModelComparison
from pisigma.validation.report.error_map import Layer

_PAGE_WIDTH = 10_000
"""Width of tables on a page, which can scroll [characters]."""
Mark = tuple[datetime.date, str]
"""Day that is marked in a chart, and its label."""


def monitoring_page(
    model: CalibratedModel,
    records: Sequence[Record],
    charts: Sequence[Chart],
    sentences: Sequence[str],
    warnings: Sequence[str],
    untrusted_sessions: Sequence[tuple[str, str, str]] = (),
    marks: Mapping[str, Sequence[Mark]] = MappingProxyType({}),
    limit_mm: float | None = None,
) -> str:
    """Render sessions and charts as HTML; texts are escaped.

    Args:
        model: model with which the sessions were compared.
        records: all sessions sorted by date.
        charts: control charts of the sessions.
        sentences: sentences on all sessions together.
        warnings: sentences that warn of problems.
        untrusted_sessions: date and file of every session that must not be trusted, and the reason.
        marks: days that are marked in the chart of each quantity; days under the key "" are marked in all charts.
        limit_mm: limit on the RMS error [mm]; None if there is none.
    """
    days = [datetime.date.fromisoformat(one.date) for one in records]
    return html_page(
        "monitoring.html.j2",
        model=model,
        records=records,
        sentences=sentences,
        warnings=warnings,
        alarm=any(chart.alarm is not None for chart in charts),
        values=[
            draw_values(chart, days, _marks_of(marks, chart), limit_mm if chart.one_sided else None)
            for chart in charts
        ],
        statistics=[draw_statistics(chart, days, _marks_of(marks, chart)) for chart in charts],
        sessions=_sessions(records, untrusted_sessions),
        charts=with_badges(chart_table(charts), "alarm", {"no": "good"}),
        rate=f"{FALSE_ALARMS_PER_YEAR:g}",
        per_year=SESSIONS_PER_YEAR,
    )


def _marks_of(marks: Mapping[str, Sequence[Mark]], chart: Chart) -> list[Mark]:
    """Return the marks of a chart, including marks for all charts."""
    return [*marks.get("", ()), *marks.get(chart.quantity, ())]


def _sessions(records: Sequence[Record], refused: Sequence[tuple[str, str, str]]) -> Table:
    """Return a table of all sessions, with verdict and reason first; refused sessions have no error."""
    said = [
        _sentence(" ".join((one.session.sentence, *one.session.unobservable_sentences))) for one in records
    ]
    rows: list[tuple[str, ...]] = [
        (date, verdict, line, error, count, pays, file)
        for (date, file, count, verdict, error, pays), line in zip(
            session_table(records).rows, said, strict=True
        )
    ]
    rows += [(date, "refused", reason, "", "", "no", file) for date, file, reason in refused]
    columns = ("date", "verdict", "what has changed", "RMS [mm]", "rows", "recalibrate", "file")
    return with_badges(
        Table(columns, tuple(sorted(rows))), "verdict", {"unchanged": "good", "unclear": "doubt"}
    )


def _sentence(text: str) -> str:
    """Return a text with a capital at its start."""
    return f"{text[:1].upper()}{text[1:]}"


def with_badges(table: Table, column: str, kinds: Mapping[str, str]) -> Table:
    """Colour the cells of a column.

    Args:
        table: table of a page.
        column: name of the column.
        kinds: "good", "doubt" or "" by the text of a cell; all others are "bad".
    """
    badge = Markup('<span class="badge {}">{}</span>')
    return with_column(table, column, lambda number, cell: badge.format(kinds.get(cell, "bad"), cell))


def with_column(table: Table, column: str, cell_of: Callable[[int, str], str]) -> Table:
    """Replace the cells of a column; `cell_of` returns a cell by its row and its text."""
    place = table.columns.index(column)
    return Table(
        table.columns,
        tuple(
            (*row[:place], cell_of(number, row[place]), *row[place + 1 :])
            for number, row in enumerate(table.rows)
        ),
    )


def draw_values(
    chart: Chart, days: Sequence[datetime.date], marks: Sequence[Mark] = (), limit: float | None = None
) -> Drawing:
    """Return a chart of a quantity over the sessions with 95 % intervals, marked days, and its limit."""
    with drawing_style():
        figure, axes = make_panel()
        values, half = chart.values.numpy(), NORMAL_95 * chart.sigmas.numpy()
        if chart.one_sided:
            axes.errorbar(days, values, half, fmt="none", color=AFTER, capsize=2, linewidth=1.2)  # type: ignore[arg-type]
        else:
            axes.fill_between(days, -half, half, color=AFTER, alpha=0.15, linewidth=0)  # type: ignore[arg-type]
            for edge, label in ((half, "95 % of an unchanged robot"), (-half, "_lower end")):
                axes.plot(days, edge, "--", color=AFTER, linewidth=1.0, label=label)  # type: ignore[arg-type]
            axes.axhline(0.0, color="black", linewidth=0.6)
        axes.plot(days, values, "o", color=AFTER, markersize=4, label="_sessions")  # type: ignore[arg-type]
        if chart.alarm is not None:
            late = slice(chart.alarm, None)
            axes.plot(days[late], values[late], "s", color=BEFORE, markersize=6, label="alarm")  # type: ignore[arg-type]
        if limit is not None:
            axes.axhline(limit, color=BEFORE, linewidth=1.2, label=f"limit {limit:g} mm")
        _mark(axes, marks, days)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.1)
        quantity = "RMS error" if chart.one_sided else f"shift of {chart.quantity}"
        axes.set(ylabel=f"{quantity} [{chart.unit}]")
        _dates(axes)
    last = "unobservable" if np.isnan(values[-1]) else f"{values[-1]:z.4f} {chart.unit}"
    of = "with 95 % intervals" if chart.one_sided else "with the 95 % limits of an unchanged robot"
    alt = f"{_sentence(quantity)} in {len(days)} sessions, {of}; the last is {last}."
    return Drawing(f"{_key(chart)}_values", chart.quantity, alt, figure)


def _mark(axes: Axes, marks: Sequence[Mark], days: Sequence[datetime.date]) -> None:
    """Mark days of events by vertical lines, if they are between the first and the last session."""
    for day, label in marks:
        if days[0] <= day <= days[-1]:
            axes.axvline(day, color=OTHER, linewidth=1.0, linestyle=":")  # type: ignore[arg-type]
            axes.annotate(
                label,
                (day, 0.98),
                xycoords=("data", "axes fraction"),
                rotation=90,
                va="top",
                ha="right",
                fontsize=8,
            )


def draw_statistics(chart: Chart, days: Sequence[datetime.date], marks: Sequence[Mark] = ()) -> Drawing:
    """Draw both statistics of a chart as shares of their limits, with marked days."""
    with drawing_style():
        figure, axes = make_panel()
        for share, name, color, line in (
            (chart.ewma_to_limit_ratio, "EWMA", AFTER, "o-"),
            (chart.cusum_to_limit_ratio, "CUSUM", OTHER, "s--"),
        ):
            axes.plot(days, share.numpy(), line, color=color, label=name, markersize=3.5)  # type: ignore[arg-type]
        axes.axhline(1.0, color=BEFORE, linewidth=1.2, label="limit")
        _mark(axes, marks, days)
        axes.set(
            ylabel="share of the limit", ylim=(min(0.0, float(chart.ewma_to_limit_ratio.min()) * 1.1), None)
        )
        axes.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.1)
        _dates(axes)
    largest = float(np.maximum(chart.ewma_to_limit_ratio.numpy()[-1], chart.cusum_to_limit_ratio.numpy()[-1]))
    alt = f"EWMA and CUSUM of {chart.quantity} over their limits; the larger is {largest:.2f} at the last session."
    return Drawing(f"{_key(chart)}_statistics", chart.quantity, alt, figure)


def _key(chart: Chart) -> str:
    return chart.quantity.replace(" ", "_")


def _dates(axes: Axes) -> None:
    locator = AutoDateLocator(minticks=2, maxticks=6)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]


def fleet_page(status: FleetStatus, folder: Path) -> str:
    """Render the cells of a fleet as HTML, most urgent first; texts are escaped.

    Args:
        status: status of the fleet.
        folder: folder of the page, from which the cards of the models are linked.
    """
    place = {one.name: number for number, (one, _) in enumerate(status.sorted_by_error)}
    cells = sorted(status.cells, key=lambda one: (*urgency(one), place.get(one.name, len(place))))
    kinds = {state: "good" if state == "up_to_date" else "doubt" for state in status.states}
    bad = (UNREADABLE, *ATTENTION)
    names = {state.replace("_", " "): "bad" if state in bad else kind for state, kind in kinds.items()}
    return html_page(
        "fleet.html.j2",
        name=status.folder.resolve().name,
        today=datetime.date.today().isoformat(),
        states=[(state.replace("_", " "), len(cells)) for state, cells in status.states.items()],
        kinds=names,
        cells=with_badges(_cells(status, cells, folder), "state", names),
        note=ERRORS_NOTE,
    )


def _cells(status: FleetStatus, cells: Sequence[CellStatus], folder: Path) -> Table:
    """Return a table of all cells, with state and reason first, and links to the cards of their models."""
    link = Markup('<a href="{}">{}</a>')
    rows: list[tuple[str, ...]] = [
        (name, UNREADABLE, reason, "", "", "", "", "") for name, reason in status.unreadable.items()
    ]
    for one, (name, model, *others, state) in zip(cells, cell_table(cells).rows, strict=True):
        card = os.path.relpath(status.folder / name / MODELS / model / CARD, folder)
        linked = link.format(quote(Path(card).as_posix()), model) if model else ""
        command = Markup("<code>{}</code>").format(one.step.command) if one.step.command else ""
        rows.append(
            (
                name,
                state.replace("_", " "),
                markup_with_code(_sentence(one.step.reason)),
                command,
                linked,
                *others,
            )
        )
    columns = (
        "cell",
        "state",
        "reason",
        "next command",
        "model in use",
        "last session",
        "RMS [mm]",
        "found by",
    )
    return Table(columns, tuple(rows))


def comparison_page(
    models: Mapping[str, CalibratedModel],
    parameters: ParameterDifferences,
    tool_displacements: Mapping[str, Displacement],
    rows: ModelComparison | None,
    sentences_and_warnings: tuple[Sequence[str], Sequence[str]],
) -> str:
    """Render a comparison of two models as HTML; texts are escaped.

    Args:
        models: two models by name.
        parameters: differences of the parameters.
        tool_displacements: displacements of the tool, by description of the poses.
        rows: errors of both models on rows; None if none were given.
        sentences_and_warnings: sentences of the result, and warnings.
    """
    first, second = models
    sentences, warnings = sentences_and_warnings
    return html_page(
        "comparison.html.j2",
        names=(first, second),
        models=models,
        robot=models[first].robot,
        parameters=difference_table(parameters, (first, second)),
        differs=bool(parameters.significant_differences),
        level=f"{parameters.significance_level:.2g}",
        maps=[draw_displacement(what, one) for what, one in tool_displacements.items()],
        displacements=pose_rows({what: one.errors.figures for what, one in tool_displacements.items()}),
        rows=() if rows is None else comparison_tables(rows, "the rows", _PAGE_WIDTH),
        sentences=sentences,
        warnings=warnings,
    )


def draw_displacement(pose_description: str, displacement: Displacement) -> Drawing:
    """Draw distances between the poses of two models from above and from the side.

    Args:
        pose_description: description of the poses.
        displacement: displacement of the tool at the poses.
    """
    errors = displacement.errors
    layers = [Layer("distance", "mm", errors.position.numpy() * 1e3)]
    if errors.rotation is not None:
        layers.append(Layer("turn", "deg", np.rad2deg(errors.rotation.numpy())))
    seen = f"Distance and rotation between the poses of both models, {pose_description},"
    return draw_map(
        f"displacement_{pose_description}",
        _sentence(pose_description),
        seen,
        displacement.position.numpy() * 1e3,
        layers,
    )
