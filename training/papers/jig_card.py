"""The card of a model that was calibrated on jigs: comparison with the tables of the paper, and pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jig_figures import (
    ERRORS_PNG,
    LINES_PNG,
    SEEDS_PNG,
    TOUCHES_PNG,
    draw_errors,
    draw_lines,
    draw_seeds,
    draw_touches,
)
from jig_report import BOTH, DEFAULT, PLANNED, RANDOM, JigRun
from jig_tables import Table, all_tables
from pisigma.files.model_files import CARD
from pisigma.model.calibrated_model import CalibratedModel

_SETUPS = {"nominal": "nominal", BOTH: "both", DEFAULT: "both, default"}


def write_jig_card(
    model: CalibratedModel, run: JigRun, report: Mapping[str, Any], texts: Mapping[str, str], folder: Path
) -> None:
    """Write the card and the pictures into a model folder.

    Args:
        model: The model of the folder.
        run: The run of the recipe.
        report: Report from `report_jigs`.
        texts: Texts "description", "command" and "not_validated".
        folder: Folder to write to.
    """
    recipe = run.bench.recipe
    alone = {frame: f"{frame} alone" for frame in recipe.frames}
    jigs = {placement.name: placement.load_jig() for placement in recipe.placements}
    draw_touches(jigs, run.planned_from, run.plan.chosen, folder / TOUCHES_PNG)
    shown = {name: run.accuracies[name] for name in ("nominal", *recipe.frames, BOTH, DEFAULT, PLANNED)}
    labels = {**_SETUPS, **alone, PLANNED: f"{len(run.plan.chosen)} planned touches"}
    draw_errors(shown, labels, folder / ERRORS_PNG)
    lines = {name: run.lines[name] for name in ("nominal", BOTH)}
    if recipe.lines:
        draw_lines(lines, {"nominal": "nominal", BOTH: "calibrated on both"}, folder / LINES_PNG)
    columns = alone | {BOTH: "both", DEFAULT: "both,\ndefault", PLANNED: "planned", RANDOM: "random"}
    draw_seeds(run.seeds, columns, recipe.frames, folder / SEEDS_PNG)
    (folder / CARD).write_text(_text(model, report, texts, bool(recipe.lines)), encoding="utf-8")


def _text(model: CalibratedModel, report: Mapping[str, Any], texts: Mapping[str, str], lines: bool) -> str:
    provenance, planning, seeds = model.provenance, report["planning"], report["seeds"]
    tables = {table.title: table for table in all_tables(report)}
    per_jig = "; ".join(
        f"{name}: " + ", ".join(f"{count} along {axis}" for axis, count in axes.items())
        for name, axes in planning["per_jig"].items()
    )
    parts = [
        f"# {model.name}",
        texts["description"].strip(),
        f"Made by `{texts['command']}` from {provenance.rows} simulated touches. The model's parameters are those "
        f"of pisigma's default with all jigs. Noise: {_noise(report['noise'])}.",
        "## Definitions",
        "\n".join(f"- {sentence}." for sentence in report["definitions"]),
        *(f"## {title}\n\n{_markdown(table)}" for title, table in tables.items()),
        f"![errors at the test points and over the workspace]({ERRORS_PNG})",
        "## Seed by seed",
        f"Touches and noise are drawn with {seeds['count']} seeds. For single seeds either can be better: both jigs "
        f"were better than the mean of the single jigs for {seeds['share_of_seeds_won_by_both']:.0%}; only the "
        "averages are significant.",
        f"![errors of every seed]({SEEDS_PNG})",
    ]
    if lines:
        parts += ["## The lines", f"![deviation along the straight lines]({LINES_PNG})"]
    parts += [
        "## Planned touches",
        f"{planning['touches']} of {planning['candidates']} candidates, chosen to lower the predicted position error "
        f"over the workspace ({planning['predicted_rms_mm']:.3f} mm RMS; {planning['exchanges']} exchanges). "
        f"{per_jig}.",
        f"![the chosen touches on the jigs]({TOUCHES_PNG})",
        "## Weakly determined directions",
        "\n".join(f"- {sentence.rstrip('.')}." for sentence in report["weak_directions"])
        or "No direction is weakly determined.",
        "## Not validated",
        texts["not_validated"].strip(),
        "## Provenance",
        f"Data sha256 `{provenance.data_sha256}`; "
        + ", ".join(f"{name} {value}" for name, value in provenance.versions.items()),
    ]
    return "\n\n".join(parts) + "\n"


def _noise(noise: Mapping[str, Any]) -> str:
    return f"{noise['sensor_mm']:g} mm of a touch, {noise['repeatability_mm']:g} mm repeatability per axis"


def _markdown(table: Table) -> str:
    lines: list[Sequence[str]] = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
