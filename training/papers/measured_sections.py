"""Recipes that reproduce no paper: mini-batches, a camera, measured robots, and the hybrid."""

from markdown_text import command_block, picture
from pisigma.reporting.tables import joint_table, markdown_table, pose_table
from pisigma.validation.held_out.training_summary import JointFigures
from pisigma.validation.held_out.validation_figures import ErrorFigures
from published import Published
from stored_results import Result, StoredResults

LEARNING_CURVES = "learning_curves.png"

HYBRIDS = {
    "rb5_hybrid": "RB5 with all error sources, hybrid",
    "ur10_hybrid": "Measured UR10, hybrid",
    "ur5_hybrid": "Measured UR5, hybrid",
}
OTHERS = ("kiro3_mini_batches", "ur5_camera", "ur10_inverse", *HYBRIDS)
"""Recipes of this section."""


def measured_sections(published: Published, results: StoredResults) -> list[str]:
    """Return the sections of these recipes."""
    found = results["ur10_inverse"]
    rows, figures = found["rows"], found["cross_validation"]
    joints = [JointFigures.model_validate(joint) for joint in results["kiro3_mini_batches"]["joints"]]
    camera = ErrorFigures.model_validate(results["ur5_camera"]["held_out"]["geometric"])
    text = [
        "### KIRO-3 at 4000 poses, mini-batches",
        command_block("kiro3_mini_batches"),
        "The table shows absolute joint errors at the training poses and at 2000 new poses:",
        joint_table(joints),
        published.notes["kiro3_mini_batches"],
        "### UR5 with a camera on the flange",
        command_block("ur5_camera"),
        "The table shows errors of the camera's pose in the frame of the board, at 2000 other postures over the whole "
        "joint space:",
        pose_table({"geometric": camera}),
        published.notes["ur5_camera"],
        "### Measured UR10, inverse calibration",
        command_block("ur10_inverse"),
        f"The table shows errors of held-out rows in {figures['folds']}-fold cross-validation; {rows['left_out']} of "
        f"{rows['used'] + rows['left_out']} rows are not used for training.",
        pose_table({name: ErrorFigures.model_validate(figures[name]) for name in ("nominal", "corrected")}),
        published.notes["ur10_inverse"],
        picture(
            LEARNING_CURVES,
            "position error of held-out rows against the number of training rows, three robots",
        ),
    ]
    for name, heading in HYBRIDS.items():
        result = results[name]
        text += [
            f"### {heading}",
            command_block(name),
            _learning_curve(result),
            f"{published.notes[name]} {_said(result)}",
        ]
    return text


def _learning_curve(result: Result) -> str:
    models = ("nominal", "geometric", "hybrid")
    head = [
        "training rows",
        *(f"{name}, RMS [mm]" for name in models),
        "hybrid, 95 % [mm]",
        "hybrid, largest [mm]",
    ]
    rows = [
        (
            str(point["rows"]),
            *(f"{point[name]['rms_mm']:.4f}" for name in models),
            *(f"{point['hybrid'][key]:.4f}" for key in ("p95_mm", "max_mm")),
            f"{100 * point['coverage']:.1f}",
        )
        for point in result["learning_curve"]
    ]
    return markdown_table([*head, "coverage [%]"], rows)


def _said(result: Result) -> str:
    whole, fit = result["seconds"], result["fit_seconds"]
    seconds = f"The run took {whole:.0f} s, of which {fit:.0f} s for the model itself."
    if "held_out" not in result:
        return seconds
    means = result["held_out"]["mean_rms_mm"]
    of = ", ".join(f"{name} {value:.4f}" for name, value in means.items())
    return f"With all rows, the RMS error averaged over the simulations is {of} mm. {seconds}"
