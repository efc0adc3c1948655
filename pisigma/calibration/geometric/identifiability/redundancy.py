"""Which parameters the data can tell apart: rank, choice, dependencies in words, additions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.calibration.geometric.problem.information import Information
from pisigma.calibration.geometric.problem.parameters import Parameter

RANK_TOLERANCE = 1e-6
"""Singular values of the column-scaled Jacobian below this share of the largest count as zero."""
NO_EFFECT = 1e-9
"""Columns smaller than this share of the largest count as zero."""
PREFERENCE = ("base", "tool", "theta", "a", "d", "alpha", "beta")
"""Which parameters are kept first; each class counts ten times as much as the next."""
_WEIGHT = {group: 10.0**-rank for rank, group in enumerate(PREFERENCE)}
CLEARLY_SEEN = 1.0
"""A parameter is added when the data alone determine it to this many mm or mrad."""
EXPLAINED = 0.5
"""All visible ones are added when they explain this share of what is left of the residuals."""
SIGNIFICANT = 20.0
"""And when the F statistic of that is at least so large."""
VISIBLE = 1e-7
"""Columns with less than this share of their length beside the kept ones count as dependent."""


@dataclass(frozen=True)
class Dependency:
    """A combination of parameters of which the data determine only the sum.

    Attributes:
        names: the parameter that is kept, then those that act like it.
        coefficients: of the sum, in SI units; 1 for the first.
        sentence: the same in words.
    """

    names: tuple[str, ...]
    coefficients: tuple[float, ...]
    sentence: str


@dataclass(frozen=True, eq=False)
class Redundancy:
    """What the Jacobian at the start says of the parameters.

    Turns of base and tool are meant as small turns about their own axes.

    Attributes:
        information: the condensed Jacobian.
        rank: how many independent combinations of them the data determine.
        tolerance: of the rank, as a share of the largest singular value.
        kept: the parameters that were chosen, `rank` of them.
        removed: those that act like combinations of kept ones.
        no_effect: those that change no measured value at all.
    """

    information: Information
    rank: int
    tolerance: float
    kept: tuple[str, ...]
    removed: tuple[str, ...]
    no_effect: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that were looked at."""
        return self.information.names

    @cached_property
    def singular_values(self) -> Float64[np.ndarray, " singular"]:
        """Singular values of the column-scaled Jacobian."""
        J = self.information.jacobian
        lengths = _lengths(J)
        return _singular_values(J[:, lengths > 0] / lengths[lengths > 0])

    @cached_property
    def dependencies(self) -> tuple[Dependency, ...]:
        """The combinations that are identified where single values are not, one for every kept parameter with any."""
        return _dependencies(self.information, self.kept, self.removed)

    def group(self, name: str) -> str | None:
        """The sentence of a dependency that a parameter is part of, the shortest if several."""
        having = [dependency for dependency in self.dependencies if name in dependency.names]
        return min(having, key=lambda dependency: len(dependency.names)).sentence if having else None


@dataclass(frozen=True, eq=False)
class Findings:
    """What the rank analysis says about the parameters.

    Attributes:
        sizes: values of the candidates at the start.
        redundancy: what the Jacobian there says of them.
        extended: indices of parameters that were added later.
        wanted: how many numbers have to be estimated; see `sufficiency.free_parameters`.
    """

    sizes: Float64[np.ndarray, " candidates"]
    redundancy: Redundancy
    extended: list[int]
    wanted: int

    @property
    def information(self) -> Information:
        """The condensed Jacobian of the candidates at the start."""
        return self.redundancy.information


def find_redundancy(
    information: Information, sizes: Float64[np.ndarray, " parameters"], tolerance: float = RANK_TOLERANCE
) -> Redundancy:
    """Find the rank, a choice of independent parameters and the dependencies of the others on them.

    The columns are scaled to length one; the rank is that of the singular values. The choice is the first
    `rank` pivots of a QR factorisation with column pivoting (Businger and Golub 1965) of the columns times
    their preference.

    Args:
        information: the condensed Jacobian.
        sizes: nominal values; of equal columns that with the larger one is kept (a group of parallel axes
            keeps the d that is a real offset).
        tolerance: see `RANK_TOLERANCE`.
    """
    jacobian, names = information.jacobian, np.array(information.names)
    lengths, preference = _lengths(jacobian), preferences(information.parameters, sizes)
    wanted = np.divide(preference, lengths, out=np.zeros_like(lengths), where=lengths > 0)
    triangle, pivots = pivoted_triangle(jacobian * wanted)
    rank = _rank(triangle / preference[pivots], tolerance)
    acting = int((lengths > 0).sum())  # the others are the last pivots

    def named(columns: Int64[np.ndarray, " some"]) -> tuple[str, ...]:
        return tuple(names[np.sort(columns)].tolist())

    chosen, others, silent = pivots[:rank], pivots[rank:acting], pivots[acting:]
    return Redundancy(information, rank, tolerance, named(chosen), named(others), named(silent))


def _lengths(jacobian: Float64[np.ndarray, "rank columns"]) -> Float64[np.ndarray, " columns"]:
    """Return the lengths of the columns, 0 of those that change no measured value."""
    lengths: np.ndarray = np.sqrt(np.square(jacobian).sum(0))
    lengths[lengths <= NO_EFFECT * lengths.max(initial=0.0)] = 0.0
    return lengths


def _singular_values(A: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, " singular"]:
    values: np.ndarray = np.linalg.svd(A, compute_uv=False) if A.shape[1] else np.zeros(0)
    return values


def _rank(R: Float64[np.ndarray, "rank columns"], tolerance: float) -> int:
    """Count the singular values above a share of the largest, of a triangle whose columns have length one, or none.

    The largest lies between one and the root of the number of columns. So the rank is k where what is below the k-th
    row is shorter than the tolerance, and the inverse of what is beside it is short enough; nearly always that shows
    it, and the singular values need not be worked out.
    """
    from scipy.linalg.lapack import dtrtri  # here, since models are loaded without scipy

    below = np.sqrt(np.square(R).sum(1)[::-1].cumsum()[::-1])
    rank = int((below > tolerance).sum())
    inverse, singular = dtrtri(R[:rank, :rank]) if rank else (R[:0], 0)
    if singular or np.square(inverse).sum() * R.shape[1] * tolerance**2 >= 1:
        values = _singular_values(R)
        rank = int((values > tolerance * values.max(initial=0.0)).sum())
    return rank


def preferences(
    parameters: Sequence[Parameter], sizes: Float64[np.ndarray, " parameters"]
) -> Float64[np.ndarray, " parameters"]:
    """How much parameters are wanted among those that are kept; their order decides ties, the earlier wins."""
    weights = np.array([_WEIGHT[parameter.group] for parameter in parameters])
    result: np.ndarray = weights * (1 + 1e-3 * (np.abs(sizes) > 1e-9) - 1e-6 * np.arange(len(weights)))
    return result


def pivoted_triangle(
    A: Float64[np.ndarray, "rows columns"],
) -> tuple[Float64[np.ndarray, "rank columns"], Int64[np.ndarray, " columns"]]:
    """Return R and the pivots of a QR factorisation with column pivoting (LAPACK's `geqp3`)."""
    from scipy.linalg.lapack import dgeqp3  # here, since models are loaded without scipy

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
        dependencies.append(Dependency(names, tuple(coefficients), sentence_of(members, coefficients)))
    return tuple(dependencies)


def sentence_of(members: list[Parameter], coefficients: list[float]) -> str:
    """Say that only a sum is identified: "d_2 + d_3 + d_4 is identified, the single values are not"."""
    terms = sorted(zip(members, coefficients, strict=True), key=lambda term: (term[1] < 0, term[0].name))
    text = ""
    for member, coefficient in terms:
        factor = ""
        if abs(abs(coefficient) - 1) > 5e-5:
            units = "" if member.unit == members[0].unit else f" {members[0].unit}/{member.unit}"
            factor = f"{abs(coefficient):.4g}{units} · "
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} {factor}{member.name}" if text else f"{factor}{member.name}"
    return f"{text} is identified, the single values are not"


def rank_extension(information: Information, kept: int) -> list[int]:
    """Find columns that the data determine besides those kept.

    Nominal axes are parallel or meet exactly; real ones do not, so that dependencies of the nominal robot
    are not quite dependencies of the real one. Columns are added one by one while the data determine the next to
    a usual error; or all that are visible, if the residuals show that they are needed (as with exact data).

    Args:
        information: of all candidates at about the solution, its rows in standard deviations.
        kept: so many columns, the first ones, are estimated anyway.

    Returns:
        Columns to add, the clearest first.
    """
    # below the rows of the kept columns, the triangle holds what the others and the residuals are beside them
    rest, left = information.jacobian[kept:, kept:], information.residual[kept:]
    pivots = _pivots(rest, VISIBLE * np.linalg.norm(information.jacobian[:, kept:], axis=0))
    clear = sum(size >= 1 / CLEARLY_SEEN for _, size in pivots)
    if _needed(rest[:, [i for i, _ in pivots]], left, information.values - kept):
        clear = len(pivots)
    return [kept + i for i, _ in pivots[:clear]]


def _pivots(rest: np.ndarray, rounding: np.ndarray) -> list[tuple[int, float]]:
    """Pivots of a QR factorisation with column pivoting, with the length each has beside those before it."""
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
    """Whether the columns explain most of the residuals that are left."""
    extra = columns.shape[1]
    if extra == 0 or freedom <= extra:
        return False
    basis, _ = np.linalg.qr(columns)
    total = float(left @ left)
    explained = float(np.square(basis.T @ left).sum())
    unexplained = max(total - explained, 1e-30 * total) / (freedom - extra)
    return explained >= EXPLAINED * total and explained / extra >= SIGNIFICANT * unexplained
