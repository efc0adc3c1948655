"""Simulated touches, in which the robot moves along the normal of a face until the true tip meets the face."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import Place, UnreachablePoseError
from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.faults import Fault
from pisigma.measurement.fields import UnusableRow
from pisigma.robot.kinematics.joint_limits import wrap_into_limits
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, transform
from pisigma.simulation.noise import NoiseDraws, SensorNoise, draw_noise, row_sigma
from pisigma.simulation.touch_candidates import JigPlacement, TouchCandidates, TouchCandidatesSection
from pisigma.simulation.true_robot import TrueRobot

OnMiss = Literal["error", "leave_out"]

_CONTACT_TOLERANCE = 1e-13
"""Distance of the tip from the coordinate of the touch [m] at which the approach ends."""
MAX_ITERATIONS = 50
"""Largest number of iterations, after which the approach fails; about ten are needed."""


class SimulatedTouches(Section):
    """Section of a recipe for touches on faces of jigs.

    Attributes:
        kind: "touches".
        placements: placements of the jigs; each placement is a frame.
        candidates: touches on every placement.
        noise: noise of the touches and of the robot; no noise by default.
        on_miss: "error", or "leave_out" to continue without touches that miss their face and to report them.
    """

    kind: Literal["touches"]
    placements: tuple[JigPlacement, ...] = Field(min_length=1)
    candidates: TouchCandidatesSection
    noise: SensorNoise | None = None
    on_miss: OnMiss = "error"

    def measure(self, robot: TrueRobot) -> Measurements:
        """Return the simulated touches, identical for every call; see `simulate_touches`."""
        candidates = self.candidates.find(robot.nominal, self.placements)
        travel = self.candidates.travel_mm / 1e3
        return simulate_touches(robot, self.placements, candidates, self.noise, travel, self.on_miss)


def simulate_touches(
    robot: TrueRobot,
    placements: Sequence[JigPlacement],
    candidates: TouchCandidates,
    noise: SensorNoise | None = None,
    travel: float = 0.06,
    on_miss: OnMiss = "error",
) -> Measurements:
    """Touch faces with the true robot.

    The controller moves the tool along the normal of the face with constant orientation, using the nominal inverse
    kinematics and the nominal placement of the jig. It stops when the true tip is at the coordinate of the face in the
    frame of the jig at its true placement: `e_axis · T_jig_base · FK_true(q) = coordinate + n`. The row contains the
    joint values commanded at the contact, and the coordinate of the face, which is known from the jig; n is the
    noise of the touch, and the robot's repeatability shifts the tip during the whole approach. Encoder steps are
    ignored.

    Args:
        robot: the true robot.
        placements: placements of the jigs, in the order of `candidates.placements`.
        candidates: the touches.
        noise: noise of the touches and of the robot; None for no noise.
        travel: distance [m] before and behind the expected position of the face within which the face is searched for.
        on_miss: "error" or "leave_out" for touches that do not meet their face within the travel or miss its edges.

    Returns:
        One row per touch, with the placement's name as its frame, and with the standard deviation of the noise if
        there is any.

    Raises:
        UnreachablePoseError: a touch misses its face, and `on_miss` is "error".
    """
    draws = draw_noise(noise, candidates.count)
    contact = _approach(robot.without_encoder(), placements, candidates, draws, travel)
    met = contact.met & _on_faces(placements, candidates, contact.tip)
    _, inside = wrap_into_limits(robot.nominal, contact.q)
    met = met & inside
    source = f"simulation of {robot.nominal.name}"
    missed = (~met).nonzero()[:, 0].tolist()
    left_out = tuple(UnusableRow.from_fault(0, _miss(candidates, row, contact)) for row in missed)
    if left_out and on_miss == "error":
        raise UnreachablePoseError(
            f"{len(left_out)} of {candidates.count} touches miss: {left_out[0].reason}",
            at=Place(source),
            option="touches",
            value=missed[0],
            remedy="correct the placement, choose more margin or travel, or omit such touches with on_miss",
        )
    touched = replace(candidates.select(met), q=contact.q[met])
    sigma = row_sigma(noise, touched.count)
    return replace(touched.as_measurements(), sigma_position=sigma, source=source, left_out=left_out)


@dataclass(frozen=True, eq=False)
class _Contact:
    """State of robot and tip at the ends of the approaches.

    Attributes:
        q: joint values commanded at the end of the approach [rad or m].
        tip: true tip in the frame of the jig at its true placement [m].
        moved: distance by which the controller moved inward of the expected contact [m].
        met: whether the tip reached the coordinate of the face within the travel.
    """

    q: Float64[Tensor, "touches dof"]
    tip: Float64[Tensor, "touches 3"]
    moved: Float64[Tensor, " touches"]
    met: Bool[Tensor, " touches"]


def _approach(
    robot: TrueRobot,
    placements: Sequence[JigPlacement],
    candidates: TouchCandidates,
    draws: NoiseDraws,
    travel: float,
) -> _Contact:
    """Move the commanded tips by the gaps of the true tips until the gaps are closed.

    The true tip moves almost as far as the commanded tip, so every iteration reduces the gap to a few percent.
    """
    Ts_jig_base = torch.stack([p.T_jig_base for p in placements])[candidates.placement]
    true_Ts_jig_base = torch.stack([p.true_T_jig_base for p in placements])[candidates.placement]
    T = invert(Ts_jig_base) @ candidates.T_jig_tool
    along = torch.nn.functional.one_hot(candidates.axis, 3).to(T)
    inward = -(Ts_jig_base[:, :3, :3].mT @ (along * candidates.outward_sign[:, None])[..., None])[..., 0]
    coordinate = candidates.face_coordinate + draws.sensor[:, 0]
    moved, q = torch.zeros_like(coordinate), candidates.q
    for _ in range(MAX_ITERATIONS):
        here = transform(T[:, :3, :3], T[:, :3, 3] + moved[:, None] * inward)
        solution = solve_numeric(robot.nominal, here, q)
        q = solution.q
        position = robot.forward(q)[:, :3, 3] + draws.robot
        tip = (true_Ts_jig_base[:, :3, :3] @ position[..., None])[..., 0] + true_Ts_jig_base[:, :3, 3]
        gap = candidates.outward_sign * ((tip * along).sum(-1) - coordinate)
        open_ = (
            (gap.abs() > _CONTACT_TOLERANCE)
            & (moved.abs() <= travel)
            & (solution.status != Status.NOT_CONVERGED)
        )
        if not open_.any():
            break
        moved = torch.where(open_, moved + gap, moved)
    met = (
        (gap.abs() <= 10 * _CONTACT_TOLERANCE)
        & (moved.abs() <= travel)
        & (solution.status != Status.NOT_CONVERGED)
    )
    return _Contact(q, tip, moved, met)


def _on_faces(
    placements: Sequence[JigPlacement], candidates: TouchCandidates, tip: Float64[Tensor, "touches 3"]
) -> Bool[Tensor, " touches"]:
    """Return whether the tips meet their faces within the edges."""
    on = torch.zeros(candidates.count, dtype=torch.bool)
    for number, placement in enumerate(placements):
        rows = candidates.placement == number
        on[rows] = placement.load_jig().is_on_face(candidates.face[rows], tip[rows])
    return on


def _miss(candidates: TouchCandidates, row: int, contact: _Contact) -> Fault:
    """Return the fault of a touch that misses, with the tip's position [mm] if it reached the coordinate."""
    name = f"touch {row} (counted from 0) along {candidates.touch_axis[row]} of jig '{candidates.frame[row]}'"
    if bool(contact.met[row]):
        tip = ", ".join(f"{value:.1f}" for value in (1e3 * contact.tip[row]).tolist())
        return Fault(f"{name} misses the edges of its face or the joint limits, at {tip} mm", value=tip)
    return Fault(f"{name} does not reach its face within the travel")
