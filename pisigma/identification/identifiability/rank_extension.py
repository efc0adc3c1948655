"""Parameters that are redundant at the nominal geometry, but not any more at the calibrated one."""

import numpy as np

from pisigma.identification.problem.information import Information

CLEARLY_SEEN = 1.0
"""A parameter is added when the data alone tell it to this many mm or mrad."""
EXPLAINED = 0.5
"""All that can be seen at all are added when they explain this share of what is left of the residuals."""
SIGNIFICANT = 20.0
"""And when the F statistic of that is at least so large."""
VISIBLE = 1e-7
"""Columns with less than this share of their length beside the kept ones count as dependent."""


def rank_extension(information: Information, kept: list[int]) -> list[int]:
    """Find columns that the data tell besides those kept.

    Nominal axes are parallel or meet exactly; real ones do not, so that dependencies of the nominal robot
    are not quite dependencies of the real one. Columns are added one by one while the data tell the next to
    a usual error; or all that are visible, if the residuals show that they are needed (as with exact data).

    Args:
        information: of all candidates at about the solution, its rows in standard deviations.
        kept: columns that are estimated anyway.

    Returns:
        Columns to add, the clearest first.
    """
    J, r = information.jacobian, information.residual
    basis, _ = np.linalg.qr(J[:, kept])
    rest = J - basis @ (basis.T @ J)
    rest -= basis @ (basis.T @ rest)
    left = r - basis @ (basis.T @ r)
    lengths = np.linalg.norm(J, axis=0)
    pivots = _pivots(rest, VISIBLE * lengths, kept)
    clear = sum(size >= 1 / CLEARLY_SEEN for _, size in pivots)
    if _needed(rest[:, [i for i, _ in pivots]], left, information.values - len(kept)):
        clear = len(pivots)
    return [i for i, _ in pivots[:clear]]


def _pivots(rest: np.ndarray, rounding: np.ndarray, kept: list[int]) -> list[tuple[int, float]]:
    """Pivots of a QR factorisation with column pivoting, with the length each has beside those before it."""
    rest = rest.copy()
    taken = np.zeros(rest.shape[1], dtype=bool)
    taken[kept] = True
    found: list[tuple[int, float]] = []
    while True:
        lengths = np.linalg.norm(rest, axis=0)
        lengths[taken | (lengths <= rounding)] = 0.0
        best = int(lengths.argmax()) if len(lengths) else 0
        if not len(lengths) or lengths[best] == 0.0:
            return found
        found.append((best, float(lengths[best])))
        taken[best] = True
        direction = rest[:, best] / lengths[best]
        rest -= np.outer(direction, direction @ rest)


def _needed(columns: np.ndarray, left: np.ndarray, freedom: int) -> bool:
    """Whether the columns explain most of the residuals that are left."""
    extra = columns.shape[1]
    if extra == 0 or freedom <= extra:
        return False
    basis, _ = np.linalg.qr(columns)
    total = float(left @ left)
    explained = float(np.square(basis.T @ left).sum())
    unexplained = max(total - explained, 1e-30 * total) / (freedom - extra)
    return explained >= EXPLAINED * total and explained / extra >= SIGNIFICANT * unexplained
