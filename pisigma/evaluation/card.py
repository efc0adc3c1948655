"""The card of a model: what it is, how it was made, how good it is and what nobody checked."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pisigma.evaluation.figures import (
    ENERGY_CSV,
    ENERGY_PNG,
    WORKSPACE_PNG,
    draw_energy,
    draw_errors_over_workspace,
    write_energy_csv,
)
from pisigma.training.recipe import Recipe
from pisigma.training.run import TrainingRun

CARD = "README.md"

_STATISTICS = ("average", "deviation", "maximum")


def write_card(recipe: Recipe, command: str, run: TrainingRun, report: Mapping[str, Any], folder: Path) -> None:
    """Write the card and its figures into a model folder.

    Args:
        recipe: what was trained.
        command: the command line that makes this model.
        run: what came out.
        report: from `report_training`.
        folder: where to write.
    """
    write_energy_csv(run.history.joints, run.history.energies, folder / ENERGY_CSV)
    draw_energy(run.history.joints, run.history.energies, folder / ENERGY_PNG)
    shown = run.held_out or run.training
    names = [joint.name for joint in run.model.robot.joints]
    index = [names.index(joint) for joint in run.history.joints]
    factor = [57.29577951308232 if run.model.robot.revolute[i] else 1e3 for i in index]
    scale = shown.before.new_tensor(factor)
    before, after = shown.before[:, index] * scale, shown.after[:, index] * scale
    draw_errors_over_workspace(run.history.joints, shown.T[:, :3, 3], before, after, folder / WORKSPACE_PNG)
    (folder / CARD).write_text(_card_text(recipe, command, run, report), encoding="utf-8")


def _card_text(recipe: Recipe, command: str, run: TrainingRun, report: Mapping[str, Any]) -> str:
    provenance = run.model.provenance
    where = "held-out" if run.held_out else "training"
    parts = [
        f"# {recipe.name}",
        recipe.description.strip(),
        f"Made by `{command}`, on {provenance.rows} rows of {provenance.data_source} "
        f"({provenance.rows_left_out} left out{': ' + provenance.rule if provenance.rule else ''}).",
        "## Joint errors",
        joint_table(report["joints"]),
    ]
    if "cross_validation" in report:
        parts += ["## Held-out pose errors", report["verdict"], pose_table(report["cross_validation"])]
    parts += [
        "## Figures",
        f"Energy of every joint over the epochs ([values]({ENERGY_CSV})):",
        f"![energy curves]({ENERGY_PNG})",
        f"Joint errors over the workspace, {where} poses, before and after:",
        f"![errors over the workspace]({WORKSPACE_PNG})",
        "## Domain",
        _domain_text(run),
        "## Not validated",
        recipe.not_validated.strip(),
        "## Use",
        f'```python\nimport pisigma\n\nik = pisigma.load("models/{recipe.name}")\nsolution = ik(T_base_tool)  # (*batch, 4, 4), '
        "metres\nsolution.q, solution.correction, solution.status\n```",
        "## Provenance",
        _provenance_text(run),
    ]
    return "\n\n".join(parts) + "\n"


def joint_table(joints: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table of the joint errors; one line per joint and part, before and after side by side."""
    lines = [
        "| joint | rows | before: average | deviation | maximum | after: average | deviation | maximum |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for joint in joints:
        for part, label in (("training", "training"), ("held_out", "held-out"), ("paper", "paper")):
            if part in joint:
                cells = [_figure(joint[part][when], name) for when in ("before", "after") for name in _STATISTICS]
                lines.append(f"| {joint['name']} | {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def pose_table(figures: Mapping[str, Any]) -> str:
    """A Markdown table of pose errors, one line per model."""
    models = [name for name, value in figures.items() if isinstance(value, Mapping)]
    columns = list(figures[models[0]])
    head = ["| model | " + " | ".join(column.replace("_", " ") for column in columns) + " |"]
    head.append("|---" * (len(columns) + 1) + "|")
    rows = [f"| {name} | " + " | ".join(f"{figures[name][column]:.3f}" for column in columns) + " |" for name in models]
    return "\n".join(head + rows)


def _figure(statistics: Mapping[str, float], name: str) -> str:
    key = next(key for key in statistics if key.startswith(name))
    return f"{statistics[key]:.4f} {key.rsplit('_', 1)[1]}"


def _domain_text(run: TrainingRun) -> str:
    model = run.model
    branches = f" on the branch {', '.join(model.branches)}" if model.branches else ""
    inputs = sorted({name for group in model.network.groups for name in group.inputs.names}) if model.network else []
    return (
        f"Learned{branches} from the inputs {', '.join(inputs)}. A pose is inside the domain when its scaled inputs lie "
        "no farther from a training row than training rows lie from each other (5 % margin); outside, the status says so. "
        "Joints that are not in the table above are not corrected, and poses that differ in coordinates that are no "
        "input get the same correction."
    )


def _provenance_text(run: TrainingRun) -> str:
    provenance = run.model.provenance
    versions = ", ".join(f"{name} {value}" for name, value in provenance.versions.items())
    return "\n".join(
        [
            f"- recipe `{provenance.recipe}`, sha256 `{provenance.recipe_sha256}`",
            f"- data {provenance.data_source}, sha256 `{provenance.data_sha256}`",
            f"- seed {provenance.seed}; {versions}",
        ]
    )
