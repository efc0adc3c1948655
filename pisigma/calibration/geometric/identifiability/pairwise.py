"""Redundant parameters by the method of Park et al. 2022: Pearson correlation of the columns of the Jacobian."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.calibration.geometric.identifiability.redundancy import NO_EFFECT, selection_weights
from pisigma.calibration.geometric.problem.information import Information

_CORRELATION_TOLERANCE = 1e-6
"""Largest difference from ±1 of a correlation that is treated as ±1."""
_PAPER_ORDER = ("a", "d", "alpha", "theta", "beta", "base", "tool")


@dataclass(frozen=True, eq=False)
class CorrelationTable:
    """Pearson correlations of the Jacobian's columns, for parameters of the same unit.

    Attributes:
        names: names of the parameters.
        values: symmetric matrix with 1 on the diagonal; NaN for parameters without effect.
    """

    names: tuple[str, ...]
    values: Float64[np.ndarray, "parameters parameters"]

    def __str__(self) -> str:
        """Return the table as text, in the form used by Park et al. 2022."""
        width = max(8, *(len(name) + 2 for name in self.names))
        lines = [" " * width + "".join(name.rjust(width) for name in self.names)]
        for name, row in zip(self.names, self.values, strict=True):
            cells = ("NaN" if np.isnan(value) else f"{value:.3f}" for value in row)
            lines.append(name.ljust(width) + "".join(cell.rjust(width) for cell in cells))
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class PairwiseRedundancy:
    """Parameters that are redundant in pairs, by the method of Park et al. 2022.

    Attributes:
        lengths: correlations of the length parameters.
        angles: correlations of the angle parameters.
        sets: sets of parameters with proportional columns; a leading "-" marks the opposite sign relative to the
            first one.
        no_effect: parameters that change no measured value.
        kept: all parameters that are not redundant, with one of each set.
        correlation_tolerance: see `_CORRELATION_TOLERANCE`.
    """

    lengths: CorrelationTable
    angles: CorrelationTable
    sets: tuple[tuple[str, ...], ...]
    no_effect: tuple[str, ...]
    kept: tuple[str, ...]
    correlation_tolerance: float


def find_pairwise_redundancy(
    information: Information,
    nominal_values: Float64[np.ndarray, " parameters"],
    correlation_tolerance: float = _CORRELATION_TOLERANCE,
) -> PairwiseRedundancy:
    """Find pairs of parameters whose columns of the Jacobian have |r| = 1 (Park et al. 2022, section 3.2).

    Lengths and angles are compared separately. Dependencies of three or more parameters without dependent pairs are
    not found; `find_redundancy` finds them.

    Args:
        information: the condensed Jacobian.
        nominal_values: nominal values, see `find_redundancy`.
        correlation_tolerance: see `_CORRELATION_TOLERANCE`.
    """
    columns = information.jacobian
    lengths = np.linalg.norm(columns, axis=0)
    acting = lengths > NO_EFFECT * max(lengths.max(initial=0.0), 1e-300)
    parameters, preference = information.parameters, selection_weights(information.parameters, nominal_values)
    order = sorted(range(len(parameters)), key=lambda i: (_PAPER_ORDER.index(parameters[i].group), i))
    tables, sets, dropped = [], [], set()
    for unit in ("m", "rad"):
        chosen = [i for i in order if parameters[i].unit == unit]
        table = CorrelationTable(
            tuple(parameters[i].name for i in chosen),
            _correlations(information.centred_jacobian[:, chosen], acting[chosen]),
        )
        tables.append(table)
        for members, signs in _sets(table.values, correlation_tolerance):
            indices = [chosen[k] for k in members]
            sets.append(
                tuple(
                    ("-" if s < 0 else "") + parameters[i].name for i, s in zip(indices, signs, strict=True)
                )
            )
            best = max(indices, key=preference.__getitem__)
            dropped |= set(indices) - {best}
    return PairwiseRedundancy(
        lengths=tables[0],
        angles=tables[1],
        sets=tuple(sets),
        no_effect=tuple(parameters[i].name for i in order if not acting[i]),
        kept=tuple(name for i, name in enumerate(information.names) if i not in dropped),
        correlation_tolerance=correlation_tolerance,
    )


def _correlations(centred: np.ndarray, acting: np.ndarray) -> np.ndarray:
    deviations = np.linalg.norm(centred, axis=0)
    varies = acting & (deviations > 0)
    unit = np.where(varies, centred / np.where(varies, deviations, 1.0), np.nan)
    return unit.T @ unit


def _sets(correlations: np.ndarray, tolerance: float) -> list[tuple[list[int], list[int]]]:
    """Return sets of two or more parameters with proportional columns: indices, and signs relative to the first."""
    sets, taken = [], set()
    for first in range(len(correlations)):
        if first in taken:
            continue
        alike = [k for k in range(len(correlations)) if abs(correlations[first, k]) >= 1 - tolerance]
        members = [k for k in alike if k not in taken]
        taken |= set(members)
        if len(members) > 1:
            sets.append((members, [int(np.sign(correlations[first, k])) for k in members]))
    return sets
