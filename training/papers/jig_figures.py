"""Pictures of the recipe of jigs: touches, errors, straight lines, and differences between seeds."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from mpl_toolkits.mplot3d.art3d import (  # type: ignore[import-untyped]
    Line3DCollection,
    Poly3DCollection,
)
from torch import Tensor

from jig_accuracy import Accuracy
from pisigma.measurement.jig import Jig
from pisigma.reporting.figures import save_figure
from pisigma.simulation.touch_candidates import TouchCandidates
from straight_lines import TrackedLine

TOUCHES_PNG = "touches.png"
ERRORS_PNG = "errors.png"
LINES_PNG = "straight_lines.png"
SEEDS_PNG = "seeds.png"

AXES = (("x", "tab:red", "o"), ("y", "tab:green", "s"), ("z", "tab:blue", "^"))
TORCH = 0.06
"""Length of the torch that is drawn at a touch [m]."""


def draw_touches(
    jigs: Mapping[str, Jig], candidates: TouchCandidates, chosen: Int64[Tensor, " chosen"], path: Path
) -> None:
    """Draw every jig in its frame, the candidates as dots, and the chosen touches with the tip of the torch.

    Args:
        jigs: Jigs by placement.
        candidates: All candidates.
        chosen: Indices of the chosen candidates.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(6.6 * len(jigs), 6.4), layout="constrained")
    picked = candidates.select(chosen)
    for place, (name, jig) in enumerate(jigs.items(), start=1):
        axes = figure.add_subplot(1, len(jigs), place, projection="3d", computed_zorder=False)
        axes.add_collection3d(
            Poly3DCollection(_faces(jig) * 1e3, facecolor="0.8", edgecolor="0.35", alpha=0.12, zorder=1)
        )
        here = _tips(candidates, name)
        axes.scatter(*here.T, s=3, color="0.3", alpha=0.5, linewidths=0, depthshade=False, zorder=2)
        own = picked.select(torch.tensor([frame == name for frame in picked.frame]))
        for axis, (label, colour, marker) in enumerate(AXES):
            some = own.select(own.axis == axis)
            tips = _tips(some, name)
            shafts = tips - 1e3 * TORCH * some.T_jig_tool[:, :3, 2].numpy()
            lines = np.stack([tips, shafts], 1)
            axes.add_collection3d(Line3DCollection(lines, color=colour, linewidth=0.7, alpha=0.7, zorder=3))
            text = f"{label}: {some.count}"
            axes.scatter(*tips.T, s=16, color=colour, marker=marker, label=text, depthshade=False, zorder=4)
        axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
        axes.set_title(f"{name}: {own.count} touches of {len(here)} candidates")
        low, high = jig.lower.amin(0).numpy() * 1e3, jig.upper.amax(0).numpy() * 1e3
        axes.set(
            xlim=(low[0] - 30, high[0] + 30), ylim=(low[1] - 30, high[1] + 30), zlim=(low[2], high[2] + 60)
        )
        axes.set_aspect("equal")
        axes.view_init(elev=32, azim=38)
        axes.legend(title="touched along", loc="upper left")
    save_figure(figure, path)


def draw_errors(accuracies: Mapping[str, Accuracy], labels: Mapping[str, str], path: Path) -> None:
    """Draw the errors at the test points and the distribution of those over the workspace.

    Args:
        accuracies: Accuracies by set-up.
        labels: Labels in the legend.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(10.4, 5.2), layout="constrained")
    points, spread = figure.subplots(1, 2)
    styles = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
    markers = ("o", "s", "^", "v", "D", "P")
    for place, (name, accuracy) in enumerate(accuracies.items()):
        label, style = labels[name], styles[place % len(styles)]
        lengths = accuracy.points.norm(dim=-1).numpy() * 1e3
        at = np.arange(len(lengths)) + 0.09 * (place - (len(accuracies) - 1) / 2)
        points.plot(at, lengths, markers[place % len(markers)], label=label, color=f"C{place}")
        known = np.sort(accuracy.workspace.numpy()) * 1e3
        share = np.arange(1, len(known) + 1) / len(known)
        median = float(np.median(known))
        spread.plot(
            known, share, linestyle=style, color=f"C{place}", label=f"{label}: median {median:.2f} mm"
        )
    points.set_xticks(range(len(lengths)), [f"P{place + 1}" for place in range(len(lengths))])
    points.set(yscale="log", ylabel="distance from the test point [mm]", ylim=(0.05, None))
    points.set_title("test points, robot frame, first seed", fontsize=10)
    points.grid(alpha=0.3, axis="y")
    points.yaxis.set_major_formatter("{x:g}")
    points.yaxis.set_minor_formatter(NullFormatter())
    spread.set(xscale="log", ylim=(0, 1), xlabel="position error [mm]", ylabel="share of the workspace below")
    spread.set_title("workspace, robot frame, first seed", fontsize=10)
    spread.xaxis.set_major_formatter("{x:g}")
    spread.grid(alpha=0.3)
    figure.legend(*spread.get_legend_handles_labels(), loc="outside lower left", ncols=3, fontsize=8)
    figure.legend(*points.get_legend_handles_labels(), loc="outside lower right", ncols=2, fontsize=8)
    save_figure(figure, path)


def draw_lines(
    lines: Mapping[str, Mapping[str, tuple[TrackedLine, TrackedLine]]], labels: Mapping[str, str], path: Path
) -> None:
    """Draw the deviation of the true tool along every line, per axis.

    Args:
        lines: Move-L and I-Move, by set-up and line.
        labels: Labels of the set-ups in the titles.
        path: The PNG file to write.
    """
    names = list(next(iter(lines.values())))
    columns = [(setup, kind) for kind in (0, 1) for setup in lines]
    figure = Figure(figsize=(3.5 * len(columns), 2.5 * len(names) + 0.4), layout="constrained")
    grid = figure.subplots(len(names), len(columns), squeeze=False, sharex="row")
    for row, name in enumerate(names):
        for column, (setup, kind) in enumerate(columns):
            axes, line = grid[row][column], lines[setup][name][kind]
            way = (line.wanted - line.wanted[0]).norm(dim=-1).numpy() * 1e3
            for (label, colour, _), style, values in zip(
                AXES, ("-", "--", "-."), line.deviation.t().numpy() * 1e3, strict=True
            ):
                axes.plot(way, values, style, color=colour, label=f"d{label}")
            axes.axhline(0, color="black", linewidth=0.6)
            top = max(1.1 * float(line.deviation.abs().max()) * 1e3, 0.1)
            axes.set_ylim(-top, top)
            axes.grid(alpha=0.3)
            axes.tick_params(labelsize=8)
            title = f"{name}\n" if column == 0 else "\n"
            axes.set_title(
                f"{title}{'I-Move' if kind else 'Move-L'}, {labels[setup]}", fontsize=9, loc="left"
            )
            if kind:
                axes.text(
                    0.03, 0.05, f"dL {line.length_error * 1e3:+.2f} mm", transform=axes.transAxes, fontsize=8
                )
        grid[row][0].set_ylabel("deviation [mm]", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("distance along the line [mm]", fontsize=9)
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=3, fontsize=9)
    save_figure(figure, path)


def draw_seeds(
    seeds: Mapping[str, Mapping[str, Float64[np.ndarray, " seeds"]]],
    labels: Mapping[str, str],
    single: tuple[str, ...],
    path: Path,
) -> None:
    """Draw every seed's RMS error at the test points, and the ratio of all jigs to the mean of single ones.

    Args:
        seeds: Values by set-up and figure [m].
        labels: Labels of the set-ups; those without a label are not drawn.
        single: Set-ups with single jigs.
        path: The PNG file to write.
    """
    figure = Figure(figsize=(11.4, 4.6), layout="constrained")
    values, ratio = figure.subplots(1, 2, width_ratios=(2, 1))
    shown = [name for name in seeds if name in labels]
    for place, name in enumerate(shown):
        errors = seeds[name]["rms"] * 1e3
        shift = 0.5 * (np.arange(len(errors)) + 0.5) / len(errors) - 0.25
        values.plot(place + shift, errors, "o", markersize=3.5, alpha=0.6, color=f"C{place}")
        values.hlines(errors.mean(), place - 0.35, place + 0.35, color="black", linewidth=1.6)
        values.text(place + 0.37, errors.mean(), f"{errors.mean():.2f}", va="center", fontsize=8)
    values.set_xticks(range(len(shown)), [labels[name] for name in shown], fontsize=8)
    values.set(ylim=(0, None), xlim=(-0.5, len(shown) - 0.2), ylabel="RMS error at the test points [mm]")
    values.set_title("one dot per seed, line: mean", fontsize=10)
    values.grid(alpha=0.3, axis="y")
    mean = np.mean([seeds[name]["rms"] for name in single], axis=0)
    ratios = np.sort(seeds["both"]["rms"] / mean)
    ratio.step(ratios, np.arange(1, len(ratios) + 1) / len(ratios), where="post")
    ratio.axvline(1.0, color="black", linewidth=1, linestyle="--")
    won = float((ratios < 1).mean())
    ratio.set(xlabel="all jigs / mean of single jigs, per seed", ylabel="share of seeds below", ylim=(0, 1))
    title = f"ratio of means {seeds['both']['rms'].mean() / mean.mean():.2f}; below 1 in {won:.0%} of {len(ratios)}"
    ratio.set_title(title, fontsize=10)
    ratio.grid(alpha=0.3)
    save_figure(figure, path)


def _tips(candidates: TouchCandidates, placement: str) -> Float64[np.ndarray, "touches 3"]:
    """Return tips on one placement in its frame [mm]."""
    own = torch.tensor([frame == placement for frame in candidates.frame], dtype=torch.bool)
    tips: np.ndarray = candidates.T_jig_tool[own, :3, 3].numpy() * 1e3
    return tips


def _faces(jig: Jig) -> Float64[np.ndarray, "faces 4 3"]:
    """Return corners of all faces of all blocks [m]."""
    found = []
    for low, high in zip(jig.lower.numpy(), jig.upper.numpy(), strict=True):
        bounds = np.stack([low, high])
        for axis, end in product(range(3), range(2)):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            corners = np.empty((4, 3))
            corners[:, axis] = bounds[end, axis]
            corners[:, u] = bounds[[0, 1, 1, 0], u]
            corners[:, v] = bounds[[0, 0, 1, 1], v]
            found.append(corners)
    return np.array(found)
