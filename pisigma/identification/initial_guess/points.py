"""Where sockets, anchors and tools are: starts from the robot as drawn, without a guess."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.measurement.dataset import Measurements

LEAST_TURN = 0.02
"""Directions of the tool that the orientations in sockets tell less than this stay as drawn."""
FEWEST = 5
"""Distances from which the place of their anchor is found."""
POLISH = 10
"""Steps after the linear solution."""
WRONG = 0.05
"""[reach] The robot as drawn is not as wrong as this."""
COMPARED = 1_024
"""Distances that are compared with each other."""


def tool_from_sockets(
    R: Float64[Tensor, "rows 3 3"],
    p: Float64[Tensor, "rows 3"],
    socket: Int64[Tensor, " rows"],
    guess: Float64[Tensor, " 3"],
) -> Float64[Tensor, " 3"]:
    """Find the ball behind the flange such that the rows of every socket meet best.

    `R · ball + p - socket = 0` is linear in both; the sockets drop out with the means over their rows.
    Directions that the orientations hardly tell stay at the guess.

    Args:
        R: orientations of the flange, one target's rows.
        p: its positions [m].
        socket: number of every row's socket.
        guess: the ball's place as drawn [m].
    """
    turn = _centred(R.flatten(1), socket).view(-1, 3, 3).flatten(0, 1)
    off = -_centred(p + (R @ guess), socket).flatten()
    rtol = LEAST_TURN * len(R) ** 0.5 / max(float(torch.linalg.matrix_norm(turn, 2)), 1e-12)
    found: Tensor = guess + torch.linalg.pinv(turn, rtol=min(rtol, 1.0)) @ off
    return found


def means(values: Float64[Tensor, "rows size"], number: Int64[Tensor, " rows"], count: int) -> Tensor:
    """The mean of every number's rows."""
    total = values.new_zeros((count, values.shape[1])).index_add(0, number, values)
    return total / torch.bincount(number, minlength=count).clamp(min=1)[:, None]


def _centred(values: Tensor, number: Tensor) -> Tensor:
    return values - means(values, number, int(number.max()) + 1)[number]


def check_sockets(
    measurements: Measurements,
    socket: Int64[Tensor, " rows"],
    points: Float64[Tensor, "rows 3"],
    reach: float,
) -> None:
    """Refuse sockets at which the robot as drawn is all over the place.

    Args:
        measurements: what complaints name.
        socket: number of every row's socket, -1 where there is none.
        points: where the robot as drawn has the ball [m].
        reach: of the robot [m].

    Raises:
        IdentificationError: see above.
    """
    seen = socket >= 0
    if not bool(seen.any()):
        return
    scatter = _centred(points[seen], socket[seen]).norm(dim=-1)
    usual = float(scatter.median())
    if usual > WRONG * reach:
        raise IdentificationError(
            f"{measurements.source}: by the robot as drawn the rows of one socket are about {usual * 1e3:.3g} mm "
            "away from each other; check the directions and zeros of the joints, the tool, and the names of the "
            "sockets."
        )


def anchor_from_distances(
    points: Float64[Tensor, "rows 3"], distance: Float64[Tensor, " rows"]
) -> Float64[Tensor, " 4"]:
    """Find an anchor and its zero from distances to known points (multilateration).

    `(d - zero)² = |p - a|²` is linear in a, zero and `|a|² - zero²`; then `|p - a| + zero = d` is polished.

    Args:
        points: where the robot as drawn has the tool [m].
        distance: what was shown there [m].

    Returns:
        x, y, z, zero [m].
    """
    centre, middle = points.mean(0), distance.mean()
    p, d = points - centre, distance - middle
    A = torch.cat([-2 * p, 2 * d[:, None], torch.ones_like(d)[:, None]], -1)
    solution = torch.linalg.pinv(A, rtol=1e-4) @ (d.square() - p.square().sum(-1))
    linear = torch.cat([solution[:3], solution[3:4]])
    without_zero = torch.linalg.pinv(A[:, [0, 1, 2, 4]], rtol=1e-6) @ (distance.square() - p.square().sum(-1))
    other = torch.cat([without_zero[:3], -middle[None]])
    best, miss = linear, float("inf")
    for start in (linear, other):
        found, rms = _polished(p, d, start)
        if rms < miss:
            best, miss = found, rms
    return best + torch.cat([centre, middle[None]])


def _polished(p: Tensor, d: Tensor, unknown: Tensor) -> tuple[Tensor, float]:
    def seen(unknown: Tensor) -> tuple[Tensor, Tensor]:
        away = p - unknown[:3]
        length = away.norm(dim=-1).clamp(min=1e-9)
        J = torch.cat([-away / length[:, None], torch.ones_like(length)[:, None]], -1)
        return d - length - unknown[3], J

    residual, J = seen(unknown)
    damping = 1e-6
    for _ in range(3 * POLISH):
        normal = J.mT @ J
        trial = unknown + torch.linalg.solve(
            normal + damping * torch.diag(normal.diagonal()), J.mT @ residual
        )
        there, J_there = seen(trial)
        if float(there.square().sum()) <= float(residual.square().sum()):
            unknown, residual, J, damping = trial, there, J_there, damping / 10
        else:
            damping *= 100
    return unknown, float(residual.square().mean().sqrt())


def check_wire(
    measurements: Measurements,
    name: str,
    rows: Int64[Tensor, " rows"],
    points: Float64[Tensor, "rows 3"],
    distance: Float64[Tensor, " rows"],
    reach: float,
) -> None:
    """Refuse distances from an anchor that no place of it allows.

    By the triangle's inequality two readings differ by no more than the points are apart, whatever the zero.

    Raises:
        IdentificationError: a reading is impossible beside most of the others, or there are too few.
    """
    if len(rows) < FEWEST:
        raise IdentificationError(
            f"{measurements.source}: anchor '{name}' has {len(rows)} distances, but its place and zero are 4 "
            "unknowns; measure more poses from it, spread over the workspace."
        )
    rows, points, distance = rows[:COMPARED], points[:COMPARED], distance[:COMPARED]
    excess = (distance[:, None] - distance).abs() - torch.cdist(points, points) - WRONG * reach
    wrong = (excess > 0).sum(1)
    worst = int(wrong.argmax())
    if int(wrong[worst]) == 0:
        return
    partner = int(excess[worst].argmax())
    short = distance[worst] < distance[partner]
    raise IdentificationError(
        f"{measurements.place(int(rows[worst]))}: the distance {float(distance[worst]) * 1e3:.6g} mm from anchor "
        f"'{name}' is {'shorter' if short else 'longer'} than any place of the anchor allows: in "
        f"{measurements.place(int(rows[partner]))} it is {float(distance[partner]) * 1e3:.6g} mm, though the tool "
        f"is only {float((points[worst] - points[partner]).norm()) * 1e3:.4g} mm away; correct it or remove it."
    )


def check_pairs(
    measurements: Measurements,
    rows: Int64[Tensor, " rows"],
    apart: Float64[Tensor, " rows"],
    distance: Float64[Tensor, " rows"],
    reach: float,
) -> None:
    """Refuse distances between two poses that are far from what the robot as drawn has.

    Raises:
        IdentificationError: see above.
    """
    off = (distance - apart).abs()
    if len(off) == 0 or float(off.max()) <= 4 * WRONG * reach:
        return
    worst = int(off.argmax())
    row = int(rows[worst])
    name = (measurements.pair or ("",) * measurements.rows)[row]
    raise IdentificationError(
        f"{measurements.place(row)}: pair '{name}' is {float(distance[worst]) * 1e3:.6g} mm apart, but the robot "
        f"as drawn has its two tool points {float(apart[worst]) * 1e3:.4g} mm apart; correct the distance or the "
        "names of the pairs."
    )
