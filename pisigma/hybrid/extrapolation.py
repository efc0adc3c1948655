"""How far beyond the measured joint values a correction may be trusted: tried on the outermost measured rows."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.hybrid.coverage import JointCoverage, share_beyond
from pisigma.hybrid.design import Design, sum_up
from pisigma.hybrid.evidence import Posterior, Sums, maximise_evidence, solve_mean
from pisigma.hybrid.rows import Rows

TAIL = 0.2
"""Share of the configurations at either end of a joint's range that is left out."""
FADES = tuple(math.radians(angle) for angle in (1, 5, 10, 15, 20, 30, 45))
"""Angles [rad] that are tried."""
DENSE = 200
"""From so many configurations on, joint values beyond the measured ones are rare, and no way into them is safe far."""
DENSE_FADE = math.radians(10)
"""Longest angle then."""


def fade_angle(rows: Rows, design: Design, hybrid: Posterior, sums: Sums) -> float:
    """Angle beyond the measured joint values over which a correction fades best [rad].

    For either end of every joint, the hybrid and the geometry alone are solved without the outermost
    configurations (prior sizes and noise as they are) and predict them. The angle is that of `FADES` whose blend of
    the two predictions errs least; it is not longer than those rows are far out. Of few configurations new ones
    often lie far beyond the measured joint values, so it may be long; of many it is not longer than `DENSE_FADE`:
    on the UR5 the outermost rows did not tell how the correction errs 20 to 70 degrees out.

    Args:
        rows: linearised values.
        design: unknowns of the hybrid.
        hybrid: posterior of them.
        sums: normal equations of all rows.
    """
    q, robot = rows.problem.q, rows.problem.space.robot
    geometry = torch.arange(design.active, device=q.device)
    alone = sums.select(geometry)
    geometric = maximise_evidence(alone, hybrid.prior.select(geometry), hybrid.noise)
    before, after, beyond = [], [], []
    for tail in _tails(rows):
        test = rows.of(tail)
        part = sum_up(design, test.values, test.start(design))
        x_alone = solve_mean(alone.minus(part.select(geometry)), geometric.prior, geometric.noise)
        x = solve_mean(sums.minus(part), hybrid.prior, hybrid.noise)
        off = JointCoverage.of(robot, q[~tail[rows.configuration]]).beyond(q).amax(-1)
        for sensor, sigma in zip(test.values, geometric.noise, strict=True):
            if not sensor.certain:
                X = design.columns(sensor, slice(None))
                y = sensor.residual + X @ test.start(design)
                root = sensor.root[:, None] / sigma
                before.append(((y - X[..., : design.active] @ x_alone) * root).flatten())
                after.append(((y - X @ x) * root).flatten())
                beyond.append(off[sensor.row].repeat_interleave(sensor.components))
    if not beyond:
        return FADES[0]
    longest = DENSE_FADE if rows.configurations >= DENSE else FADES[-1]
    return _best(torch.cat(beyond), torch.cat(before), torch.cat(after), longest)


def _best(beyond: Tensor, before: Tensor, after: Tensor, longest: float) -> float:
    """The angle of the blend that errs least."""
    candidates = [angle for angle in FADES if angle <= max(min(float(beyond.max()), longest), FADES[0])]
    costs = []
    for angle in candidates:
        share = share_beyond(beyond, angle)
        costs.append(float((share * after + (1 - share) * before).square().sum()))
    return candidates[costs.index(min(costs))]


def _tails(rows: Rows) -> Iterator[Bool[Tensor, " configurations"]]:
    """The outermost configurations at either end of every joint."""
    q = rows.problem.q
    count = rows.configurations
    first = torch.full((count,), len(q), dtype=torch.int64, device=q.device)
    first = first.scatter_reduce(0, rows.configuration, torch.arange(len(q), device=q.device), "amin")
    size = max(math.ceil(TAIL * count), 1)
    for values in q[first].t():
        order = values.argsort()
        for end in (order[:size], order[-size:]):
            mask = torch.zeros(count, dtype=torch.bool, device=q.device)
            mask[end] = True
            if size < count and float(values[end].max() - values[end].min()) > 0:
                yield mask
