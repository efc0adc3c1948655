"""A robot that touches jigs, compared with Lim et al., Tables 1 to 10."""

from jig_recipe import JigRecipe
from jig_tables import (
    Table,
    component_table,
    error_table,
    line_table,
    parameter_table,
    seed_table,
)
from markdown_text import command_block, folded, picture, plain
from pisigma.reporting.tables import markdown_table
from pisigma.robot.description import Robot
from published import Published
from redundancy_sections import dh_lines
from stored_results import Result, StoredResults

JIG_COMPARISON = "jigs.png"

SET_UPS = {
    "nominal": "nominal",
    "jig_1": "paper's {jig_1}, jig 1 alone",
    "jig_2": "paper's {jig_2}, jig 2 alone",
    "both": "paper's {both}, both jigs",
    "default": "default: everything identifiable, both jigs",
    "planned": "paper's {both}, {touches} planned from {candidates} candidates",
    "random": "paper's {both}, {touches} random touches",
}
"""Labels of the set-ups, with placeholders for numbers."""


def jig_sections(published: Published, results: StoredResults, recipe: JigRecipe) -> list[str]:
    """Return the sections of the recipe."""
    result = results["jigs"]
    return [
        command_block("jigs"),
        published.notes["jigs"],
        picture(JIG_COMPARISON, "RMS error and deviation at the test points, ours and the paper's"),
        "The tables show RMS error and deviation at the test points: our figures are averages over the seeds ± one "
        "standard deviation; those of the paper are from Tables 3 to 7 (for both jigs the mean of Tables 6 and 7, as "
        "in Table 8).",
        _averages(result),
        "The figures are defined as follows:",
        "\n".join(f"- {sentence}." for sentence in result["definitions"]),
        "### Nominal parameters of the welding robot",
        *dh_lines("welding", "welding robot", published.dh_tables["welding"]),
        _frames(published, recipe),
        "### Estimated parameters",
        "The column `true` of the following table contains the parameters of our true robot, which are the paper's "
        "result with both jigs.",
        _rendered(parameter_table(result)),
        "### Errors at the test points",
        "The figures are those of the first seed. For Tables 3 to 5 the paper does not state the frame.",
        _rendered(error_table(result)),
        folded("The same for every coordinate", _rendered(component_table(result))),
        "### One jig compared with both",
        "The ratio in Table 8 is the error with both jigs divided by the mean error with single jigs.",
        _rendered(seed_table(result)),
        _said(result),
        "### Straight lines",
        "The figures are those of the first seed.",
        _rendered(line_table(result)),
    ]


def _rendered(table: Table) -> str:
    return f"{table.title}:\n\n{markdown_table(table.columns, table.rows)}"


def _averages(result: Result) -> str:
    planning = result["planning"]
    numbers = {**result["parameters_estimated"], **planning}
    seeds = result["seeds"]
    rows = []
    for name, label in SET_UPS.items():
        figures, spreads = seeds["averages"][name], seeds["spreads"][name]
        cells = (
            f"{figures[key]:.3f} ± {spreads[key]:.3f}"
            for key in ("rms_mm", "deviation_mm", "workspace_median_mm")
        )
        rows.append((label.format(**numbers), *cells))
    head = [
        f"parameters (from 2 x {result['touches_per_jig']} touches, {seeds['count']} seeds: mean ± standard deviation)",
        "RMS at P1 to P4 [mm]",
        "deviation [mm]",
        "workspace median [mm]",
    ]
    return markdown_table(head, rows)


def _frames(published: Published, recipe: JigRecipe) -> str:
    tool = Robot.load(recipe.robot).tool
    columns = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
    ours = {f"base_{placement.name}": placement.base.to_si() for placement in recipe.placements} | {
        "tool": tool
    }
    rows = []
    for name, paper in published.nominal_frames.items():
        units = [
            value * (1e3 if c.endswith("_mm") else 57.29577951308232)
            for c, value in zip(columns, ours[name], strict=True)
        ]
        cells = []
        for column, value in zip(columns, units, strict=True):
            stated, own = paper.get(column), plain(round(float(value), 6) + 0.0)
            cells.append(
                f"lost / {own}"
                if stated is None
                else own
                if plain(stated) == own
                else f"{plain(stated)} / {own}"
            )
        rows.append((name, *cells))
    head = ["frame", *(column.replace("_mm", " [mm]").replace("_deg", " [deg]") for column in columns)]
    return (
        "The table compares the frames of Table 1 with ours, as paper / ours where they differ:\n\n"
        + markdown_table(head, rows)
    )


def _said(result: Result) -> str:
    seeds = result["seeds"]
    ratios, table = seeds["ratios"], result["paper"]["table_8_mm"]
    both = ratios["both_over_single"]
    paper = {key: table["both"][key] / table["one_jig"][key] for key in ("mean", "deviation")}
    change = 100 * (ratios["default_over_paper"]["rms"] - 1)
    return (
        f"Both jigs have {both['rms']:.2f} times the error and {both['deviation']:.2f} times the deviation of the mean "
        f"of the single jigs (paper: {paper['mean']:.2f} and {paper['deviation']:.2f}), and are better for "
        f"{100 * seeds['share_of_seeds_won_by_both']:.0f} % of the seeds. The default changes the error at the test "
        f"points by {change:+.1f} % compared with the paper's parameters. Planned touches lead to "
        f"{ratios['planned_over_random']['rms']:.2f} times the error of random touches."
    )
