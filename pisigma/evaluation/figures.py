"""Figures of a training: energy curves, and joint errors over the workspace before and after."""

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float64
from matplotlib.figure import Figure
from torch import Tensor

ENERGY_CSV = "energy.csv"
ENERGY_PNG = "energy.png"
WORKSPACE_PNG = "errors_over_workspace.png"


def write_energy_csv(joints: Sequence[str], energies: Float64[Tensor, "epochs joints"], path: Path) -> None:
    """Write the energy of every joint in every epoch (Jeong et al. 1998, Figs 5 and 8), scaled units."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["epoch", *(f"energy_{joint}" for joint in joints)])
        writer.writerows([epoch, *row] for epoch, row in enumerate(energies.tolist(), start=1))


def draw_energy(joints: Sequence[str], energies: Float64[Tensor, "epochs joints"], path: Path) -> None:
    """Draw the energy curves on logarithmic axes; every joint has a line style of its own."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    epochs = np.arange(1, len(energies) + 1)
    styles = ("-", "--", "-.", ":")
    for index, (joint, curve) in enumerate(zip(joints, energies.t().tolist(), strict=True)):
        axes.plot(epochs, np.maximum(curve, 1e-32), styles[index % 4], label=joint, linewidth=1.6)
    axes.set(xlabel="epoch", ylabel="energy E (scaled)", xscale="log", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend()
    _save(figure, path)


def draw_errors_over_workspace(
    joints: Sequence[str],
    position: Float64[Tensor, "rows 3"],
    before: Float64[Tensor, "rows joints"],
    after: Float64[Tensor, "rows joints"],
    path: Path,
) -> None:
    """Draw the absolute joint error at every pose, seen from above, before and after (Jeong et al. 1998, Fig. 6).

    Args:
        joints: names of the corrected joints.
        position: tool positions [m].
        before: joint errors without correction, in the unit that is shown (deg, mm for a prismatic joint).
        after: the same with correction.
        path: the PNG to write.
    """
    figure, grid = plt.subplots(
        len(joints), 2, figsize=(8.4, 3.1 * len(joints)), layout="constrained", squeeze=False, sharex=True, sharey=True
    )
    x, y = (position[:, axis].numpy() * 1e3 for axis in (0, 1))
    for row, joint in enumerate(joints):
        for column, (errors, when) in enumerate(((before, "before"), (after, "after"))):
            axes = grid[row][column]
            values = errors[:, row].abs().numpy()
            dots = axes.scatter(x, y, c=values, s=9, cmap="viridis", vmin=0.0, vmax=max(float(values.max()), 1e-12))
            bar = figure.colorbar(dots, ax=axes)
            bar.formatter.set_powerlimits((-2, 3))
            bar.set_label("|error| [deg]" if joint.startswith("theta") else "|error|")
            axes.set_title(f"{joint} {when}: mean {values.mean():.2g}, max {values.max():.2g}", fontsize=9)
            axes.set_aspect("equal")
    for axes in grid[-1]:
        axes.set_xlabel("x [mm]")
    for row in grid:
        row[0].set_ylabel("y [mm]")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=120, metadata={"Software": "pisigma"})
    plt.close(figure)
