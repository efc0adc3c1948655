"""Placements of jigs, and possible touches on them: a face, a point on the face and a tilt of the torch."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import Phrase, RecipeError
from pisigma.files.yaml_file import Count, Section, Seed
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.jig import Jig
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import singularity_measure
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.se3 import invert, rotation_from_zyx, transform, transform_from_xyz_zyx
from pisigma.simulation.commanded import BranchSection


class JigPlacement(Section):
    """Nominal and true placement of a jig.

    `T_jig_base = Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)` is the pose of the robot's base in the frame of
    the jig (Lim et al., eq. 1). A jig on the floor that is rotated about the vertical has a roll.

    Attributes:
        name: name of the placement, and of the frame of its touches.
        jig: name of a jig that comes with pisigma, or a YAML file.
        base: nominal T_jig_base.
        true_base: true T_jig_base; by default equal to the nominal pose.
    """

    name: str = Field(min_length=1)
    jig: str = "stepped"
    base: FrameSection
    true_base: FrameSection | None = None

    def load_jig(self) -> Jig:
        """Return the jig that is placed.

        Raises:
            MeasurementError: the jig is unknown.
        """
        return Jig.load(self.jig)

    @property
    def T_jig_base(self) -> Float64[Tensor, "4 4"]:
        """Nominal pose of the base in the frame of the jig [m]."""
        return transform_from_xyz_zyx(torch.from_numpy(self.base.to_si()))

    @property
    def true_T_jig_base(self) -> Float64[Tensor, "4 4"]:
        """True pose of the base in the frame of the jig [m]."""
        return transform_from_xyz_zyx(torch.from_numpy((self.true_base or self.base).to_si()))


def check_names(placements: Sequence[JigPlacement]) -> None:
    """Refuse two placements with the same name.

    Raises:
        RecipeError: a name appears twice, or there is no placement.
    """
    names = [placement.name for placement in placements]
    if not names:
        raise RecipeError(option="touches", expected="one or more placements of jigs", value=Phrase("none"))
    if twice := [name for name in names if names.count(name) > 1]:
        raise RecipeError(
            f"the placement '{twice[0]}' appears twice",
            option="touches",
            value=twice[0],
            remedy="rename one, because a jig that was moved has a new frame",
        )


_MAX_DRAWS = 20
"""Largest number of draws, after which the search for candidates fails."""
_CANDIDATES_PER_DRAW = 8192
"""Number of candidates per draw."""
MAX_ITERATIONS = 10
"""Largest number of iterations of the numeric inverse kinematics to an end of the travel; about five are needed."""
_END_TOLERANCE = 1e-8
"""Tolerance of the inverse kinematics at the ends of the travel [m and rad]."""
_MAX_JOINT_MOTION = 1.5
"""Motion of a joint within the travel [rad or m] above which the branch must have changed."""


@dataclass(frozen=True, eq=False)
class TouchCandidates:
    """Touches that the nominal robot can make at the nominal placements of the jigs.

    Attributes:
        placement_names: names of the placements, which are the frames of the touches.
        placement: index of every candidate's placement.
        face: index of every candidate's face on the jig of that placement.
        axis: index of the axis along which the candidate touches.
        outward_sign: +1 or -1, outward direction of the face along that axis.
        face_coordinate: coordinate of the face along that axis in the frame of the jig [m].
        T_jig_tool: pose of the tool at the touch in the frame of the jig.
        q: joint values [rad or m] of the nominal robot at the touch.
    """

    placement_names: tuple[str, ...]
    placement: Int64[Tensor, " candidates"]
    face: Int64[Tensor, " candidates"]
    axis: Int64[Tensor, " candidates"]
    outward_sign: Float64[Tensor, " candidates"]
    face_coordinate: Float64[Tensor, " candidates"]
    T_jig_tool: Float64[Tensor, "candidates 4 4"]
    q: Float64[Tensor, "candidates dof"]

    @property
    def count(self) -> int:
        """Number of candidates."""
        return len(self.face)

    @property
    def frame(self) -> tuple[str, ...]:
        """Name of the placement of every candidate."""
        return tuple(self.placement_names[number] for number in self.placement.tolist())

    @property
    def touch_axis(self) -> tuple[str, ...]:
        """Name of the touched axis of every candidate."""
        return tuple("xyz"[axis] for axis in self.axis.tolist())

    def select(self, index: Int64[Tensor, " chosen"] | Bool[Tensor, " candidates"]) -> "TouchCandidates":
        """Return the candidates that an index, in its order, or a mask selects."""
        return replace(self, **{name: getattr(self, name)[index] for name in _ARRAYS})

    @staticmethod
    def concatenate(parts: Sequence["TouchCandidates"]) -> "TouchCandidates":
        """Concatenate candidates; the placements are those of the first part."""
        arrays = {name: torch.cat([getattr(part, name) for part in parts]) for name in _ARRAYS}
        return TouchCandidates(parts[0].placement_names, **arrays)

    def as_measurements(self) -> Measurements:
        """Return the measurements that the nominal robot would yield at the nominal placements, for planning."""
        return Measurements(
            q=self.q,
            frame=self.frame,
            touch_axis=self.touch_axis,
            touch=self.face_coordinate,
            source="planned touches",
        )


_ARRAYS = ("placement", "face", "axis", "outward_sign", "face_coordinate", "T_jig_tool", "q")


class TouchCandidatesSection(Section):
    """Section of random candidates of touches, with the same number for each of the axes x, y and z.

    For every axis, a face and a point on it are drawn uniformly. The tool's z axis, along which the wire leaves the
    torch, points down the jig's z axis except for a tilt; tilt and azimuth are drawn uniformly over the cone, as is the
    rotation about the wire. Candidates that the nominal robot cannot reach are drawn again.

    Attributes:
        count: number of candidates per placement.
        seed: random seed.
        tilt_deg: largest tilt of the torch from vertical [deg].
        least_lean_deg: smallest angle between the torch and the face [deg], so that its tip touches first.
        margin_mm: smallest distance of the point from edges of the face and from blocks on it [mm].
        travel_mm: distance before and behind the face that the tip must be able to move along the normal [mm], because
            the true robot and placement differ from the nominal ones.
        shaft_mm: length of a straight line behind the tip, which represents the torch and must be clear of the jig
            [mm].
        least_singular_value: smallest singularity measure of the robot; see `singularity_measure`.
        branch: branch of the inverse kinematics.
    """

    count: Count
    seed: Seed
    tilt_deg: float = Field(default=45.0, ge=0, le=90)
    least_lean_deg: float = Field(default=10.0, ge=0, lt=90)
    margin_mm: float = Field(default=25.0, ge=0)
    travel_mm: float = Field(default=60.0, gt=0)
    shaft_mm: float = Field(default=300.0, ge=0)
    least_singular_value: float = Field(default=0.02, ge=0)
    branch: BranchSection = BranchSection(near_deg={})

    def find(self, robot: Robot, placements: Sequence[JigPlacement]) -> TouchCandidates:
        """Return random candidates in the order of the placements; every call returns the same candidates.

        Args:
            robot: the nominal robot.
            placements: placements of the jigs.

        Raises:
            RecipeError: the robot can make fewer touches than requested, or the sections do not fit together.
            MeasurementError: a placement names an unknown jig.
        """
        check_names(placements)
        generator = torch.Generator().manual_seed(self.seed)
        parts = [self._of_placement(robot, placement, generator) for placement in placements]
        numbers = torch.arange(len(parts)).repeat_interleave(self.count)
        names = tuple(placement.name for placement in placements)
        return replace(TouchCandidates.concatenate(parts), placement_names=names, placement=numbers)

    def _of_placement(
        self, robot: Robot, placement: JigPlacement, generator: torch.Generator
    ) -> TouchCandidates:
        """Return candidates on one placement of a jig, with the same number for every axis."""
        jig = placement.load_jig()
        axes = sorted(set(jig.axis.tolist()))
        share = {axis: (self.count + len(axes) - 1 - place) // len(axes) for place, axis in enumerate(axes)}
        parts: list[TouchCandidates] = []
        for _ in range(_MAX_DRAWS):
            sampled = self._draw(jig, placement.name, robot.dof, generator)
            parts.append(self._reachable(robot, jig, placement, sampled))
            reachable = TouchCandidates.concatenate(parts)
            of_axis = {axis: (reachable.axis == axis).nonzero()[:, 0] for axis in axes}
            if all(len(of_axis[axis]) >= share[axis] for axis in axes):
                return reachable.select(
                    torch.cat([of_axis[axis][: share[axis]] for axis in axes]).sort().values
                )
        lacking = next(axis for axis in axes if len(of_axis[axis]) < share[axis])
        raise RecipeError(
            option="touches",
            expected=f"{share[lacking]} touches of robot '{robot.name}' along {'xyz'[lacking]} of jig "
            f"'{placement.name}' (of {_MAX_DRAWS * _CANDIDATES_PER_DRAW} random ones)",
            value=len(of_axis[lacking]),
            remedy="place the jig nearer, allow more tilt, choose a smaller margin, travel or shaft, or another branch",
        )

    def _draw(self, jig: Jig, name: str, dof: int, generator: torch.Generator) -> TouchCandidates:
        """Draw faces, points and orientations of the torch that are clear of the jig, but may be unreachable."""
        u = torch.rand(_CANDIDATES_PER_DRAW, 7, generator=generator, dtype=torch.float64)
        face = _draw_faces(jig, u[:, 0])
        lower, upper = (bound[face] for bound in jig.extent)
        point = lower + (upper - lower) * u[:, 1:4]
        tilt = torch.deg2rad(torch.tensor(self.tilt_deg, dtype=torch.float64))
        tilt = torch.arccos(1 - (1 - torch.cos(tilt)) * u[:, 4])
        azimuth, about_wire = (2 * torch.pi * u[:, 5], 2 * torch.pi * u[:, 6])
        zero = torch.zeros_like(tilt)
        R = rotation_from_zyx(torch.stack([azimuth, tilt, zero], -1))
        R = R @ rotation_from_zyx(torch.stack([about_wire, zero, zero + torch.pi], -1))
        sampled = TouchCandidates(
            placement_names=(name,),
            placement=torch.zeros_like(face),
            face=face,
            axis=jig.axis[face],
            outward_sign=jig.sign[face],
            face_coordinate=jig.coordinate[face],
            T_jig_tool=transform(R, point),
            q=torch.zeros(_CANDIDATES_PER_DRAW, dof, dtype=torch.float64),
        )
        return sampled.select(self._is_clear(jig, sampled))

    def _is_clear(self, jig: Jig, sampled: TouchCandidates) -> Bool[Tensor, " candidates"]:
        """Return whether no other part of the torch meets the jig, at the touch and during the approach."""
        point, shaft = sampled.T_jig_tool[:, :3, 3], -sampled.T_jig_tool[:, :3, 2]
        outward = jig.outward[sampled.face]
        lean = torch.arcsin((shaft * outward).sum(-1).clamp(-1, 1))
        clear = torch.rad2deg(lean) >= self.least_lean_deg
        clear &= jig.is_on_face(sampled.face, point, self.margin_mm / 1e3)
        for distance in (1e-6, self.travel_mm / 1e3):
            tip = point + distance * outward
            clear &= ~jig.intersects_line(tip, tip + self.shaft_mm / 1e3 * shaft)
        return clear & ~jig.intersects_line(point + 1e-6 * outward, point + self.travel_mm / 1e3 * outward)

    def _reachable(
        self, robot: Robot, jig: Jig, placement: JigPlacement, sampled: TouchCandidates
    ) -> TouchCandidates:
        """Return the candidates that the nominal robot can reach, with their joint values."""
        T_base_jig = invert(placement.T_jig_base)
        T = T_base_jig @ sampled.T_jig_tool
        q, reached = self.branch.solve_nominal(robot, T)
        reached = reached & (singularity_measure(robot, q) >= self.least_singular_value)
        sampled = replace(sampled, q=q).select(reached)
        T, outward = T[reached], (T_base_jig[:3, :3] @ jig.outward[sampled.face].mT).mT
        shift = self.travel_mm / 1e3 * torch.stack([outward, -outward])
        Ts_end = transform(T[:, :3, :3].expand(2, -1, 3, 3), T[:, :3, 3] + shift)
        ends = solve_numeric(
            robot, Ts_end, sampled.q, tolerance=_END_TOLERANCE, max_iterations=MAX_ITERATIONS
        )
        ends_reached = ends.status == Status.REACHED
        ends_reached &= (ends.q - sampled.q).abs().amax(-1) < _MAX_JOINT_MOTION
        ends_reached &= singularity_measure(robot, ends.q) >= self.least_singular_value
        return sampled.select(ends_reached.all(0))


def _draw_faces(jig: Jig, u: Float64[Tensor, " candidates"]) -> Int64[Tensor, " candidates"]:
    """Return the face for every random number in [0, 1): axes, and faces of an axis, are equally likely."""
    per_axis = torch.bincount(jig.axis, minlength=3)
    weight = 1.0 / per_axis[jig.axis].to(u.dtype)
    bounds = weight.cumsum(0) / weight.sum()
    return torch.searchsorted(bounds, u.contiguous(), right=True).clamp(max=jig.face_count - 1)
