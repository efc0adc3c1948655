"""Inverse calibration of KIRO-3 and KIRO-4 compared with Jeong et al. 1998, Tables 1 and 2."""

from collections.abc import Sequence
from typing import Any

from markdown_text import command_block, picture
from pisigma.reporting.tables import markdown_table, number_text
from published import Published
from stored_results import StoredResults

KIRO3_ENERGY = "kiro3_energy.png"
KIRO3_ERRORS = "kiro3_errors.png"
KIRO4_ENERGY = "kiro4_energy.png"
JOINT_ERRORS = "joint_errors.png"

_STATISTICS = ("average", "deviation", "maximum")


def joint_sections(published: Published, results: StoredResults) -> list[str]:
    """Return the sections of the five recipes."""
    return [
        "### KIRO-3, the method of the paper",
        *_recipe("kiro3_paper", published, results, "Table 1"),
        picture(KIRO3_ENERGY, "energy curves of the KIRO-3, the method of the paper and pisigma's default"),
        "The figure shows the training energy over the epochs in scaled units, as in Fig. 5 of the paper. The default "
        "stops at convergence.",
        picture(KIRO3_ERRORS, "joint errors of the KIRO-3 at the 100 training points, before and after"),
        "The figure shows the joint error [deg] at every training point over radius and angle, as in Figs 4 and 6 of "
        "the paper.",
        "### KIRO-3, default",
        *_recipe("kiro3", published, results, "Table 1"),
        "### KIRO-3 with wrong link lengths, base and joint offsets",
        *_recipe("kiro3_physical", published, results, "Table 1"),
        "### KIRO-4, the method of the paper",
        *_recipe("kiro4_paper", published, results, "Table 2"),
        picture(KIRO4_ENERGY, "energy curves of the KIRO-4, the method of the paper and pisigma's default"),
        "The figure shows the training energy over the epochs in scaled units, as in Fig. 8 of the paper.",
        "### KIRO-4, default",
        *_recipe("kiro4", published, results, "Table 2"),
        "### All joints before and after",
        picture(
            JOINT_ERRORS,
            "average joint errors of KIRO-3 and KIRO-4: before, paper, method of the paper, default",
        ),
        "The figure shows averages over the training points, from the tables above.",
    ]


def _recipe(name: str, published: Published, results: StoredResults, table: str) -> list[str]:
    joints = results[name]["joints"]
    return [
        command_block(name),
        f"The table compares our absolute joint errors [deg] with {table} of the paper at the training points, and "
        "shows our errors at 2000 new poses:",
        joint_comparison(joints),
        _said(joints) + " " + published.notes[name],
    ]


def joint_comparison(joints: Sequence[dict[str, Any]]) -> str:
    """Return a table of joint errors: ours, the paper's, and ours at new poses."""
    head = ["joint", *(f"{when}: {name}" for when in ("before", "after") for name in _STATISTICS)]
    rows = []
    for joint in joints:
        for label, part in (("ours", "training"), ("paper", "paper"), ("ours, new poses", "held_out")):
            figures = [
                number_text(joint[part][when][f"{name}_deg"])
                for when in ("before", "after")
                for name in _STATISTICS
            ]
            rows.append((f"{joint['name']}, {label}", *figures))
    return markdown_table(head, rows)


def _said(joints: Sequence[dict[str, Any]]) -> str:
    """Return a sentence on the ratios of averages and maxima after calibration."""
    parts = []
    for statistic in ("average", "maximum"):
        key = f"{statistic}_deg"
        ratios = {j["name"]: j["training"]["after"][key] / j["paper"]["after"][key] for j in joints}
        best, worst = (pick(ratios, key=lambda name: ratios[name]) for pick in (min, max))
        parts.append(f"the {statistic} is {ratios[best]:.2g} ({best}) to {ratios[worst]:.2g} ({worst})")
    return f"At the training points after calibration, {' and '.join(parts)} times the paper's."
