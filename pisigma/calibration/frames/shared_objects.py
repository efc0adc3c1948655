"""What the fits of several arms have in common: frames, sockets and anchors with the same name."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot

_DETERMINED = 1e-6
"""Ratio of the smallest to the largest standard deviation of a base's directions below which one was not estimated."""


@dataclass(frozen=True, eq=False)
class ArmPosterior:
    """Normal distribution of the unknowns of an arm.

    Attributes:
        name: name of the arm.
        uncertainty: its parameters, with the bases of its measuring frames and the unknowns of its sensors, and the
            weights of its joint correction.
    """

    name: str
    uncertainty: PositionUncertainty

    @property
    def space(self) -> ParameterSpace:
        """The parameters."""
        return self.uncertainty.space

    @cached_property
    def root(self) -> Float64[Tensor, "unknowns directions"]:
        """Root `R` of the covariance `R R^T`, whose first rows are those of the parameters [m and rad]."""
        return self.uncertainty.root.cpu().clone()

    @cached_property
    def values(self) -> Float64[Tensor, " parameters"]:
        """Values of all parameters [m or rad]."""
        return self.uncertainty.geometry.values_of(self.space)

    def base_rows(self, frame: str) -> range:
        """Return the indices of the parameters of the base in a frame."""
        first = self.space.indices_of("base").start + 6 * self.space.frames.index(frame)
        return range(first, first + 6)

    @cached_property
    def shared_objects(self) -> dict[tuple[str, str], tuple[str, tuple[int, ...]]]:
        """Frame and parameter indices of everything that another arm could also have measured.

        These are named frames in which the base was calibrated, and points at positions that were estimated: sockets
        and anchors. For a frame, the parameters are those of the base. A base is not shared if the rows did not
        determine one of its directions, because such a direction keeps its previous value and has no covariance.
        """
        found = {
            ("frame", frame): (frame, tuple(self.base_rows(frame)))
            for frame in self.space.frames
            if frame and is_determined(self.root[list(self.base_rows(frame))])
        }
        for group in self.space.unknowns:
            first, size = self.space.indices_of(group.name).start, len(group.columns)
            for number, (owner, frame) in enumerate(zip(group.owners, group.frames, strict=False)):
                rows = tuple(range(first + size * number, first + size * (number + 1)))
                if group.has_point and bool(self.root[list(rows)].any()):
                    found[group.name, owner] = frame, rows
        return found


def is_determined(root: Float64[Tensor, "6 directions"]) -> bool:
    """Return whether all six directions of a base were estimated, by a root of its covariance [m and rad].

    A direction that was held at its previous value has no covariance.
    """
    return int(torch.linalg.matrix_rank(root, rtol=_DETERMINED)) == len(root)


@dataclass(frozen=True)
class SharedObject:
    """A frame or a point that several arms measured.

    Attributes:
        kind: "frame" or the group of the sensor's unknowns, such as "socket".
        name: its name in the rows of all these arms.
        arms: indices of the arms.
    """

    kind: str
    name: str
    arms: tuple[int, ...]

    @property
    def key(self) -> tuple[str, str]:
        """Kind and name."""
        return self.kind, self.name


def find_shared_objects(arms: Sequence[ArmPosterior]) -> tuple[SharedObject, ...]:
    """Return what two or more arms measured under one name: frames in which they are calibrated, and points."""
    keys = dict.fromkeys(itertools.chain.from_iterable(arm.shared_objects for arm in arms))
    found = (
        SharedObject(*key, tuple(k for k, arm in enumerate(arms) if key in arm.shared_objects))
        for key in keys
    )
    return tuple(one for one in found if len(one.arms) > 1)


def uncertainty_of(result: CalibrationResult) -> PositionUncertainty:
    """Return the uncertainty of a geometric calibration."""
    solved = result.solved
    return PositionUncertainty(
        solved.problem.space, solved.geometry, (), CovarianceRoot(solved.root), prior_scale=1.0
    )
