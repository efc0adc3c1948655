"""Where a frame that was only touched stands: a start without a guess."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import IdentificationError, nearest_choice
from pisigma.identification.initial_guess.base_and_tool_closed_form import nearest_rotation
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import rotation_from_rpy, rotation_from_vector, rpy_from_rotation, skew

FEWEST = 4
"""Touches along an axis from which its direction is found."""
CLEAR = 0.03
"""The least spread of the tips, as a share of their largest, from which a direction is found."""
POLISH = 10
"""Steps after the linear solution."""
NEAR = 0.05
"""A start must meet the touches to this share of the robot's reach."""
UNKNOWNS = 6


def touched_base(
    tip: Float64[Tensor, "touches 3"],
    axis: Int64[Tensor, " touches"],
    touch: Float64[Tensor, " touches"],
    guess: Float64[Tensor, " 6"],
) -> tuple[Float64[Tensor, " 6"], float]:
    """Find T_frame_robot from touches with tips known in the robot's frame.

    `touch = R[axis] · tip + p[axis]` is linear in R and p for every axis on its own; from two axes the third
    follows. Then all six unknowns are polished together. Where the linear solution is unclear, the guess is
    polished instead.

    Args:
        tip: where the robot as drawn has its tip [m].
        axis: which axis of the frame was touched along.
        touch: the coordinate there [m].
        guess: the robot's own base, x, y, z [m], roll, pitch, yaw [rad].

    Returns:
        The base, and the root mean square by which it misses the touches [m].
    """
    starts = [(rotation_from_rpy(guess[3:]), guess[:3])]
    linear = _linear_rotation(tip, axis, touch)
    if linear is not None:
        starts.insert(0, (linear, torch.zeros(3).to(tip)))
    best, miss = guess, float("inf")
    for R, p in starts:
        R, p, rms = _polished(tip, axis, touch, R, p)
        if rms < miss:
            best, miss = torch.cat([p, rpy_from_rotation(R)]), rms
    return best, miss


def _linear_rotation(tip: Tensor, axis: Tensor, touch: Tensor) -> Tensor | None:
    rows: list[Tensor | None] = []
    for k in range(3):
        points, values = tip[axis == k], touch[axis == k]
        rows.append(None)
        if len(points) < FEWEST:
            continue
        centred = points - points.mean(0)
        singular = torch.linalg.svdvals(centred)
        if float(singular[-1]) > CLEAR * float(singular[0]):
            row = torch.linalg.lstsq(centred, (values - values.mean())[:, None]).solution[:, 0]
            rows[k] = row / row.norm().clamp(min=1e-12)
    for k in range(3):
        following, last = rows[(k + 1) % 3], rows[(k + 2) % 3]
        if rows[k] is None and following is not None and last is not None:
            rows[k] = torch.linalg.cross(following, last)
    known = [row for row in rows if row is not None]
    return nearest_rotation(torch.stack(known)) if len(known) == 3 else None


def _polished(tip: Tensor, axis: Tensor, touch: Tensor, R: Tensor, p: Tensor) -> tuple[Tensor, Tensor, float]:
    rows = torch.arange(len(tip))
    eye = torch.eye(3).to(tip)[axis]
    residual = touch - (tip @ R.mT + p)[rows, axis]
    for _ in range(POLISH):
        turned = tip @ R.mT
        J = torch.cat([eye, (-skew(turned))[rows, axis]], -1)
        step = torch.linalg.pinv(J, rtol=1e-6) @ residual
        R, p = rotation_from_vector(step[3:]) @ R, p + step[:3]
        residual = touch - (tip @ R.mT + p)[rows, axis]
    return R, p, float(residual.square().mean().sqrt())


def check_touched_base(measurements: Measurements, name: str, rms: float, reach: float) -> None:
    """Refuse a start of a touched frame that is nowhere near its touches.

    Raises:
        IdentificationError: see above.
    """
    if rms <= NEAR * reach:
        return
    counts = ", ".join(f"{(measurements.touch_axis or ()).count(axis)} along {axis}" for axis in "xyz")
    raise IdentificationError(
        f"{measurements.source}: the touches of frame '{name}' ({counts}) do not tell where it stands (the best "
        f"place misses them by {rms * 1e3:.3g} mm); check that they are all of this frame, or say about where "
        f"the robot's base is in it, frames={{'{name}': (x, y, z, roll, pitch, yaw)}}."
    )


def check_frame_values(measurements: Measurements, names: tuple[str, ...]) -> None:
    """Refuse frames with touches that are used up by the frame's own six unknowns.

    Raises:
        IdentificationError: see above.
    """
    if measurements.touch is None:
        return
    touch = measurements.measured("touch").tolist()
    other = (measurements.measured("position") | measurements.measured("pose")).tolist()
    for name in names:
        rows = [row for row, frame in enumerate(measurements.frame) if frame == name]
        touches = sum(touch[row] for row in rows)
        if not touches or any(other[row] for row in rows) or touches > UNKNOWNS:
            continue
        times = "once" if touches == 1 else f"{touches} times"
        raise IdentificationError(
            f"{measurements.source}: frame '{name}' was touched {times} only, which does not even tell where it "
            f"stands ({UNKNOWNS} unknowns); touch it about {3 * UNKNOWNS} times along x, y and z, or leave its "
            "rows out."
        )


def check_frame_names(given: dict[str, object], frames: tuple[str, ...], source: str) -> None:
    """Refuse starts of frames that were not measured in.

    Raises:
        IdentificationError: see above.
    """
    for name in given:
        if name not in frames:
            raise IdentificationError(
                f"{source}: frames gives a start of '{name}', but no row is in a frame of that name; "
                f"{nearest_choice(name, frames)}"
            )
