"""Identifiability of parameters: rank, an identifiable subset, linear dependencies, and rank extension."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.calibration.geometric.problem.information import Information
from pisigma.calibration.geometric.problem.parameters import Parameter

_RANK_TOLERANCE = 1e-6
"""Ratio of a singular value of the column-scaled Jacobian to the largest one below which it is treated as zero."""
NO_EFFECT = 1e-9
"""Ratio of the length of a column to the longest one below which it is treated as zero."""
_PREFERENCE = ("base", "tool", "theta", "a", "d", "alpha", "beta")
"""Order in which kinds of parameters are preferred; each has ten times the weight of the next."""
_WEIGHT = {group: 10.0**-rank for rank, group in enumerate(_PREFERENCE)}
_CLEARLY_SEEN = 1.0
"""Standard deviation [mm or mrad] from the data alone below which a parameter is added."""
_EXPLAINED = 0.5
"""Share of the residual sum of squares that further parameters must explain in order to be added."""
_SIGNIFICANT = 20.0
"""F statistic that further parameters must reach in order to be added."""
_VISIBLE = 1e-7
"""Share of a column's length that is orthogonal to the kept columns, below which the column is treated as dependent."""


@dataclass(frozen=True)
class Dependency:
    """A linear combination of parameters that is identifiable although the individual parameters are not.

    Attributes:
        names: the parameter that is kept, followed by the parameters that depend on it.
        coefficients: coefficients of the combination in SI units; 1 for the first parameter.
        sentence: the dependency as a sentence.
    """

    names: tuple[str, ...]
    coefficients: tuple[float, ...]
    sentence: str


@dataclass(frozen=True, eq=False)
class Redundancy:
    """Redundancy of the parameters, determined from the Jacobian at the start.

    Angles of base and tool are small rotations about the axes of base and tool.

    Attributes:
        information: the condensed Jacobian.
        rank: number of independent combinations of parameters that the data determine.
        tolerance: tolerance of the rank, relative to the largest singular value.
        kept: the chosen identifiable subset of `rank` parameters.
        removed: parameters whose columns are linear combinations of columns of kept parameters.
        no_effect: parameters that change no measured value.
    """

    information: Information
    rank: int
    tolerance: float
    kept: tuple[str, ...]
    removed: tuple[str, ...]
    no_effect: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the analysed parameters."""
        return self.information.names

    @cached_property
    def singular_values(self) -> Float64[np.ndarray, " singular"]:
        """Singular values of the column-scaled Jacobian."""
        J = self.information.jacobian
        lengths = _lengths(J)
        return _singular_values(J[:, lengths > 0] / lengths[lengths > 0])

    @cached_property
    def dependencies(self) -> tuple[Dependency, ...]:
        """Identifiable combinations, one for every kept parameter on which others depend."""
        return _dependencies(self.information, self.kept, self.removed)

    def dependency_sentence_of(self, name: str) -> str | None:
        """Return the shortest sentence about a dependency of a parameter; None if it has no dependency."""
        having = [dependency for dependency in self.dependencies if name in dependency.names]
        return min(having, key=lambda dependency: len(dependency.names)).sentence if having else None


@dataclass(frozen=True, eq=False)
class RankFindings:
    """Result of the rank analysis.

    Attributes:
        nominal_values: values of the candidates at the start.
        redundancy: redundancy of the candidates at the start.
        added_parameters: indices of parameters that were added after the start.
        estimated_count: number of unknowns to estimate; see `sufficiency.count_estimated_unknowns`.
    """

    nominal_values: Float64[np.ndarray, " candidates"]
    redundancy: Redundancy
    added_parameters: list[int]
    estimated_count: int

    @property
    def information(self) -> Information:
        """Condensed Jacobian of the candidates at the start."""
        return self.redundancy.information


def find_redundancy(
    information: Information,
    nominal_values: Float64[np.ndarray, " parameters"],
    tolerance: float = _RANK_TOLERANCE,
) -> Redundancy:
    """Find the rank, an identifiable subset of the parameters, and the dependencies of the other parameters on it.

    The rank is that of the Jacobian with columns of unit length. The subset is the first `rank` pivots of a QR
    factorisation with column pivoting (Businger and Golub 1965) of these columns times their preference.

    Args:
        information: the condensed Jacobian.
        nominal_values: nominal values. Of parameters with equal columns, the one with the larger value is kept: of
            parallel axes, the d that is a real offset.
        tolerance: see `_RANK_TOLERANCE`.
    """
    jacobian, names = information.jacobian, np.array(information.names)
    lengths, preference = _lengths(jacobian), selection_weights(information.parameters, nominal_values)
    scale = np.divide(preference, lengths, out=np.zeros_like(lengths), where=lengths > 0)
    triangle, pivots = pivoted_qr(jacobian * scale)
    rank = _rank(triangle / preference[pivots], tolerance)
    chosen, left = pivots[:rank], pivots[rank:]  # dependent columns and columns of zeros, in any order

    def named(columns: Int64[np.ndarray, " some"]) -> tuple[str, ...]:
        return tuple(names[np.sort(columns)].tolist())

    others, silent = left[lengths[left] > 0], left[lengths[left] == 0]
    return Redundancy(information, rank, tolerance, named(chosen), named(others), named(silent))


def _lengths(jacobian: Float64[np.ndarray, "rank columns"]) -> Float64[np.ndarray, " columns"]:
    """Return the lengths of the columns, with 0 for parameters without effect."""
    lengths: np.ndarray = np.sqrt(np.square(jacobian).sum(0))
    lengths[lengths <= NO_EFFECT * lengths.max(initial=0.0)] = 0.0
    return lengths


def _singular_values(A: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, " singular"]:
    values: np.ndarray = np.linalg.svd(A, compute_uv=False) if A.shape[1] else np.zeros(0)
    return values


def _rank(R: Float64[np.ndarray, "rank columns"], tolerance: float) -> int:
    """Compute the numerical rank of a triangle with columns of unit length (or zero).

    The largest singular value is between 1 and the square root of the number of columns, so the rank is k if the
    Frobenius norms of the block below row k and of the inverse of the leading k x k block are small enough. This
    criterion is nearly always conclusive, so the singular values need not be computed.
    """
    from scipy.linalg.lapack import dtrtri  # imported here, because models are loaded without scipy

    below = np.sqrt(np.square(R).sum(1)[::-1].cumsum()[::-1])
    rank = int((below > tolerance).sum())
    inverse, singular = dtrtri(R[:rank, :rank]) if rank else (R[:0], 0)
    if singular or np.square(inverse).sum() * R.shape[1] * tolerance**2 >= 1:
        values = _singular_values(R)
        rank = int((values > tolerance * values.max(initial=0.0)).sum())
    return rank


def selection_weights(
    parameters: Sequence[Parameter], nominal_values: Float64[np.ndarray, " parameters"]
) -> Float64[np.ndarray, " parameters"]:
    """Compute the weights by which parameters are selected; of parameters with equal weights, the first is kept."""
    weights = np.array([_WEIGHT[parameter.group] for parameter in parameters])
    result: np.ndarray = weights * (
        1 + 1e-3 * (np.abs(nominal_values) > 1e-9) - 1e-6 * np.arange(len(weights))
    )
    return result


def pivoted_qr(
    A: Float64[np.ndarray, "rows columns"],
) -> tuple[Float64[np.ndarray, "rank columns"], Int64[np.ndarray, " columns"]]:
    """Return R and the pivots of a QR factorisation with column pivoting (LAPACK's `geqp3`)."""
    from scipy.linalg.lapack import dgeqp3  # imported here, because models are loaded without scipy

    R, pivots = dgeqp3(A)[:2]
    return np.triu(R[: A.shape[1]]), pivots.astype(np.int64) - 1


def _dependencies(
    information: Information, kept_names: tuple[str, ...], removed_names: tuple[str, ...]
) -> tuple[Dependency, ...]:
    if not removed_names or not kept_names:
        return ()
    number = {name: index for index, name in enumerate(information.names)}
    kept, removed = ([number[name] for name in names] for names in (kept_names, removed_names))
    J = information.jacobian
    lengths = np.linalg.norm(J, axis=0)
    # Every removed column is a combination of kept ones; all have unit length, so that 1e-6 is negligible.
    scaled, *_ = np.linalg.lstsq(J[:, kept] / lengths[kept], J[:, removed] / lengths[removed], rcond=None)
    usual = np.array([parameter.usual_error for parameter in information.parameters])
    dependencies = []
    for row, index in zip(scaled, kept, strict=True):
        partners = [k for k in range(len(removed)) if abs(row[k]) > 1e-6]
        if not partners:
            continue
        coefficients = [1.0]
        for k in partners:
            change = row[k] * lengths[removed[k]] / lengths[index]
            coefficients.append(float(change * usual[index] / usual[removed[k]]))
        members = [information.parameters[index], *(information.parameters[removed[k]] for k in partners)]
        names = tuple(member.name for member in members)
        dependencies.append(
            Dependency(names, tuple(coefficients), dependency_sentence(members, coefficients))
        )
    return tuple(dependencies)


def dependency_sentence(members: list[Parameter], coefficients: list[float]) -> str:
    """Return a sentence such as "d_2 + d_3 + d_4 is identified; the individual values are not"."""
    terms = sorted(zip(members, coefficients, strict=True), key=lambda term: (term[1] < 0, term[0].name))
    text = ""
    for member, coefficient in terms:
        factor = ""
        if abs(abs(coefficient) - 1) > 5e-5:
            units = "" if member.unit == members[0].unit else f" {members[0].unit}/{member.unit}"
            factor = f"{abs(coefficient):.4g}{units} · "
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} {factor}{member.name}" if text else f"{factor}{member.name}"
    return f"{text} is identified; the individual values are not"


def additional_columns(information: Information, kept_count: int) -> list[int]:
    """Find columns that the data determine in addition to the kept columns.

    Nominal axes are exactly parallel or intersect exactly, but real axes do not, so dependencies of the nominal
    robot are only approximate for the real robot. Columns are added one by one while the standard error of the next
    one is below a typical error, or all of them if the residuals show that they are needed (as with exact data).

    Args:
        information: information on all candidates near the solution, with rows in standard deviations.
        kept_count: number of leading columns that are already estimated.

    Returns:
        Columns to add, the best determined first.
    """
    # Below the rows of the kept columns, the triangle contains the components orthogonal to these columns.
    rest, left = information.jacobian[kept_count:, kept_count:], information.residual[kept_count:]
    pivots = _pivots(rest, _VISIBLE * np.linalg.norm(information.jacobian[:, kept_count:], axis=0))
    clear = sum(size >= 1 / _CLEARLY_SEEN for _, size in pivots)
    if _needed(rest[:, [i for i, _ in pivots]], left, information.values - kept_count):
        clear = len(pivots)
    return [kept_count + i for i, _ in pivots[:clear]]


def _pivots(rest: np.ndarray, rounding: np.ndarray) -> list[tuple[int, float]]:
    """Compute the pivots of a QR factorisation with column pivoting, and their lengths orthogonal to earlier pivots."""
    rest = rest.copy()
    pivots: list[tuple[int, float]] = []
    while rest.shape[1]:
        lengths = np.sqrt(np.einsum("ij,ij->j", rest, rest))
        lengths[lengths <= rounding] = 0.0
        best = int(lengths.argmax())
        if lengths[best] == 0.0:
            break
        pivots.append((best, float(lengths[best])))
        direction = rest[:, best] / lengths[best]
        rest -= direction[:, None] * (direction @ rest)
        rest[:, best] = 0.0
    return pivots


def _needed(columns: np.ndarray, left: np.ndarray, freedom: int) -> bool:
    """Return whether the columns explain most of the remaining residuals, by share and F statistic."""
    extra = columns.shape[1]
    if extra == 0 or freedom <= extra:
        return False
    basis, _ = np.linalg.qr(columns)
    total = float(left @ left)
    explained = float(np.square(basis.T @ left).sum())
    unexplained = max(total - explained, 1e-30 * total) / (freedom - extra)
    return explained >= _EXPLAINED * total and explained / extra >= _SIGNIFICANT * unexplained
