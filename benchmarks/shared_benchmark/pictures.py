"""Pictures of stored results."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
import pyarrow as pa

from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.scores import RowErrors, normal_quantile
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.series import series_of

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LEARNING = ("rows_30", "rows_100", "rows_300", "random")
"""Splits with increasing numbers of training rows."""
Errors = Mapping[tuple[str, str, str], RowErrors]


def draw_learning_curves(errors: Errors, fits: pa.Table, path: Path) -> None:
    """Draw the RMS error over the number of training rows, one plot for each series with several numbers."""
    rows = {(fit["series"], fit["split"]): fit["train_rows"] for fit in fits.to_pylist()}
    names = [name for name in SERIES if sum((name, split) in rows for split in LEARNING) > 1]
    figure, axes = plt.subplots(1, max(len(names), 1), figsize=(4 * max(len(names), 1), 3.6), squeeze=False)
    for axis, name in zip(axes[0], names, strict=False):
        for method in METHODS:
            there = [split for split in LEARNING if (name, split, method) in errors]
            counts = [rows[name, split] for split in there]
            axis.plot(counts, [errors[name, split, method].rms for split in there], "o-", ms=3, label=method)
        axis.set(xscale="log", yscale="log", xlabel="training rows", title=series_of(name).title)
    axes[0][0].set_ylabel("position error of held-out rows, RMS [mm]")
    if names:
        axes[0][-1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


def draw_coverage(errors: Errors, path: Path) -> None:
    """Draw the share of coordinates within the predicted intervals over the share that shall be within."""
    wanted = np.linspace(0.05, 0.99, 60)
    figure, axis = plt.subplots(figsize=(4.2, 3.8))
    axis.plot([0, 1], [0, 1], "k:", lw=1)
    for method in METHODS:
        ratios = [
            (np.abs(one.error) / one.sigma).ravel()
            for (_, split, name), one in errors.items()
            if name == method and split not in ("box", "session", "space") and np.isfinite(one.sigma).all()
        ]
        if ratios:
            ratio = np.concatenate(ratios)
            axis.plot(
                wanted, [(ratio <= normal_quantile(float(share))).mean() for share in wanted], label=method
            )
    axis.set(xlabel="predicted share", ylabel="observed share")
    axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)
