"""Predicting every configuration from all others, in closed form."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.hybrid.design import Design, Rows, sum_up
from pisigma.hybrid.evidence import Posterior, Sums, maximise_evidence

CHUNK = 2_048
"""Values that are worked on together."""
FOLDS = 4
FOLD_UPDATES = 4
"""Updates of noise and prior sizes for every fold left out."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of all values when their configuration is left out, in standard deviations of the noise.

    Attributes:
        error: measured minus predicted.
        spread: its predicted standard deviation, parameters and noise.
        configuration: of every value.
        sensor: number of its sensor.
    """

    error: Float64[Tensor, " values"]
    spread: Float64[Tensor, " values"]
    configuration: Int64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]


def left_out(rows: Rows, design: Design, posterior: Posterior) -> LeftOut:
    """Leave out one configuration after the other, prior sizes, noise and fixed factors as they are.

    With X, r and I of one configuration's values (whitened; r after the fit to all), the error when it is left out
    is `(I - X C X^T)^-1 r`, and its covariance `(I - X C X^T)^-1` (Cook and Weisberg 1982, section 2.2).
    """
    blocks = []
    for configuration, kind, X, r in _configurations(rows, design, posterior):
        hat = X @ posterior.covariance @ X.mT
        inverse = torch.linalg.inv((1 + 1e-12) * torch.eye(hat.shape[-1]).to(hat) - hat)
        error = (inverse @ r[..., None])[..., 0]
        blocks.append((error, inverse.diagonal(dim1=-2, dim2=-1).clamp(min=1.0).sqrt(), configuration, kind))
    return _joined(blocks)


def folds_left_out(rows: Rows, design: Design, posterior: Posterior, sums: Sums) -> LeftOut:
    """Leave out one of `FOLDS` folds of the configurations after the other, noise and prior sizes estimated anew.

    Where there are few rows the noise and the many prior sizes themselves are uncertain, which leaving out single
    configurations does not show.

    Args:
        rows: linearised values.
        design: the unknowns.
        posterior: of them, with all rows.
        sums: normal equations of all rows.
    """
    blocks = []
    for k in range(FOLDS):
        test = rows.of(rows.shuffled()[k::FOLDS])
        rest = sums.minus(sum_up(design, test.values, test.start(design)))
        without = maximise_evidence(rest, posterior.prior, posterior.noise, FOLD_UPDATES)
        for configuration, kind, X, r in _configurations(test, design, without):
            variance = ((X @ without.covariance) * X).sum(-1)
            blocks.append((r, (1 + variance.clamp(min=0)).sqrt(), configuration, kind))
    return _joined(blocks)


def _joined(blocks: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]]) -> LeftOut:
    return LeftOut(
        *(torch.cat([values.flatten() for values in column]) for column in zip(*blocks, strict=True))
    )


def _configurations(
    rows: Rows, design: Design, posterior: Posterior
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Configurations with equally many values together: configuration, sensor, columns and residuals."""
    change = rows.start(design) - posterior.x
    collected = []
    for number, sensor in enumerate(rows.values):
        if not sensor.certain:
            index = torch.arange(len(sensor.row), device=sensor.row.device)
            collected.append((rows.configuration[sensor.row], torch.full_like(index, number), index))
    configuration, kind, offset = (torch.cat(column) for column in zip(*collected, strict=True))
    order = torch.argsort(configuration * len(rows.values) + kind, stable=True)
    configuration, kind, offset = configuration[order], kind[order], offset[order]
    sizes = torch.tensor([sensor.components for sensor in rows.values], device=kind.device)[kind]
    # Configurations whose rows are of the same kinds have columns of one shape.
    owner, counts = torch.unique_consecutive(configuration, return_counts=True)
    firsts = torch.cumsum(counts, 0) - counts
    shape = torch.zeros_like(owner).index_add(
        0, torch.repeat_interleave(torch.arange(len(owner)), counts), kind + 1
    )
    key = (shape * (int(counts.max()) + 1) + counts) if len(owner) else shape
    for like in torch.unique(key).tolist():
        chosen = (key == like).nonzero()[:, 0]
        count = int(counts[chosen[0]])
        values = int(sizes[firsts[chosen[0]] : firsts[chosen[0]] + count].sum())
        for part in chosen.split(max(CHUNK // values, 1)):
            blocks = [
                _whitened(rows, design, posterior, change, kind[firsts[part] + k], offset[firsts[part] + k])
                for k in range(count)
            ]
            X, r, kinds = (torch.cat(column, 1) for column in zip(*blocks, strict=True))
            yield owner[part][:, None].expand(r.shape), kinds, X, r


def _whitened(
    rows: Rows, design: Design, posterior: Posterior, change: Tensor, kind: Tensor, offset: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Columns, residuals and sensor of one row of each of some configurations, all of the same sensor."""
    number = int(kind[0])
    sensor = rows.values[number].select(offset)
    X = design.columns(sensor, slice(None))
    root = sensor.root[:, None] / posterior.noise[number]
    r = (sensor.residual + X @ change) * root
    return X * root[..., None], r, torch.full(r.shape, number, device=r.device)
