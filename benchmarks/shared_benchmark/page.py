"""The page of the documentation, which is generated from stored results alone."""

from pathlib import Path

from shared_benchmark.comparison import below_geometric_text, extrapolation_table, losses_text, ranking_table
from shared_benchmark.cost import cost_table, failures_table, total_text, versions_text
from shared_benchmark.coverage import coverage_table, pooled_table
from shared_benchmark.fits import LIMIT_S
from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.methods import method_of
from shared_benchmark.pictures import draw_accuracy, draw_coverage, draw_learning_curves
from shared_benchmark.reported import reported_table
from shared_benchmark.results import Results, table
from shared_benchmark.scores import DRAWS, rms_interval
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.series import series_of
from shared_benchmark.splits import SPLITS
from shared_benchmark.store import read

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "explanation" / "benchmark.md"
FIGURES = DOCS / "figures"
TEMPLATE = Path(__file__).parent / "page.md"


def write_page(folder: Path) -> None:
    """Write the page and its pictures."""
    results = Results(*read(folder))
    PAGE.write_text(page_of(results), encoding="utf-8")
    draw_accuracy(results.errors, FIGURES / "benchmark_accuracy.png")
    draw_learning_curves(results.errors, results.fits, FIGURES / "benchmark_rows.png")
    draw_coverage(results.errors, FIGURES / "benchmark_coverage.png")


def page_of(results: Results) -> str:
    """Return the text of the page."""
    text = TEMPLATE.read_text(encoding="utf-8")
    splits = [[f"`{name}`", what] for name, (what, _) in SPLITS.items()]
    names = [name for name in SERIES if name in {key[0] for key in results.pairs}]
    parts = {
        "series": _series_table(),
        "splits": table(["split", "held out"], splits),
        "methods": _method_table(),
        "accuracy": "\n\n".join(_accuracy(results, name) for name in names),
        "ranking": ranking_table(results),
        "losses": losses_text(results),
        "below_geometric": below_geometric_text(results),
        "reported": reported_table(results),
        "extrapolation": extrapolation_table(results),
        "pooled": pooled_table(results),
        "coverage": coverage_table(results),
        "cost": cost_table(results),
        "total": total_text(results),
        "failures": failures_table(results),
        "versions": versions_text(results),
        "limit": str(LIMIT_S),
        "draws": f"{DRAWS:,}",
    }
    for name, part in parts.items():
        text = text.replace(f"<!-- {name} -->", part)
    return text


def _series_table() -> str:
    head = ["series", "sensor", "source, licence", "note"]
    rows = [
        [
            f"`{one.name}`: {one.title}",
            one.sensor,
            f"{one.citation.split(',')[0]}, `{one.url.removeprefix('https://')}`, {one.licence}",
            one.note,
        ]
        for one in map(series_of, SERIES)
    ]
    return table(head, rows)


def _method_table() -> str:
    rows = [[f"`{one.name}`", one.title, one.source] for one in map(method_of, METHODS)]
    return table(["method", "what it is", "source"], rows)


def _accuracy(results: Results, name: str) -> str:
    splits = [split for series, split in results.pairs if series == name]
    ran = [method for method in METHODS if any((name, split, method) in results.statuses for split in splits)]
    errors = {key[1:]: one for key, one in results.errors.items() if key[0] == name}
    best = {
        split: min((one.rms for key, one in errors.items() if key[0] == split), default=0.0)
        for split in splits
    }

    def cell(split: str, method: str) -> str:
        if (split, method) not in errors:
            return _short(results.statuses.get((name, split, method), ("not run",)))
        rms = errors[split, method].rms
        low, high = rms_interval(errors[split, method])
        figure = f"**{rms:.3f}**" if rms == best[split] else f"{rms:.3f}"
        return f"{figure} ± {(high - low) / 2:.3f}"

    rows = [[f"`{method}`", *(cell(split, method) for split in splits)] for method in ran]
    return f"### {series_of(name).title}\n\n" + table(["method", *(f"`{split}`" for split in splits)], rows)


def _short(statuses: tuple[str, ...]) -> str:
    """Return the first status other than "done" without its details."""
    first = next(status for status in statuses if status != "done")
    short = {
        "does not use rows of the kind 'socket'": "no sockets",
        "predicts no rotations, to which base and tool could be fitted": "no rotations",
    }
    return short.get(first, first.split(":")[0].split(" after ")[0])
