"""The page of the documentation, made from stored results alone."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa

from shared_benchmark.fits import LIMIT_S
from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.methods import method_of
from shared_benchmark.pictures import draw_coverage, draw_learning_curves
from shared_benchmark.scores import DRAWS, RowErrors, ratio_interval
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.series import series_of
from shared_benchmark.splits import SPLITS
from shared_benchmark.store import errors_of, read

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "explanation" / "benchmark.md"
FIGURES = DOCS / "figures"
OURS = "hybrid"
TEMPLATE = Path(__file__).parent / "page.md"


@dataclass(frozen=True, eq=False)
class Results:
    """Stored results.

    Attributes:
        fits: table of fits.
        rows: table of held-out rows.
    """

    fits: pa.Table
    rows: pa.Table

    @cached_property
    def statuses(self) -> dict[tuple[str, str, str], tuple[str, ...]]:
        """Statuses of the folds, by series, split and method."""
        found: dict[tuple[str, str, str], tuple[str, ...]] = {}
        for fit in self.fits.to_pylist():
            key = fit["series"], fit["split"], fit["method"]
            found[key] = (*found.get(key, ()), fit["status"])
        return found

    @cached_property
    def errors(self) -> dict[tuple[str, str, str], RowErrors]:
        """Errors of the held-out rows of all folds, by series, split and method, if no fold failed."""
        return {
            key: errors_of(self.rows, *key)
            for key, statuses in self.statuses.items()
            if set(statuses) == {"done"}
        }

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Series and splits with results, in the order of the page."""
        there = {key[:2] for key in self.statuses}
        return [(name, split) for name in SERIES for split in SPLITS if (name, split) in there]

    def peers(self, name: str, split: str) -> dict[str, RowErrors]:
        """Errors of the methods of others on a split."""
        return {
            method: self.errors[name, split, method]
            for method in METHODS
            if (name, split, method) in self.errors and "pisigma" not in method_of(method).packages
        }


def write_page(folder: Path) -> None:
    """Write the page and its pictures."""
    results = Results(*read(folder))
    PAGE.write_text(page_of(results), encoding="utf-8")
    draw_learning_curves(results.errors, results.fits, FIGURES / "benchmark_rows.png")
    draw_coverage(results.errors, FIGURES / "benchmark_coverage.png")


def page_of(results: Results) -> str:
    """Return the text of the page."""
    text = TEMPLATE.read_text(encoding="utf-8")
    parts = {
        "series": _series_table(),
        "splits": _table(["split", "held out"], ([f"`{name}`", what] for name, (what, _) in SPLITS.items())),
        "methods": _method_table(),
        "accuracy": "\n\n".join(
            _accuracy(results, name) for name in SERIES if name in {key[0] for key in results.pairs}
        ),
        "ranking": _ranking(results),
        "coverage": _coverage(results),
        "cost": _cost(results),
        "failures": _failures(results),
        "versions": _versions(results),
        "limit": str(LIMIT_S),
        "draws": f"{DRAWS:,}",
    }
    for name, part in parts.items():
        text = text.replace(f"<!-- {name} -->", part)
    return text


def _table(head: list[str], rows: Iterator[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _series_table() -> str:
    head = ["series", "sensor", "source, licence", "note"]
    rows = (
        [
            f"`{one.name}`: {one.title}",
            one.sensor,
            f"{one.citation.split(',')[0]}, `{one.url.removeprefix('https://')}`, {one.licence}",
            one.note,
        ]
        for one in map(series_of, SERIES)
    )
    return _table(head, rows)


def _method_table() -> str:
    return _table(
        ["method", "what it is", "source"],
        ([f"`{one.name}`", one.title, one.source] for one in map(method_of, METHODS)),
    )


def _accuracy(results: Results, name: str) -> str:
    splits = [split for series, split in results.pairs if series == name]
    ran = {method for series, _, method in results.statuses if series == name}
    best = {
        split: min(
            (
                results.errors[name, split, method].rms
                for method in METHODS
                if (name, split, method) in results.errors
            ),
            default=0.0,
        )
        for split in splits
    }

    def cell(split: str, method: str) -> str:
        if (name, split, method) in results.errors:
            rms = results.errors[name, split, method].rms
            return f"**{rms:.3f}**" if rms == best[split] else f"{rms:.3f}"
        return _short(results.statuses.get((name, split, method), ("not run",)))

    rows = (
        [f"`{method}`", *(cell(split, method) for split in splits)] for method in METHODS if method in ran
    )
    return f"### {series_of(name).title}\n\n" + _table(["method", *(f"`{split}`" for split in splits)], rows)


def _short(statuses: tuple[str, ...]) -> str:
    """Return the first status other than "done" without its details."""
    first = next(status for status in statuses if status != "done")
    return first.split(":")[0].replace("does not use rows of the kind 'socket'", "no sockets")


def _ranking(results: Results) -> str:
    def rows() -> Iterator[list[str]]:
        for name, split in results.pairs:
            peers = results.peers(name, split)
            ours = results.errors.get((name, split, OURS))
            if ours is None or not peers:
                continue
            best = min(peers, key=lambda method: peers[method].rms)
            low, high = ratio_interval(ours, peers[best])
            verdict = "more accurate" if high < 1 else "less accurate" if low > 1 else "no clear difference"
            ratio = ours.rms / peers[best].rms
            yield [
                f"`{name}`",
                f"`{split}`",
                f"`{best}`",
                f"{ours.rms:.3f}",
                f"{peers[best].rms:.3f}",
                f"{ratio:.2f} ({low:.2f} to {high:.2f})",
                verdict,
            ]

    return _table(
        [
            "series",
            "split",
            "best peer",
            "hybrid [mm]",
            "peer [mm]",
            "ratio (95 % interval)",
            "the hybrid is",
        ],
        rows(),
    )


def _coverage(results: Results) -> str:
    def rows() -> Iterator[list[str]]:
        for name, split in results.pairs:
            for method in METHODS:
                errors = results.errors.get((name, split, method))
                if errors is None or not np.isfinite(errors.sigma).all():
                    continue
                predicted = float(np.sqrt(np.square(errors.sigma).sum(1).mean()))
                yield [
                    f"`{name}`",
                    f"`{split}`",
                    f"`{method}`",
                    f"{errors.coverage(0.9):.1%}",
                    f"{errors.coverage(0.95):.1%}",
                    f"{predicted:.3f}",
                    f"{errors.rms:.3f}",
                ]

    return _table(["series", "split", "method", "90 %", "95 %", "predicted RMS [mm]", "RMS [mm]"], rows())


def _cost(results: Results) -> str:
    done = [fit for fit in results.fits.to_pylist() if fit["status"] == "done"]

    def rows() -> Iterator[list[str]]:
        for method in METHODS:
            fits = [fit for fit in done if fit["method"] == method]
            if fits:
                seconds = [fit["seconds"] for fit in fits]
                memory = max(fit["memory_mb"] for fit in fits)
                yield [
                    f"`{method}`",
                    f"{len(fits)}",
                    f"{np.median(seconds):.1f}",
                    f"{max(seconds):.1f}",
                    f"{memory:.0f}",
                ]

    return _table(["method", "fits", "median [s]", "largest [s]", "memory [MB]"], rows())


def _failures(results: Results) -> str:
    def rows() -> Iterator[list[str]]:
        for (name, split, method), statuses in results.statuses.items():
            wrong = [status for status in dict.fromkeys(statuses) if status != "done"]
            if wrong and not wrong[0].startswith("does not use"):
                yield [
                    f"`{name}`",
                    f"`{split}`",
                    f"`{method}`",
                    f"{statuses.count('done')} of {len(statuses)}",
                    "; ".join(wrong).replace("|", "/"),
                ]

    return _table(["series", "split", "method", "folds done", "status"], rows())


def _versions(results: Results) -> str:
    found: dict[str, set[str]] = {}
    for text in dict.fromkeys(results.fits["versions"].to_pylist()):
        for package, version in json.loads(text or "{}").items():
            found.setdefault(package, set()).add(version)
    return ", ".join(
        f"{package} {' and '.join(sorted(versions))}" for package, versions in sorted(found.items())
    )
