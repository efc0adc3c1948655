"""The card of trained networks: what they are, how they were made, how good they are and what nobody checked."""

import math
from pathlib import Path

from pisigma.judging.training_summary import TrainingRun, TrainingSummary
from pisigma.reporting import figures
from pisigma.reporting.cards import CardTexts
from pisigma.reporting.rendering import write_card


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
    figures.write_energy_csv(joints, energies, folder / figures.ENERGY_CSV)
    figures.draw_energy(joints, energies, folder / figures.ENERGY_PNG)
    shown = run.held_out or run.training
    robot = run.model.robot
    names = [joint.name for joint in robot.joints]
    index = [names.index(joint) for joint in joints]
    units = ["deg" if robot.revolute[i] else "mm" for i in index]
    scale = shown.before.new_tensor([math.degrees(1) if unit == "deg" else 1e3 for unit in units])
    before, after = shown.before[:, index] * scale, shown.after[:, index] * scale
    figures.draw_errors_over_workspace(
        joints, units, shown.T[:, :3, 3], before, after, folder / figures.WORKSPACE_PNG
    )
    groups = run.model.network.groups if run.model.network else ()
    inputs = dict.fromkeys(name for group in groups for name in group.inputs.names)
    content = {
        "name": name,
        "texts": texts,
        "run": run,
        "summary": summary,
        "inputs": inputs,
        "figures": figures,
    }
    write_card(folder, "training_card.md.j2", **content)
