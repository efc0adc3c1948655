"""Touches: the robot moves along a face's normal until the tip really meets the face."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import UnreachablePoseError
from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import LeftOut
from pisigma.robot.kinematics.joint_limits import wrap_into_limits
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import invert, transform
from pisigma.simulation.noise import NoiseDraws, SensorNoise, draw_noise, row_sigma
from pisigma.simulation.touch_candidates import JigPlacement, TouchCandidates, TouchCandidatesSection
from pisigma.simulation.true_robot import TrueRobot

OnMiss = Literal["error", "leave_out"]

CONTACT = 1e-13
"""[m] How near the tip comes to the coordinate at which it touches."""
STEPS = 50
"""Steps after which the approach is given up; it needs some ten."""


class SimulatedTouches(Section):
    """The part of a recipe that states which faces of which jigs are touched.

    Attributes:
        kind: "touches".
        placements: of the jigs; each is a frame.
        candidates: which touches are made on each of them.
        noise: of touching and of the robot; left out, both are exact.
        on_miss: "error", or "leave_out" to go on without touches that miss their face and to report them.
    """

    kind: Literal["touches"]
    placements: tuple[JigPlacement, ...] = Field(min_length=1)
    candidates: TouchCandidatesSection
    noise: SensorNoise | None = None
    on_miss: OnMiss = "error"

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate the touches, the same at every call. See `simulate_touches`."""
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

    The controller moves the tool along the normal of the face, keeping its orientation, by the nominal
    inverse kinematics and where the jig is believed to stand. It stops when the true tip is at the coordinate
    of the face, in the frame of the jig as it really stands: `e_axis · T_jig_base · FK_true(q) = coordinate +
    n`. The row holds the joint values commanded there and the coordinate of the face, which is known from the
    jig; n is the noise of touching, and the robot's repeatability shifts its tip during the whole approach.
    Encoder steps are left out.

    Args:
        robot: the true robot.
        placements: of the jigs, in the order of `candidates.placements`.
        candidates: what to touch.
        noise: of touching and of the robot; None is exact.
        travel: how far [m] before and behind the place where it is expected the face is looked for.
        on_miss: what happens with touches that do not meet their face within the travel or beyond its edges.

    Returns:
        One row per touch, its frame the placement's name, with the standard deviation of the noise where
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
    left_out = tuple(LeftOut(0, _miss(candidates, row, contact)) for row in (~met).nonzero()[:, 0].tolist())
    if left_out and on_miss == "error":
        raise UnreachablePoseError(
            f"{source}: {left_out[0].reason} ({len(left_out)} of {candidates.count} touches "
            "miss); correct the placement, ask for more margin or travel, or leave such touches out with on_miss."
        )
    touched = replace(candidates.select(met), q=contact.q[met])
    sigma = row_sigma(noise, touched.count)
    return replace(touched.as_measurements(), sigma_position=sigma, source=source, left_out=left_out)


@dataclass(frozen=True, eq=False)
class _Contact:
    """Where the approaches ended.

    Attributes:
        q: joint values commanded there [rad or m].
        tip: true tip in the frame of the jig as it stands [m].
        moved: how far inward of the expected contact the controller went [m].
        met: whether the tip came to the face within the travel.
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
    """Move all touches on by their gaps until these are closed.

    The true tip moves as far as the commanded one but for the errors' share, so each step leaves a few
    percent.
    """
    Ts_jig_base = torch.stack([p.T_jig_base for p in placements])[candidates.placement]
    true_Ts_jig_base = torch.stack([p.true_T_jig_base for p in placements])[candidates.placement]
    T = invert(Ts_jig_base) @ candidates.T_jig_tool
    along = torch.nn.functional.one_hot(candidates.axis, 3).to(T)
    inward = -(Ts_jig_base[:, :3, :3].mT @ (along * candidates.sign[:, None])[..., None])[..., 0]
    wanted = candidates.coordinate + draws.sensor[:, 0]
    moved, q = torch.zeros_like(wanted), candidates.q
    for _ in range(STEPS):
        here = transform(T[:, :3, :3], T[:, :3, 3] + moved[:, None] * inward)
        solution = solve_numeric(robot.nominal, here, q)
        q = solution.q
        position = robot.forward(q)[:, :3, 3] + draws.robot
        tip = (true_Ts_jig_base[:, :3, :3] @ position[..., None])[..., 0] + true_Ts_jig_base[:, :3, 3]
        gap = candidates.sign * ((tip * along).sum(-1) - wanted)
        open_ = (gap.abs() > CONTACT) & (moved.abs() <= travel) & (solution.status != Status.NOT_CONVERGED)
        if not open_.any():
            break
        moved = torch.where(open_, moved + gap, moved)
    met = (gap.abs() <= 10 * CONTACT) & (moved.abs() <= travel) & (solution.status != Status.NOT_CONVERGED)
    return _Contact(q, tip, moved, met)


def _on_faces(
    placements: Sequence[JigPlacement], candidates: TouchCandidates, tip: Float64[Tensor, "touches 3"]
) -> Bool[Tensor, " touches"]:
    """Whether the tips meet their faces and not the air beside them."""
    on = torch.zeros(candidates.count, dtype=torch.bool)
    for number, placement in enumerate(placements):
        rows = candidates.placement == number
        on[rows] = placement.load_jig().on_face(candidates.face[rows], tip[rows])
    return on


def _miss(candidates: TouchCandidates, row: int, contact: _Contact) -> str:
    """Say what became of a touch that misses."""
    name = f"touch {row} (counted from 0) along {candidates.touch_axis[row]} of jig '{candidates.frame[row]}'"
    if bool(contact.met[row]):
        x, y, z = (1e3 * contact.tip[row]).tolist()
        return f"{name} comes beside its face or leaves the joint limits, at {x:.1f}, {y:.1f}, {z:.1f} mm"
    return f"{name} does not find its face within the travel"
