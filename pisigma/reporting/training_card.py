"""The card of trained networks: what they are, how they were made, how good they are and what nobody checked."""

import math
from pathlib import Path

from pisigma.judging.training_summary import TrainingRun, TrainingSummary
from pisigma.reporting.calibration_card import CardTexts
from pisigma.reporting.figures import (
    ENERGY_CSV,
    ENERGY_PNG,
    WORKSPACE_PNG,
    draw_energy,
    draw_errors_over_workspace,
    write_energy_csv,
)
from pisigma.reporting.tables import CARD, joint_table, pose_table, use_text


def write_training_card(
    name: str, texts: CardTexts, run: TrainingRun, summary: TrainingSummary, folder: Path
) -> None:
    """Write the card and its figures into a model folder.

    Args:
        name: of the model.
        texts: description, and what was not validated.
        run: what came out.
        summary: all figures.
        folder: where to write.
    """
    joints, energies = run.history.joints, run.history.energies
    write_energy_csv(joints, energies, folder / ENERGY_CSV)
    draw_energy(joints, energies, folder / ENERGY_PNG)
    shown = run.held_out or run.training
    robot = run.model.robot
    names = [joint.name for joint in robot.joints]
    index = [names.index(joint) for joint in joints]
    units = ["deg" if robot.revolute[i] else "mm" for i in index]
    scale = shown.before.new_tensor([math.degrees(1) if unit == "deg" else 1e3 for unit in units])
    before, after = shown.before[:, index] * scale, shown.after[:, index] * scale
    draw_errors_over_workspace(joints, units, shown.T[:, :3, 3], before, after, folder / WORKSPACE_PNG)
    (folder / CARD).write_text(_card_text(name, texts, run, summary), encoding="utf-8")


def _card_text(name: str, texts: CardTexts, run: TrainingRun, summary: TrainingSummary) -> str:
    where = "held-out" if run.held_out else "training"
    parts = [
        f"# {name}",
        texts.description.strip(),
        f"Made by `{summary.command}`.",
        "## Data",
        _data_text(run),
        "## Joint errors",
        _joint_text(run, summary),
        joint_table(summary.joints),
        *_pose_error_parts(summary),
        "## Figures",
        f"Training energy of every joint over the epochs ([values]({ENERGY_CSV})): half the mean square "
        "of the error, in units of the range of the training targets.",
        f"![energy curves]({ENERGY_PNG})",
        f"Absolute joint errors at the {where} poses, seen from above; each panel has its own colour scale:",
        f"![errors over the workspace]({WORKSPACE_PNG})",
        "## Domain",
        _domain_text(run),
        "## Not validated",
        texts.not_validated.strip(),
        "## Use",
        use_text(name),
        "## Provenance",
        _provenance_text(run),
    ]
    return "\n\n".join(parts) + "\n"


def _pose_error_parts(summary: TrainingSummary) -> list[str]:
    parts = []
    if summary.cross_validation is not None:
        parts += ["## Held-out pose errors", summary.verdict or ""]
        parts.append(pose_table(summary.cross_validation.models))
    if summary.test is not None:
        parts += [
            "## Pose errors of the test set",
            f"The {summary.test.rows} rows that the file marks as test; nothing was trained on them.",
            pose_table(summary.test.models),
        ]
    return parts


def _data_text(run: TrainingRun) -> str:
    provenance = run.model.provenance
    origin = "simulated rows" if run.held_out else f"rows of `{provenance.data_source}`"
    left_out = (
        f"{provenance.rows_left_out} left out ({provenance.rule})" if provenance.rule else "none left out"
    )
    text = f"Trained on {provenance.rows} {origin}, {left_out}."
    return (
        f"{text} Judged on {len(run.held_out.T)} other simulated rows (held-out)." if run.held_out else text
    )


def _joint_text(run: TrainingRun, summary: TrainingSummary) -> str:
    """What the table shows."""
    parts = [
        "Absolute error of the joint values: average, standard deviation and maximum over the rows, before "
        "(nominal inverse kinematics) and after the learned correction."
    ]
    if run.held_out is None:
        parts.append("These are the rows that the network was fitted to.")
    if any(joint.paper for joint in summary.joints):
        parts.append('Lines "paper" are the published figures.')
    return " ".join(parts)


def _domain_text(run: TrainingRun) -> str:
    model = run.model
    branches = f" on the branch {', '.join(f'`{name}`' for name in model.branches)}" if model.branches else ""
    groups = model.network.groups if model.network else ()
    inputs = dict.fromkeys(name for group in groups for name in group.inputs.names)
    return (
        f"Learned{branches} from the inputs {', '.join(f'`{name}`' for name in inputs)}. A pose is inside "
        "the domain when its scaled inputs lie no farther from the nearest training row than training rows "
        "lie from each other (5 % margin); elsewhere the status is `OUTSIDE_DOMAIN` and the correction is "
        "extrapolated. Joints that are not in the table are not corrected, and poses that differ only in "
        "what is no input get the same correction."
    )


def _provenance_text(run: TrainingRun) -> str:
    provenance = run.model.provenance
    versions = ", ".join(f"{name} {value}" for name, value in provenance.versions.items())
    return "\n".join(
        [
            f"- recipe `{provenance.recipe}`, sha256 `{provenance.recipe_sha256}`",
            f"- data `{provenance.data_source}`, sha256 of the values `{provenance.data_sha256}`",
            f"- seed {provenance.seed}; {versions}",
        ]
    )
