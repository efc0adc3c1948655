"""Regression by normal equations: for many values and fewer unknowns."""

import ctypes
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.abstract_regression import AbstractRegression
from pisigma.calibration.hybrid.covariance_root import CovarianceRoot
from pisigma.calibration.hybrid.design import Design, Rows, chunks
from pisigma.calibration.hybrid.evidence import (
    GaussianPrior,
    LeftOut,
    Posterior,
    SensorCount,
)
from pisigma.calibration.hybrid.sensor_values import SensorValues
from pisigma.files.errors import IdentificationError
from pisigma.joint_correction.feature import AbstractFeature

BLOCK = 192
"""Triangular matrices are worked on in blocks of so many rows: small ones leave less of what is 0 in the products,
large ones are multiplied faster."""
NARROW = 64
"""Rows of which all columns are in memory at a time where only products with some of them are made."""
MANY_UNKNOWNS = 1_000
"""Matrices of more are large enough to make room for."""


@dataclass(frozen=True, eq=False)
class Solved:
    """The normal equations, divided by the noise's variance, with a prior: `D (Σ X^T X + precision) D = L L^T`.

    Attributes:
        prior: of the unknowns.
        noise: per sensor.
        scale: the diagonal of D.
        inverse: L^-1, a lower triangle, so that the covariance is `D L^-T L^-1 D`.
        log_det: logarithm of the determinant of `Σ X^T X + precision`.
        x: the most probable values.
    """

    prior: GaussianPrior
    noise: tuple[float, ...]
    scale: Float64[Tensor, " unknowns"]
    inverse: Float64[Tensor, "unknowns unknowns"]
    log_det: float
    x: Float64[Tensor, " unknowns"]

    @property
    def variance(self) -> Float64[Tensor, " unknowns"]:
        """Diagonal of the covariance."""
        deviation: Tensor = self.scale * torch.linalg.vector_norm(self.inverse, dim=0)
        return deviation.square()

    def trace(self, matrix: Float64[Tensor, "unknowns unknowns"]) -> float:
        """Trace of the product of a symmetric matrix and the covariance, of which one block is made at a time."""
        trace = 0.0
        for rows in chunks(len(self.x), BLOCK):
            block = self.inverse[rows.start :, rows].t() @ self.inverse[rows.start :, : rows.stop]
            scale = self.scale[: rows.stop].clone()
            scale[: rows.start].mul_(2)  # the blocks above the diagonal as well
            trace += float(self.scale[rows] @ (block.mul_(matrix[rows, : rows.stop]) @ scale))
        return trace


@dataclass(frozen=True, eq=False)
class NormalEquations(AbstractRegression):
    """Normal equations of every sensor, before division by its noise's variance.

    Attributes:
        design: the unknowns.
        rows: linearised values.
        normal: `Σ X^T X` per sensor, rows already weighted.
        descent: `Σ X^T y`.
        square: `Σ y^T y`.
        sensors: how many values there are.
        latest: what was solved last, which the evidence, left-out values and the covariance are all made from.
    """

    design: Design
    rows: Rows
    normal: Float64[Tensor, "sensors unknowns unknowns"]
    descent: Float64[Tensor, "sensors unknowns"]
    square: tuple[float, ...]
    sensors: tuple[SensorCount, ...]
    latest: list[Solved] = field(default_factory=list, init=False)

    @staticmethod
    def of(design: Design, rows: Rows) -> "NormalEquations":
        """Sum up the rows, chunk by chunk.

        The columns of a joint's weights are its features times the derivative by its value, `J_j f_jm`. So for two
        joints `X_j^T X_i = f_j^T diag(J_j^T J_i) f_i`: the components of a value are summed before the products.
        """
        size = design.unknowns
        _return_free_memory(size)
        normal = design.problem.q.new_empty((len(rows.values), size, size))
        descent, square = normal.new_empty((len(rows.values), size)), []
        for k, sensor in enumerate(rows.values):
            square.append(_add_sums(design, sensor, normal[k], descent[k]))
        return NormalEquations(design, rows, normal, descent, tuple(square), rows.sensors)

    def select(self, design: Design) -> "NormalEquations":
        """See `AbstractRegression.select`."""
        if design.unknowns == self.design.unknowns and design.features == self.design.features:
            return self
        _return_free_memory(design.unknowns)
        columns = self.design.indices(design.features)
        normal = self.normal.new_empty((len(self.normal), len(columns), len(columns)))
        for whole, part in zip(self.normal, normal, strict=True):
            _copy_chosen(whole, columns, part)
        return replace(self, design=design, normal=normal, descent=self.descent[:, columns])

    def extended(self, design: Design) -> "NormalEquations":
        """The same rows for the unknowns of a design that has some of the features, and a new one as its last.

        Sums that are there already are copied.
        """
        self.latest.clear()
        _return_free_memory(design.unknowns)
        before = self.design.indices(design.features[:-1])
        first, new = len(before), slice(len(before), None)
        normal = self.normal.new_empty((len(self.normal), design.unknowns, design.unknowns))
        descent = torch.cat(
            [self.descent[:, before], normal.new_zeros((len(normal), len(normal[0]) - first))], 1
        )
        for N, b, whole, sensor in zip(normal, descent, self.normal, self.rows.values, strict=True):
            _copy_chosen(whole, before, N[:first, :first])
            N[new] = 0.0
            for rows in chunks(len(sensor.row), NARROW):
                root = sensor.root[rows, None]
                X = (design.columns(sensor, rows) * root[..., None]).flatten(0, 1)
                N[new].addmm_(X[:, new].t(), X)
                b[new].addmv_(X[:, new].t(), (sensor.residual[rows] * root).flatten())
            N[:first, new] = N[new, :first].t()
        return replace(self, design=design, normal=normal, descent=descent)

    def without(self, groups: Int64[Tensor, " groups"]) -> "NormalEquations":
        """See `AbstractRegression.without`."""
        other = NormalEquations.of(self.design, self.rows.held_out(groups))
        counts = zip(self.sensors, other.sensors, strict=True)
        return replace(
            self,
            normal=torch.sub(self.normal, other.normal, out=other.normal),
            descent=self.descent - other.descent,
            square=tuple(a - b for a, b in zip(self.square, other.square, strict=True)),
            sensors=tuple(replace(a, values=a.values - b.values) for a, b in counts),
        )

    def left_out(self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]) -> LeftOut:
        """See `AbstractRegression.left_out`."""
        solved = self._solved(posterior.prior, posterior.noise)
        return LeftOut.joined([self._left_out(groups, solved) for groups in folds])

    def _left_out(self, groups: Int64[Tensor, " groups"], solved: Solved) -> LeftOut:
        """Leave out one fold."""
        _return_free_memory(len(solved.x))
        test, x = self.rows.held_out(groups).values, solved.x
        whitened = x.new_empty((sum(sensor.residual.numel() for sensor in test), len(x)))
        r, number, first = [], [], 0
        for k, (sensor, sigma) in enumerate(zip(test, solved.noise, strict=True)):
            root = sensor.root[:, None] / sigma
            columns = self.design.columns(sensor, slice(None))
            r.append(((sensor.residual - columns @ x) * root).flatten())
            number.append(torch.full(r[-1].shape, k, device=x.device))
            block = whitened[first : first + len(r[-1])].view(columns.shape)
            torch.mul(columns, root[..., None], out=block).mul_(solved.scale)
            first += len(r[-1])
            del columns
        M = torch.eye(first, dtype=x.dtype, device=x.device)
        for rows in chunks(len(x), BLOCK):
            S = solved.inverse[rows, : rows.stop] @ whitened[:, : rows.stop].t()
            M.addmm_(S.t(), S, alpha=-1)
        return LeftOut.of(M, torch.cat(r), torch.cat(number), self.sensors)

    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """Solve `(Σ_s N_s / noise_s² + precision) x = Σ_s b_s / noise_s²` by Cholesky with column scaling."""
        precision = prior.precision
        solved = self._solved(prior, noise)
        x, held = solved.x, precision * solved.variance
        pairs = zip(self.normal[1:], noise[1:], strict=True)
        used = [solved.trace(N) / sigma**2 for N, sigma in pairs]
        used.insert(0, float((1 - held).sum()) - sum(used))  # the prior holds what the values do not
        misfit = self._misfits(x)
        log_prior = float(precision[precision > 0].log().sum())
        fit = sum(total / sigma**2 for total, sigma in zip(misfit, noise, strict=True))
        evidence = fit + float((x.square() * precision).sum()) + solved.log_det - log_prior
        evidence = -0.5 * (evidence + log_noise(self.sensors, noise))
        square, determined = prior.of_groups(x.square() * prior.base), prior.of_groups(1 - held)
        return Posterior(x, evidence, prior, noise, square, determined, misfit, tuple(used))

    def first_sizes(
        self, posterior: Posterior, design: Design, features: AbstractFeature
    ) -> tuple[float, Tensor | None]:
        """See `AbstractRegression.first_sizes`.

        The other unknowns are taken out of the normal equations (Schur complement), so that only the weights of the
        features are left.
        """
        columns = self.design.indices((*design.features, features))
        old, new = columns[: design.unknowns], columns[design.unknowns :]
        solved = self.select(design)._solved(posterior.prior, posterior.noise)
        normal = sum(N[new] * sigma**-2 for N, sigma in zip(self.normal, posterior.noise, strict=True))
        descent = sum(b * sigma**-2 for b, sigma in zip(self.descent, posterior.noise, strict=True))
        square = sum(total / sigma**2 for total, sigma in zip(self.square, posterior.noise, strict=True))
        cross = normal[:, old]
        root = solved.inverse @ (cross * solved.scale).t()
        rest = square - float(descent[old] @ solved.x)
        alone = replace(
            self,
            normal=(normal[:, new] - root.t() @ root)[None],
            descent=(descent[new] - cross @ solved.x)[None],
            square=(rest,),
            sensors=(SensorCount(float(len(new)), False, True),),
        )
        whole = Design(design.problem, (*design.features, features)).prior((1.0,) * design.classes)
        first = int(whole.group[design.unknowns :].min())
        prior = GaussianPrior(
            whole.base[design.unknowns :], whole.group[design.unknowns :] - first, whole.sizes[first:], 0
        )
        best = alone.maximise_evidence(prior, (1.0,))
        return best.log_evidence + rest / 2, best.prior.sizes

    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """See `AbstractRegression.covariance_root`; with the names of `Solved` it is `D L^-T`."""
        solved = self._solved(posterior.prior, posterior.noise)
        self.latest.clear()
        return CovarianceRoot(solved.inverse.t().mul_(solved.scale[:, None]))

    def _solved(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Solved:
        """What was solved last, or else solve now."""

        def normal() -> Tensor:
            torch.mul(self.normal[0], noise[0] ** -2, out=memory)
            for N, sigma in zip(self.normal[1:], noise[1:], strict=True):
                memory.add_(N, alpha=sigma**-2)
            memory.diagonal().add_(prior.precision)
            return memory

        if not self.latest or self.latest[0].prior is not prior or self.latest[0].noise != noise:
            _return_free_memory(len(prior.base))
            memory = self.latest.pop().inverse.mT if self.latest else torch.empty_like(self.normal[0])
            descent = torch.zeros_like(self.descent[0])
            for b, sigma in zip(self.descent, noise, strict=True):
                descent.add_(b, alpha=sigma**-2)
            scale, factor = factored(normal)
            log_det = log_determinant(scale, factor)
            inner = torch.linalg.solve_triangular(factor, (scale * descent)[:, None], upper=False)
            x = scale * torch.linalg.solve_triangular(factor.mT, inner, upper=True)[:, 0]
            _invert_triangle(factor)
            self.latest.append(Solved(prior, noise, scale, factor, log_det, x))
        return self.latest[0]

    def _misfits(self, x: Float64[Tensor, " unknowns"]) -> tuple[float, ...]:
        """`Σ (y - X x)²` per sensor."""
        cross = (self.descent @ x).tolist()
        inner = [float(x @ (N @ x)) for N in self.normal]
        return tuple(
            max(total - 2 * a + b, 0.0) for total, a, b in zip(self.square, cross, inner, strict=True)
        )


def log_noise(sensors: Sequence[SensorCount], noise: Sequence[float]) -> float:
    """`Σ log noise²` over all values."""
    pairs = zip(sensors, noise, strict=True)
    return sum(2 * sensor.values * math.log(sigma) for sensor, sigma in pairs)


def factored(matrix: Callable[[], Float64[Tensor, "unknowns unknowns"]]) -> tuple[Tensor, Tensor]:
    """Column scale, and Cholesky factor of a scaled symmetric matrix.

    Args:
        matrix: makes it, stored row by row; its upper triangle is read. As the factor takes its memory, it is made
            again where that fails.

    Raises:
        IdentificationError: the matrix is not finite.
    """
    jitter = 1e-14
    while True:
        scaled = matrix()
        scale = scaled.diagonal().clamp(min=1e-300).rsqrt()
        scaled.mul_(scale).mul_(scale[:, None]).diagonal().fill_(1 + jitter)
        by_column, status = scaled.mT, torch.empty((), dtype=torch.int32, device=scaled.device)
        factor, failed = torch.linalg.cholesky_ex(by_column, out=(by_column, status))
        if not failed:
            return scale, factor
        if not bool(torch.isfinite(matrix()).all()):
            raise IdentificationError(
                "the normal equations are not finite; look for values without limit in the measurements."
            )
        jitter *= 10


def log_determinant(scale: Tensor, factor: Tensor) -> float:
    """Of a matrix from what `factored` gives."""
    return 2 * float(factor.diagonal().log().sum()) - 2 * float(scale.log().sum())


def inverted(scale: Tensor, factor: Tensor) -> Float64[Tensor, "unknowns unknowns"]:
    """Inverse of a matrix from what `factored` gives, in the place of the factor."""
    inverse: Tensor = torch.cholesky_inverse(factor, out=factor).mT  # symmetric, and so stored row by row
    return inverse.mul_(scale).mul_(scale[:, None])


def _invert_triangle(factor: Tensor) -> None:
    """Put its inverse in the place of a lower triangular matrix: block by block, so that most of it are products."""
    blocks = chunks(len(factor), BLOCK)
    for number, rows in enumerate(blocks):
        diagonal = factor[rows, rows]
        identity = torch.eye(len(diagonal), dtype=factor.dtype, device=factor.device)
        inverse = torch.linalg.solve_triangular(diagonal, identity, upper=False)
        before = factor[rows, : rows.start].clone()
        for columns in blocks[:number]:
            inner = factor[columns.start : rows.start, columns]
            factor[rows, columns] = -inverse @ (before[:, columns.start :] @ inner)
        diagonal.copy_(inverse)


def _add_sums(design: Design, sensor: SensorValues, N: Tensor, b: Tensor) -> float:
    """Fill in normal matrix and right side of one sensor's values; their square is returned."""
    active, dof = design.active, sensor.joints.shape[-1]
    count = sum(chosen.count for chosen in design.features)
    size = active + dof * count
    normal = sensor.root.new_zeros((size, size))
    descent, square, weight = normal.new_zeros(size), 0.0, sensor.root.square()
    for rows in chunks(len(sensor.row)):
        G, y, w = sensor.geometry[rows], sensor.residual[rows], weight[rows]
        Gw = G * w[:, None, None]
        normal[:active, :active] += Gw.flatten(0, 1).t() @ G.flatten(0, 1)
        descent[:active] += Gw.flatten(0, 1).t() @ y.flatten()
        square += float((y.square() * w[:, None]).sum())
        sides = [(_feature_columns(design, row[rows]), joints[rows]) for row, joints in sensor.sides if count]
        for f, J in sides:
            Jw = J * w[:, None, None]
            along, pull = Jw.mT @ G, torch.einsum("rcj,rc->rj", Jw, y)
            for g, other in sides:
                shared = Jw.mT @ other
                for j in range(dof):
                    first = active + j * count
                    right = (g[:, j:] * shared[:, j, j:, None]).flatten(1)
                    normal[first : first + count, first:].addmm_(f[:, j].t(), right)
            for j in range(dof):
                block = slice(active + j * count, active + (j + 1) * count)
                normal[:active, block].addmm_(along[:, j].t(), f[:, j])
                descent[block].addmv_(f[:, j].t(), pull[:, j])
    order = torch.cat([torch.arange(active), active + _places(design, dof, count)])
    for rows in chunks(size):
        corner = normal[rows, rows]
        corner.copy_(corner.triu() + corner.triu(1).t())
        normal[rows.stop :, rows] = normal[rows, rows.stop :].t()
    _copy_chosen(normal, order, N)
    b.copy_(descent[order])
    return square


def _copy_chosen(matrix: Tensor, chosen: Int64[Tensor, " chosen"], to: Tensor) -> None:
    """Copy some rows and columns of a matrix, without another one beside the two."""
    for rows in chunks(len(chosen)):
        torch.index_select(matrix[chosen[rows]], 1, chosen, out=to[rows])


def _feature_columns(design: Design, row: Tensor) -> Float64[Tensor, "rows dof columns"]:
    """Columns of all features at some rows of the problem, those that a joint does not have as well."""
    state = design.problem.state[row]
    return torch.cat([chosen.columns(state) for chosen in design.features], -1)


def _places(design: Design, dof: int, count: int) -> Int64[Tensor, " weights"]:
    """Where the weights stand, joint by joint and all columns of all features in turn."""
    first, places = 0, [torch.zeros(0, dtype=torch.int64)]
    for chosen in design.features:
        own = torch.arange(dof)[:, None] * count + first + torch.arange(chosen.count)
        places.append(own[chosen.used])
        first += chosen.count
    return torch.cat(places)


def _return_free_memory(unknowns: int) -> None:
    """Give free memory back to the system where the C library offers that (`malloc_trim` of glibc); else do nothing.

    After fits of thousands of unknowns more than 100 MB are free in pieces between what is in use, and the matrices of
    the next fit would come on top of them.
    """
    if unknowns > MANY_UNKNOWNS and sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
