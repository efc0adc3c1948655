"""Frames whose place nothing tells, laid such that the hybrid arm meets the geometric one there."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.hybrid.refinement import Refined
from pisigma.identification.identifiability.sufficiency import floating_frames
from pisigma.identification.prediction import predicted_poses
from pisigma.identification.problem.setup import IdentifiedGeometry, identified_geometry
from pisigma.identification.result_assembly import SolvedCalibration
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import transform, transform_from_xyzrpy, xyzrpy_from_transform

ARM = 0.1
"""Points of the tool at this share of the reach from its origin are met as well, so that turns are told."""


def with_frames_of(
    solved: SolvedCalibration, refined: Refined, geometry: IdentifiedGeometry
) -> IdentifiedGeometry:
    """A geometry whose frames that nothing holds are moved onto those of the geometric calibration.

    Sockets, and distances from anchors at unknown places, are met as well after any motion of the whole frame.
    Geometric and hybrid arm, each in its own place, must not be blended; so every such frame gets the motion that
    takes the hybrid's poses nearest to the geometric ones.

    Args:
        solved: the geometric calibration.
        refined: the hybrid one.
        geometry: of the hybrid.
    """
    frames = floating_frames(solved.setup)
    if not frames:
        return geometry
    rows = solved.measurements
    first = identified_geometry(solved.setup, solved.solution.linearisation.point)
    with torch.no_grad():
        moved = replace(rows, q=rows.q + refined.correction.of_rows(rows))
    points = _points(geometry, moved), _points(first, rows)
    motions = {}
    for frame in frames:
        own = torch.tensor([name == frame for name in rows.frame])
        motions[frame] = nearest_motion(points[0][own].flatten(0, 1), points[1][own].flatten(0, 1))
    return _moved(solved, geometry, motions)


def nearest_motion(
    points: Float64[Tensor, "points 3"], onto: Float64[Tensor, "points 3"]
) -> Float64[Tensor, "4 4"]:
    """The rigid motion T that minimises `Σ |T p - p'|²` (Kabsch 1976, Acta Crystallographica A32, 922-923)."""
    middle, middle_onto = points.mean(0), onto.mean(0)
    U, _, V = torch.linalg.svd((onto - middle_onto).t() @ (points - middle))
    turned = torch.ones(3, dtype=points.dtype, device=points.device)
    turned[2] = torch.linalg.det(U @ V)
    R = U @ (turned[:, None] * V)
    return transform(R, middle_onto - R @ middle)


def _points(geometry: IdentifiedGeometry, rows: Measurements) -> Float64[Tensor, "rows 4 3"]:
    """The tool's origin and a point along each of its axes, in the frame of the row."""
    T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, rows)
    origin = T[:, None, :3, 3]
    return torch.cat([origin, origin + ARM * geometry.robot.reach * T[:, :3, :3].mT], 1)


def _moved(
    solved: SolvedCalibration, geometry: IdentifiedGeometry, motions: dict[str, Tensor]
) -> IdentifiedGeometry:
    """The geometry with everything that stands in some frames moved."""
    setup, frames = solved.setup, solved.setup.problem.space.frames
    bases = dict(geometry.bases)
    unknowns = {group: dict(owners) for group, owners in geometry.unknowns.items()}
    for frame, T in motions.items():
        base = transform_from_xyzrpy(torch.from_numpy(np.asarray(bases[frame])))
        bases[frame] = xyzrpy_from_transform(T @ base).numpy()
        for own in setup.problem.space.unknowns:
            for owner, number in zip(own.owners, setup.unknown_frames[own.name].tolist(), strict=True):
                if own.has_point and frames[number] == frame:
                    values = unknowns[own.name][owner]
                    point = (T[:3, :3] @ torch.from_numpy(np.asarray(values[:3])) + T[:3, 3]).numpy()
                    unknowns[own.name][owner] = np.concatenate([point, values[3:]])
    robot = geometry.robot.with_geometry(base=next(iter(bases.values())))
    return replace(geometry, robot=robot, bases=bases, unknowns=unknowns)
