"""A robot in its surroundings: joint values within the limits, free of collisions, and visible to the tracker."""

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.planning.surroundings.capsules import TOOL_RADIUS, Capsules
from pisigma.planning.surroundings.distances import box_distance, segment_distance
from pisigma.planning.surroundings.surroundings import LinkSection, Surroundings
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE

POSES_PER_CHUNK = 2048
"""Number of poses that are checked together (a few MB)."""
_ROUNDING = 1e-9
"""Distance by which capsules of a measured pose may overlap without a self-collision [m]."""


@dataclass(frozen=True, eq=False)
class Faults:
    """Reasons why poses are not allowed.

    Attributes:
        reasons: possible reasons, each a sentence without a full stop.
        failed: mask of the poses that fail, for every reason.
    """

    reasons: tuple[str, ...]
    failed: Bool[Tensor, "poses reasons"]

    @property
    def allowed(self) -> Bool[Tensor, " poses"]:
        """Mask of the poses without faults."""
        return ~self.failed.any(1)

    def counts(self) -> Counter[str]:
        """Return the number of failing poses by their first reason."""
        first = self.failed[self.failed.any(1)].int().argmax(1)
        return Counter(self.reasons[reason] for reason in first.tolist())

    def sentence(self, pose: int) -> str | None:
        """Return why a pose is not allowed; None if it is allowed."""
        failed = self.failed[pose].nonzero()[:, 0].tolist()
        return "; ".join(self.reasons[column] for column in failed) + "." if failed else None


@dataclass(frozen=True, eq=False)
class ArmInSurroundings:
    """A robot in its surroundings.

    Attributes:
        nominal: nominal robot, with its base in the surroundings.
        robot: nominal robot with the reflector as its tool.
        surroundings: surroundings of the robot.
        capsules: capsules along the links.
        capsule_pairs: pairs of capsules that may touch each other.
        pair_clearance: distance to keep between the capsules of each pair [m].
        beam_blockers: capsules that may block the tracker's beam, without those of the link that carries the reflector
            and those so near to the reflector that they touch every beam.
        limits: limits of the controller's values including margins [rad or m].
    """

    nominal: Robot
    robot: Robot
    surroundings: Surroundings
    capsules: Capsules
    capsule_pairs: Int64[Tensor, "pairs 2"]
    pair_clearance: Float64[Tensor, " pairs"]
    beam_blockers: Int64[Tensor, " pieces"]
    limits: Float64[Tensor, "axes 2"]

    @staticmethod
    def from_robot(robot: Robot, surroundings: Surroundings | None = None) -> "ArmInSurroundings":
        """Return a robot in its surroundings; with None, only limits and self-collision are checked."""
        surroundings = surroundings or Surroundings()
        capsules = surroundings.capsules(robot)
        pairs = capsules.pairs_to_check(surroundings.clearance / 2)
        return ArmInSurroundings(
            robot,
            capsules.robot,
            surroundings,
            capsules,
            pairs,
            torch.full((len(pairs),), surroundings.clearance / 2, dtype=torch.float64),
            _beam_blockers(capsules, surroundings.clearance),
            surroundings.joints.limits(robot),
        )

    def allow_measured_poses(self, q: Float64[Tensor, "poses dof"]) -> "ArmInSurroundings":
        """Return the arm, modified so that measured poses are free of self-collision for any radii of the links.

        Args:
            q: joint values of measured poses [rad or m].
        """
        pair_clearance = self.pair_clearance
        for chunk in torch.split(q, POSES_PER_CHUNK):
            apart = self._apart(self.capsules.segments(chunk))
            pair_clearance = torch.minimum(pair_clearance, apart.amin(0) - _ROUNDING)
        return replace(self, pair_clearance=pair_clearance)

    @property
    def unchecked_link_sentences(self) -> tuple[str, ...]:
        """Return a sentence about links that are not checked against each other because stated radii are too large.

        Links that touch in more than half of random poses are not checked, see `Capsules.pairs_to_check`. The
        sentence is usually empty.
        """
        tool = (
            None
            if self.surroundings.tool is None
            else self.surroundings.tool.model_copy(update={"radius_mm": TOOL_RADIUS * 1e3})
        )
        usual = self.surroundings.model_copy(update={"links": LinkSection(), "tool": tool}).capsules(
            self.nominal
        )
        looked_at = set(map(tuple, self.capsule_pairs.tolist()))
        lost = [
            pair
            for pair in usual.pairs_to_check(self.surroundings.clearance / 2).tolist()
            if tuple(pair) not in looked_at
        ]
        links = {tuple(self.capsules.link[pair].tolist()) for pair in lost}
        if not links:
            return ()
        names = ("the base", *(f"link {joint.name}" for joint in self.robot.joints))
        text = ", ".join(f"{names[one]} and {names[other]}" for one, other in sorted(links))
        return (
            f"With the stated radii, {text} touch in more than half of all poses and are therefore not checked for "
            "collision; unless they touch by construction, state smaller radii [mm] of links or tool.",
        )

    def faults(self, q: Float64[Tensor, "poses dof"]) -> Faults:
        """Find the faults of joint values [rad or m].

        Raises:
            PoseError: the joint values do not fit the robot.
        """
        self.robot.check_joint_count(q.shape[-1])
        chunks = [self._faults(chunk) for chunk in torch.split(q, POSES_PER_CHUNK)]
        return Faults(tuple(chunks[0]), torch.cat([torch.stack([*chunk.values()], 1) for chunk in chunks]))

    def smallest_clearance(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, " poses"]:
        """Compute the smallest distance between the links and obstacles, minus the clearance [m].

        The result is negative if the clearance is not kept, and infinite without obstacles.
        """
        gaps = [
            torch.stack([*self._gaps(self.capsules.segments(chunk)).values()])
            for chunk in torch.split(q, POSES_PER_CHUNK)
        ]
        return torch.cat(gaps, -1).min(0).values

    @cached_property
    def motion_per_joint_value(self) -> Float64[Tensor, " dof"]:
        """Largest motion of any point of the robot per joint value [m/rad, or 1 for prismatic joints]."""
        d, strokes = np.abs(self.robot.dh[:, 1]), np.zeros(len(self.robot.rows))
        for index, row in enumerate(self.robot.rows):
            bounds = [abs(bound) for bound in (row.lower, row.upper) if math.isfinite(bound)]
            strokes[index] = max(bounds, default=0.0) if row.type == "prismatic" else 0.0
            strokes[index] += float(np.linalg.norm(row.urdf_origin))
        # The distance of a point from an axis is at most the sum of all lengths after the axis, so the point moves by
        # at most this sum per radian.
        lengths = np.append(np.hypot(d + strokes, self.robot.dh[:, 2]), np.linalg.norm(self.robot.tool[:3]))
        beyond = np.cumsum(lengths[::-1])[::-1][list(self.robot.joint_rows)]
        return torch.from_numpy(np.where(self.robot.revolute, beyond, 1.0))

    def _faults(self, q: Float64[Tensor, "poses dof"]) -> dict[str, Bool[Tensor, " poses"]]:
        segments = self.capsules.segments(q)
        values, (lower, upper) = self.robot.to_controller(q), self.limits.t()
        outside = (values < lower - LIMIT_TOLERANCE) | (values > upper + LIMIT_TOLERANCE)
        if self.robot.coupling is not None:
            outside |= ~torch.from_numpy(self.robot.coupling.is_within_limits(q.numpy()))[:, None]
        faults = {"a joint is outside its limits or their margin": outside.any(-1)}
        faults |= {reason: gap < 0 for reason, gap in self._gaps(segments).items()}
        if self.surroundings.tracker is not None:
            T = forward_kinematics(self.robot, q)
            beam = torch.stack([self.surroundings.tracker.position.expand_as(T[:, :3, 3]), T[:, :3, 3]], -2)
            faults |= self._hidden(segments, beam[:, None], "the reflector from the tracker")
            faults |= self._turned_away(T, beam)
        return faults

    def _gaps(self, segments: Float64[Tensor, "poses pieces 2 3"]) -> dict[str, Float64[Tensor, " poses"]]:
        """Return the smallest distances minus the clearance [m], by reason why negative ones are refused."""
        clearance, radius = self.surroundings.clearance, self.capsules.radius
        infinite = segments.new_full((len(segments), 1), torch.inf)
        gaps = {
            "links of the robot touch each other": _least(
                self._apart(segments) - self.pair_clearance, infinite
            )
        }
        moving = ~self.capsules.carries_robot
        if self.surroundings.floor_mm is not None:
            height = segments[:, moving, 1, 2] - radius[moving] - self.surroundings.floor_mm / 1e3
            gaps["the robot touches the floor"] = _least(height, infinite) - clearance
        for box in self.surroundings.boxes:
            distance = box_distance(box.to_box_frame(segments[:, moving]), box.half_size) - radius[moving]
            gaps[f"the robot touches the box '{box.name}'"] = _least(distance, infinite) - clearance
        return gaps

    def _apart(self, segments: Float64[Tensor, "poses pieces 2 3"]) -> Float64[Tensor, "poses pairs"]:
        """Compute the distance between the capsules of every pair [m]."""
        first, second = self.capsule_pairs.unbind(-1)
        radius = self.capsules.radius
        return segment_distance(segments[:, first], segments[:, second]) - radius[first] - radius[second]

    def blocked_lines_of_sight(
        self, q: Float64[Tensor, "poses dof"], lines: Float64[Tensor, "poses lines 2 3"], hidden_line: str
    ) -> dict[str, Bool[Tensor, " poses"]]:
        """Return the masks of the poses in which a line of sight is blocked, by blocking object.

        Args:
            q: joint values [rad or m].
            lines: both ends of the lines in the frame of the nominal base [m].
            hidden_line: description of what would be hidden, such as "the reflector from the tracker".
        """
        return self._hidden(self.capsules.segments(q), lines, hidden_line)

    def _hidden(
        self,
        segments: Float64[Tensor, "poses pieces 2 3"],
        lines: Float64[Tensor, "poses lines 2 3"],
        hidden_line: str,
    ) -> dict[str, Bool[Tensor, " poses"]]:
        """Return the masks of the poses in which an obstacle is too near to a line of sight, by reason."""
        clearance = self.surroundings.clearance
        infinite = lines.new_full((len(lines), 1), torch.inf)
        distance = (
            segment_distance(lines[:, :, None], segments[:, None, self.beam_blockers])
            - self.capsules.radius[self.beam_blockers]
        )
        hidden = {f"a link hides {hidden_line}": _least(distance.flatten(1), infinite) < clearance}
        for box in self.surroundings.boxes:
            distance = box_distance(box.to_box_frame(lines), box.half_size)
            hidden[f"the box '{box.name}' hides {hidden_line}"] = distance.amin(1) < clearance
        return hidden

    def _turned_away(
        self, T: Float64[Tensor, "poses 4 4"], beam: Float64[Tensor, "poses 2 3"]
    ) -> dict[str, Bool[Tensor, " poses"]]:
        """Return the mask of the poses in which the tracker is outside the acceptance cone of the reflector."""
        reflector = self.surroundings.reflector
        if reflector is None:
            return {}
        axis = torch.nn.functional.normalize(torch.tensor(reflector.axis, dtype=torch.float64), dim=0)
        to_tracker = torch.nn.functional.normalize(beam[:, 0] - beam[:, 1], dim=-1)
        cosine = ((T[:, :3, :3] @ axis) * to_tracker).sum(-1).clamp(-1, 1)
        turned_away = torch.rad2deg(torch.acos(cosine)) > reflector.acceptance_deg
        return {f"the reflector ({reflector.name}) is turned away from the tracker": turned_away}


def _beam_blockers(capsules: Capsules, clearance: float) -> Int64[Tensor, " pieces"]:
    """Return the capsules that do not touch the reflector by construction; see `Capsules.pairs_to_check`."""
    q = capsules.random_joints()
    reflector = forward_kinematics(capsules.robot, q)[:, None, None, :3, 3].expand(-1, 1, 2, 3)
    touches = segment_distance(reflector, capsules.segments(q)) < capsules.radius + clearance
    blocking = (capsules.link < capsules.link.max()) & (touches.double().mean(0) < 0.5)
    return blocking.nonzero()[:, 0]


def _least(gaps: Float64[Tensor, "poses things"], infinite: Float64[Tensor, "poses 1"]) -> Tensor:
    return torch.cat([gaps, infinite], 1).min(1).values
