"""Pictures of stored results."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.ticker
import numpy as np
import pyarrow as pa

from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.scores import RowErrors, normal_quantile, rms_interval
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.series import series_of
from shared_benchmark.splits import SPLITS

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LEARNING = ("rows_30", "rows_100", "rows_300", "random")
"""Splits with increasing numbers of training rows."""
COLOURS = 10
"""Number of colours; further methods get them again, with dashed lines."""
LABELS = matplotlib.ticker.FuncFormatter(lambda value, _: f"{value:g}")
Errors = Mapping[tuple[str, str, str], RowErrors]


def draw_accuracy(errors: Errors, path: Path) -> None:
    """Draw the RMS errors of all splits with their 95 % intervals, one plot for each series."""
    names = [name for name in SERIES if name in {key[0] for key in errors}]
    figure, axes = plt.subplots(2, -(-len(names) // 2), figsize=(14, 7), squeeze=False, layout="constrained")
    for axis, name in zip(axes.flat, names, strict=False):
        splits = [split for split in SPLITS if any(key[:2] == (name, split) for key in errors)]
        for number, method in enumerate(METHODS):
            there = [split for split in splits if (name, split, method) in errors]
            found = [errors[name, split, method] for split in there]
            rms = np.array([one.rms for one in found])
            intervals = np.array([rms_interval(one) for one in found]).reshape(-1, 2).T
            places = [splits.index(split) + (number / len(METHODS) - 0.5) * 0.7 for split in there]
            bars = np.abs(intervals - rms)
            axis.errorbar(places, rms, bars, fmt="o", ms=4, lw=1, **_style(number, line=False))
        axis.set(yscale="log", title=series_of(name).title)
        axis.set_xticks(range(len(splits)), splits, rotation=30, ha="right", fontsize=8)
        _plain_ticks(axis.yaxis)
        axis.grid(axis="y", which="both", alpha=0.25)
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    for row in axes:
        row[0].set_ylabel("position error of held-out rows, RMS [mm]")
    _legend(figure, errors)
    _save(figure, path)


def draw_learning_curves(errors: Errors, fits: pa.Table, path: Path) -> None:
    """Draw the RMS error against the number of training rows, one plot for each series with several numbers."""
    rows = {(fit["series"], fit["split"]): fit["train_rows"] for fit in fits.to_pylist()}
    names = [name for name in SERIES if sum((name, split) in rows for split in LEARNING) > 1]
    count = max(len(names), 1)
    figure, axes = plt.subplots(1, count, figsize=(4 * count + 1.5, 4), squeeze=False, layout="constrained")
    for axis, name in zip(axes[0], names, strict=False):
        for number, method in enumerate(METHODS):
            there = [split for split in LEARNING if (name, split, method) in errors]
            counts = [rows[name, split] for split in there]
            values = [errors[name, split, method].rms for split in there]
            axis.plot(counts, values, marker="o", ms=4, **_style(number))
        axis.set(xscale="log", yscale="log", xlabel="training rows", title=series_of(name).title)
        axis.set_xticks([rows[name, split] for split in LEARNING if (name, split) in rows])
        axis.xaxis.set_major_formatter(LABELS)
        axis.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
        _plain_ticks(axis.yaxis)
        axis.grid(which="both", alpha=0.25)
    axes[0][0].set_ylabel("position error of held-out rows, RMS [mm]")
    _legend(figure, errors)
    _save(figure, path)


def draw_coverage(errors: Errors, path: Path) -> None:
    """Draw the share of coordinates within the predicted intervals over the nominal share."""
    wanted = np.linspace(0.05, 0.99, 60)
    figure, axis = plt.subplots(figsize=(4.2, 3.8), layout="constrained")
    axis.plot([0, 1], [0, 1], "k:", lw=1)
    for number, method in enumerate(METHODS):
        ratios = [
            (np.abs(one.error) / one.sigma).ravel()
            for (_, split, name), one in errors.items()
            if name == method and split not in ("box", "session", "space") and np.isfinite(one.sigma).all()
        ]
        if ratios:
            ratio = np.concatenate(ratios)
            shares = [(ratio <= normal_quantile(float(share))).mean() for share in wanted]
            axis.plot(wanted, shares, label=method, **_style(number))
    axis.set(xlabel="predicted share", ylabel="observed share")
    axis.legend(fontsize=7)
    _save(figure, path)


def _style(number: int, line: bool = True) -> dict[str, Any]:
    """Return the colour of a method by its number, the dashes and the width of its line."""
    colour = f"C{number % COLOURS}"
    filled = {} if number < COLOURS else {"mfc": "white"}
    if not line:
        return {"color": colour, **filled}
    ours = METHODS[number] == "hybrid"
    return {"color": colour, "ls": "-" if number < COLOURS else "--", "lw": 2.5 if ours else 1.2, **filled}


def _plain_ticks(axis: Any) -> None:
    """Show six plain numbers a decade."""
    axis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter(LABELS)
    axis.set_minor_locator(matplotlib.ticker.NullLocator())


def _legend(figure: Any, errors: Errors) -> None:
    """Show the names of the methods with results beside the plots."""
    there = {key[2] for key in errors}
    lines = [
        plt.Line2D([], [], marker="o", ms=4, label=method, **_style(number))
        for number, method in enumerate(METHODS)
        if method in there
    ]
    figure.legend(handles=lines, loc="outside right upper", fontsize=8)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
