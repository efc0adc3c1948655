"""Tables that compare methods: the ranking against the best peer, and what extrapolation costs."""

from collections.abc import Mapping

from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.results import OURS, Results, table
from shared_benchmark.scores import ratio_interval
from shared_benchmark.series import NAMES as SERIES

EXTRAPOLATING = ("space", "box", "session")
"""Splits whose held-out rows lie outside the rows that are fitted."""

LOSSES: Mapping[tuple[str, str], str] = {}
"""Why the hybrid is less accurate than a peer, by series and split; the page has to explain every loss."""

BELOW_GEOMETRIC: Mapping[tuple[str, str], str] = {
    ("fr3", "placements"): (
        "only one of the three fits keeps a correction, that without placement B. Its two placements are too few to be "
        "left out, so the correction is judged by left-out rows of sockets whose other rows are fitted. "
        "It has 90 effective unknowns for 60 rows, and joint 6 leaves its measured range by 34 deg."
    ),
}
"""Why the hybrid is less accurate than pisigma's geometric calibration, by series and split."""

_LESS = "less accurate"


def ranking_rows(results: Results) -> list[list[str]]:
    """Return one row for every split where both the hybrid and a peer have results."""
    rows = []
    for name, split in results.pairs:
        peers = results.peers(name, split)
        ours = results.errors.get((name, split, OURS))
        if ours is None or not peers:
            continue
        best = min(peers, key=lambda method: peers[method].rms)
        low, high = ratio_interval(ours, peers[best])
        verdict = "more accurate" if high < 1 else _LESS if low > 1 else "no clear difference"
        ratio = f"{ours.rms / peers[best].rms:.2f} ({low:.2f} to {high:.2f})"
        figures = [f"{ours.rms:.3f}", f"{peers[best].rms:.3f}", ratio]
        rows.append([f"`{name}`", f"`{split}`", f"`{best}`", *figures, verdict])
    return rows


def ranking_table(results: Results) -> str:
    """Return the table of the hybrid against the best peer of every split."""
    head = [
        "series",
        "split",
        "best peer",
        "hybrid [mm]",
        "peer [mm]",
        "ratio (95 % interval)",
        "the hybrid is",
    ]
    return table(head, ranking_rows(results))


def losses(results: Results) -> list[tuple[str, str]]:
    """Return the splits where the hybrid is less accurate than a peer."""
    return [(row[0].strip("`"), row[1].strip("`")) for row in ranking_rows(results) if row[-1] == _LESS]


def losses_text(results: Results) -> str:
    """Return a list of the losses with their explanations."""
    lost = losses(results)
    if not lost:
        return "The hybrid is not clearly less accurate than a peer on any stored split."
    return "\n".join(
        f"- `{name}`, `{split}`: {LOSSES.get((name, split), 'not explained.')}" for name, split in lost
    )


def below_geometric(results: Results) -> list[tuple[str, str]]:
    """Return the splits where the hybrid is less accurate than the geometric calibration, however little."""
    found = []
    for name, split in results.pairs:
        ours, geometric = (results.errors.get((name, split, method)) for method in (OURS, "geometric"))
        if ours is not None and geometric is not None and round(ours.rms, 3) > round(geometric.rms, 3):
            found.append((name, split))
    return found


def below_geometric_text(results: Results) -> str:
    """Return a list of these splits with their ratios and explanations."""
    lines = []
    for name, split in below_geometric(results):
        ours, geometric = (results.errors[name, split, method] for method in (OURS, "geometric"))
        low, high = ratio_interval(ours, geometric)
        ratio = f"ratio {ours.rms / geometric.rms:.2f}, {low:.2f} to {high:.2f}"
        figures = f"{ours.rms:.3f} mm against {geometric.rms:.3f} mm ({ratio})"
        why = BELOW_GEOMETRIC.get((name, split), "not explained.")
        lines.append(f"- `{name}`, `{split}`: {figures}; {why}")
    return "\n".join(lines)


def extrapolation_table(results: Results) -> str:
    """Return the ratios of the errors outside the fitted rows to those of random held-out rows."""
    rows = []
    for name in SERIES:
        splits = [split for split in EXTRAPOLATING if (name, split) in results.pairs]
        for method in METHODS:
            inside = results.errors.get((name, "random", method))
            outside = [results.errors.get((name, split, method)) for split in EXTRAPOLATING]
            if inside is None or not splits or not any(outside):
                continue
            cells = ["" if one is None else f"{one.rms:.3f} ({one.rms / inside.rms:.1f})" for one in outside]
            rows.append([f"`{name}`", f"`{method}`", f"{inside.rms:.3f}", *cells])
    return table(["series", "method", "`random`", *(f"`{split}`" for split in EXTRAPOLATING)], rows)
