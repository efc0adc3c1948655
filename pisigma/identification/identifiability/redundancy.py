"""Which parameters the data can tell apart: rank, choice, dependencies in words, additions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.identification.problem.information import Information
from pisigma.identification.problem.parameters import Parameter

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
        singular_values: of the column-scaled Jacobian.
        kept: the parameters that were chosen, `rank` of them.
        removed: those that act like combinations of kept ones.
        no_effect: those that change no measured value at all.
    """

    information: Information
    rank: int
    tolerance: float
    singular_values: Float64[np.ndarray, " singular"]
    kept: tuple[str, ...]
    removed: tuple[str, ...]
    no_effect: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that were looked at."""
        return self.information.names

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
    information: Information,
    sizes: Float64[np.ndarray, " parameters"],
    tolerance: float = RANK_TOLERANCE,
) -> Redundancy:
    """Find rank, a choice of independent parameters and the dependencies of the others on them.

    The columns are scaled to length one; the rank is that of the singular values. The choice is the first
    `rank` pivots of a QR factorisation with column pivoting (Businger and Golub 1965) of the columns times
    their preference.

    Args:
        information: the condensed Jacobian.
        sizes: nominal values; of equal columns that with the larger one is kept (a group of parallel axes
            keeps the d that is a real offset).
        tolerance: see `RANK_TOLERANCE`.
    """
    J = information.jacobian
    lengths = np.linalg.norm(J, axis=0)
    acting = np.flatnonzero(lengths > NO_EFFECT * max(lengths.max(initial=0.0), 1e-300))
    unit = J[:, acting] / lengths[acting]
    singular = np.linalg.svd(unit, compute_uv=False) if len(acting) else np.zeros(0)
    rank = int((singular > tolerance * singular.max(initial=0.0)).sum())
    preference = np.array(
        [
            preference_of(information.parameters[i], size, i)
            for i, size in zip(acting.tolist(), sizes[acting].tolist(), strict=True)
        ]
    )
    pivots = pivoted_columns(unit * preference, rank)
    kept, removed = acting[np.sort(pivots)], np.delete(acting, pivots)
    names = information.names
    return Redundancy(
        information=information,
        rank=rank,
        tolerance=tolerance,
        singular_values=singular,
        kept=tuple(names[i] for i in kept),
        removed=tuple(names[i] for i in removed),
        no_effect=tuple(names[i] for i in range(len(names)) if i not in acting),
    )


def preference_of(parameter: Parameter, size: float, index: int) -> float:
    """How much a parameter is wanted among those that are kept; its place decides ties, the earlier wins."""
    bonus = 1e-3 if abs(size) > 1e-9 else 0.0
    return _WEIGHT[parameter.group] * (1 + bonus - 1e-6 * index)


def pivoted_columns(A: Float64[np.ndarray, "rows columns"], count: int) -> Int64[np.ndarray, " pivots"]:
    """Return the first pivots of a QR factorisation with column pivoting (LAPACK's `geqp3`)."""
    from scipy.linalg.lapack import dgeqp3  # here, since models are loaded without scipy

    return np.asarray(dgeqp3(A)[1][:count] - 1, dtype=np.int64)


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


def rank_extension(information: Information, kept: list[int]) -> list[int]:
    """Find columns that the data determine besides those kept.

    Nominal axes are parallel or meet exactly; real ones do not, so that dependencies of the nominal robot
    are not quite dependencies of the real one. Columns are added one by one while the data determine the next to
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
    columns = np.delete(np.arange(rest.shape[1]), kept)
    rest, rounding = rest[:, columns], rounding[columns]
    pivots: list[tuple[int, float]] = []
    while len(columns):
        lengths = np.sqrt(np.einsum("ij,ij->j", rest, rest))
        lengths[lengths <= rounding] = 0.0
        best = int(lengths.argmax())
        if lengths[best] == 0.0:
            break
        pivots.append((int(columns[best]), float(lengths[best])))
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
