"""All pictures of the page."""

from pathlib import Path

from comparison_pictures import draw_jigs, draw_joint_errors, draw_learning_curves
from course_pictures import draw_energies, draw_errors_on_grid, draw_rmse
from jig_sections import JIG_COMPARISON
from joint_sections import JOINT_ERRORS, KIRO3_ENERGY, KIRO3_ERRORS, KIRO4_ENERGY
from markdown_text import FIGURES
from measured_sections import HYBRIDS, LEARNING_CURVES
from published import Published
from redundancy_sections import RMSE_BY_ITERATION, ROBOTS
from stored_results import StoredResults


def draw_pictures(folder: Path, published: Published, results: StoredResults) -> None:
    """Draw all pictures into the folder `figures` next to the page.

    Args:
        folder: The folder of the recipes.
        published: Figures of the papers.
        results: Our results.

    Raises:
        RecipeError: A result is missing.
    """
    target = folder / FIGURES
    target.mkdir(exist_ok=True)
    for robot, file in (("kiro3", KIRO3_ENERGY), ("kiro4", KIRO4_ENERGY)):
        ways = {
            "method of the paper": results[f"{robot}_paper"]["energies"],
            "default": results[robot]["energies"],
        }
        draw_energies(ways, target / file)
    draw_errors_on_grid(results["kiro3_paper"]["points"], target / KIRO3_ERRORS)
    draw_joint_errors(
        {
            name: (results[f"{robot}_paper"]["joints"], results[robot]["joints"])
            for robot, name in (("kiro3", "KIRO-3"), ("kiro4", "KIRO-4"))
        },
        target / JOINT_ERRORS,
    )
    draw_rmse(
        {
            title: (published.convergence[robot], results[f"{robot}_redundancy"])
            for robot, title in ROBOTS.items()
        },
        target / RMSE_BY_ITERATION,
    )
    draw_jigs(results["jigs"], target / JIG_COMPARISON)
    draw_learning_curves({title: results[name] for name, title in HYBRIDS.items()}, target / LEARNING_CURVES)
