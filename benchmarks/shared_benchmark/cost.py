"""Tables of times, memory, failed fits and versions."""

import json

import numpy as np

from shared_benchmark.fits import LIMIT_S, Fit
from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.methods import method_of
from shared_benchmark.results import Results, table
from shared_benchmark.series import series_of

START_S = 1.3
"""Processor time for the start of a process and for its rows [s], measured over 18 fits of two methods."""


def cost_table(results: Results) -> str:
    """Return times and memory of the fits of every method."""
    done = [fit for fit in results.fits.to_pylist() if fit["status"] == "done"]
    rows = []
    for method in METHODS:
        fits = [fit for fit in done if fit["method"] == method]
        if fits:
            seconds = [fit["seconds"] for fit in fits]
            memory = max(fit["memory_mb"] for fit in fits)
            figures = [f"{np.median(seconds):.1f}", f"{max(seconds):.1f}", f"{sum(seconds):.0f}"]
            rows.append([f"`{method}`", f"{len(fits)}", *figures, f"{memory:.0f}"])
    return table(["method", "fits", "median [s]", "largest [s]", "all [s]", "memory [MB]"], rows)


def total_text(results: Results) -> str:
    """Return how long all stored fits and those of `--quick` took together, and how busy the machine was."""
    fits = [fit for fit in results.fits.to_pylist() if fit["status"] == "done" or _overran(fit)]
    waits = [fit["elapsed_seconds"] / fit["seconds"] for fit in fits if fit["elapsed_seconds"] is not None]
    text = (
        f"The {len(fits)} stored fits need {_minutes(fits):.0f} min on two free cores, those of `run --quick` "
        f"{_minutes([fit for fit in fits if _is_quick(fit)]):.1f} min; this is their processor time, with "
        f"{START_S} s for the start of every process and {LIMIT_S} s for every overrun ({sum(map(_overran, fits))})."
    )
    if waits:
        text += (
            " Other programs used the machine at the same time: by the clock, a fit took "
            f"{np.median(waits):.1f} times as long in the median."
        )
    return text


def _overran(fit: Fit) -> bool:
    return str(fit["status"]).startswith("over ")


def _minutes(fits: list[Fit]) -> float:
    """Return the time of some fits on two cores [min]."""
    return sum(START_S + (LIMIT_S if _overran(fit) else fit["seconds"]) for fit in fits) / 2 / 60


def _is_quick(fit: Fit) -> bool:
    """Return whether `--quick` runs a fit: the first fold of the first split, unless the method is slow."""
    first = next(iter(series_of(fit["series"]).splits))
    return fit["fold"] == 0 and fit["split"] == first and not method_of(fit["method"]).slow


def failures_table(results: Results) -> str:
    """Return the splits where a fit crashed, overran or was not tried."""
    rows = []
    for (name, split, method), statuses in results.statuses.items():
        wrong = [status for status in dict.fromkeys(statuses) if status != "done"]
        if wrong and not wrong[0].startswith("does not use"):
            done = f"{statuses.count('done')} of {len(statuses)}"
            status = "; ".join(wrong).replace("|", "/")
            rows.append([f"`{name}`", f"`{split}`", f"`{method}`", done, status])
    return table(["series", "split", "method", "folds done", "status"], rows)


def versions_text(results: Results) -> str:
    """Return the versions of all packages."""
    found: dict[str, set[str]] = {}
    for text in dict.fromkeys(results.fits["versions"].to_pylist()):
        for package, version in json.loads(text or "{}").items():
            found.setdefault(package, set()).add(version)
    versions = ((package, " and ".join(sorted(several))) for package, several in sorted(found.items()))
    return ", ".join(f"{package} {several}" for package, several in versions)
