"""True robot of a simulation: a nominal robot with the sum of the errors of several sources."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeVar, get_args

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.files.errors import RecipeError, UnreachablePoseError
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.simulation.errors.backlash import Backlash
from pisigma.simulation.errors.coupling import CouplingDeviation
from pisigma.simulation.errors.encoder import EncoderQuantisation
from pisigma.simulation.errors.geometric import GeometricDeviation, RandomGeometricDeviation
from pisigma.simulation.errors.guide import Guide
from pisigma.simulation.errors.joint_compliance import JointCompliance
from pisigma.simulation.errors.joint_offset import JointOffset
from pisigma.simulation.errors.source import (
    AbstractErrorSource,
    AbstractGeometrySource,
    AbstractJointSource,
    AbstractPlaySource,
    JointErrorFunction,
    RegisteredSection,
)
from pisigma.simulation.errors.transmission import TransmissionHarmonics

ERROR_SOURCES: dict[str, type[AbstractErrorSource]] = {
    "geometric": GeometricDeviation,
    "geometric_random": RandomGeometricDeviation,
    "joint_offset": JointOffset,
    "joint_compliance": JointCompliance,
    "transmission": TransmissionHarmonics,
    "encoder": EncoderQuantisation,
    "backlash": Backlash,
    "coupling": CouplingDeviation,
    "guide": Guide,
}
"""Classes of all error sources by kind."""

ErrorSource = Annotated[AbstractErrorSource, RegisteredSection(ERROR_SOURCES)]
"""A recipe section of any registered error source, distinguished by `kind`."""

Source = TypeVar("Source", bound=AbstractErrorSource)

MAX_ITERATIONS = 200
"""Largest number of iterations when solving for commanded joint values; errors of a real robot need about ten."""


def register_error_source(source: type[Source]) -> type[Source]:
    """Register an error source for recipes by its kind; usable as a class decorator.

    Args:
        source: subclass of `AbstractJointSource`, `AbstractGeometrySource` or `AbstractPlaySource` whose `kind` is a
            `Literal`.

    Raises:
        RecipeError: the class has no kind, or another source has the same kind.
    """
    kinds = get_args(source.model_fields["kind"].annotation)
    if len(kinds) != 1:
        raise RecipeError(
            option=source.__name__,
            expected="a `kind` that is a Literal with exactly one value",
            value=len(kinds),
            remedy='declare it, for example kind: Literal["backlash"] = "backlash"',
        )
    if ERROR_SOURCES.setdefault(kinds[0], source) is not source:
        raise RecipeError(
            f"the kind '{kinds[0]}' belongs to {ERROR_SOURCES[kinds[0]].__name__}",
            option=source.__name__,
            value=kinds[0],
            remedy="choose another name",
        )
    return source


class TrueRobotSection(Section):
    """Section of a recipe for the true robot.

    Attributes:
        robot: catalogue name or robot file of the nominal robot.
        errors: error sources of the true robot, whose errors are added.
    """

    robot: str
    errors: tuple[ErrorSource, ...] = ()

    def true_robot(self) -> "TrueRobot":
        """Return the true robot.

        Raises:
            RobotError: there is no such robot.
            RecipeError: an error source does not fit the robot.
        """
        return TrueRobot(Robot.load(self.robot), self.errors)


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """A true robot: `T_base_tool = FK(q + Σ e_i(q) - half_play · approach; nominal geometry + Σ changes)`.

    The approach of a joint is +1 if its value increased before it stopped, -1 if it decreased, and 0, for the middle of
    the play, if it is not stated.

    Every joint error e_i, including the rounding of the encoder, is evaluated at the commanded joints q and on the
    nominal geometry, and all errors are added. Their order therefore does not matter, and the effect of one source
    does not depend on the others.

    Attributes:
        nominal: the nominal robot.
        errors: the error sources.
        true_geometry: the robot with the true geometric parameters, for actual joint values.
        half_play: `(dof,)`, distance by which every joint stops short of the commanded value [rad or m].
    """

    nominal: Robot
    errors: Sequence[AbstractErrorSource] = ()
    true_geometry: Robot = field(init=False)
    half_play: Float64[Tensor, " dof"] = field(init=False, repr=False)
    _joint_errors: tuple[JointErrorFunction, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Sum the geometric errors, and bind the joint errors to the robot."""
        dh, base, tool = self.nominal.dh.copy(), self.nominal.base.copy(), self.nominal.tool.copy()
        joint_errors: list[JointErrorFunction] = []
        half_play = torch.zeros(self.nominal.dof, dtype=torch.float64)
        stepped: set[str] = set()
        for index, source in enumerate(self.errors):
            place = f"errors[{index}] ({source.kind})"
            if isinstance(source, AbstractGeometrySource):
                change = source.parameter_errors(self.nominal, place)
                dh, base, tool = dh + change.dh, base + change.base, tool + change.tool
                continue
            if isinstance(source, AbstractPlaySource):
                half_play += torch.from_numpy(source.half_play(self.nominal, place))
                continue
            assert isinstance(source, AbstractJointSource)
            joint_errors.append(source.bind(self.nominal, place))
            if twice := sorted(stepped & source.stepped_joints):
                raise RecipeError(
                    f"joint '{twice[0]}' already has an encoder",
                    option=place,
                    value=twice[0],
                    remedy="keep one of them",
                )
            stepped |= source.stepped_joints
        object.__setattr__(self, "errors", tuple(self.errors))
        object.__setattr__(self, "true_geometry", self.nominal.with_geometry(dh, base, tool))
        object.__setattr__(self, "half_play", half_play)
        object.__setattr__(self, "_joint_errors", tuple(joint_errors))

    @property
    def has_encoder(self) -> bool:
        """Whether any joint has encoder steps."""
        return any(_steps(source) for source in self.errors)

    def without_encoder(self) -> "TrueRobot":
        """Return the same robot without encoder steps."""
        return replace(self, errors=[source for source in self.errors if not _steps(source)])

    def draw_approach(self, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "rows dof"] | None:
        """Return random directions of approach of every joint, +1 or -1; None if no joint has play.

        Every call returns the same directions: the seed depends only on the sources' seeds and the joint values.
        """
        if not bool(self.half_play.any()):
            return None
        seeds = [source.seed for source in self.errors if isinstance(source, AbstractPlaySource)]
        # the seed is a hash of the joint values: equal calls agree, and other joint values get other directions
        seed = zlib.crc32(q.numpy(force=True).tobytes(), sum(seeds))
        generator = torch.Generator().manual_seed(seed)
        return (2 * torch.randint(0, 2, q.shape, generator=generator) - 1).to(q)

    def joint_error(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch dof"]:
        """Return actual minus commanded joint values [rad or m].

        Args:
            q: commanded joint values [rad or m], with the sign and zero of the controller.
            approach: direction of approach of every joint; None for the middle of all play.

        Raises:
            PoseError: the number of columns of q is not the robot's number of joints.
        """
        self.nominal.check_joint_count(q.shape[-1])
        total = torch.zeros_like(q) if approach is None else -self.half_play.to(q) * approach
        for error in self._joint_errors:
            total = total + error(q)
        return total

    def actual_joints(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch dof"]:
        """Return the actual joint values [rad or m] for commanded values q: `q + joint_error(q, approach)`."""
        return q + self.joint_error(q, approach)

    def forward(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch 4 4"]:
        """Return the true T_base_tool [m] for commanded joint values q, without measurement noise.

        Args:
            q: commanded joint values [rad or m].
            approach: direction of approach of every joint; None for the middle of all play.
        """
        return forward_kinematics(self.true_geometry, self.actual_joints(q, approach))

    def commanded_joints(self, actual: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Return the joint values to command [rad or m] so that the actual joint values are `actual`.

        The method solves `q + joint_error(q) = actual` by the fixed-point iteration `q <- actual - joint_error(q)`
        until q changes by less than 1e-14 (16 machine epsilons in lower precision). The rate of convergence is the
        slope of the joint errors, a few percent.

        Raises:
            PoseError: the number of columns of `actual` is not the robot's number of joints.
            UnreachablePoseError: the robot has encoder steps, or the errors are too steep to be inverted.
        """
        if self.has_encoder:
            raise UnreachablePoseError(
                "the true robot has encoder steps and cannot reach arbitrary joint values",
                option="errors",
                value="encoder",
                remedy="remove the encoder from its errors or use without_encoder()",
            )
        tolerance = max(1e-14, 16 * torch.finfo(actual.dtype).eps)
        q, moved = actual, torch.zeros_like(actual)
        for _ in range(MAX_ITERATIONS):
            following = actual - self.joint_error(q)
            moved, q = (following - q).abs(), following
            if bool((moved < tolerance).all()):
                return q
        worst = self.nominal.joints[int(moved.reshape(-1, self.nominal.dof).amax(0).argmax())].name
        raise UnreachablePoseError(
            f"joint '{worst}' of the true robot still moves by {float(moved.max()):.1e} rad or m after "
            f"{MAX_ITERATIONS} iterations, because its error changes faster than the joint itself",
            option="errors",
            value=worst,
            remedy="reduce amplitudes or compliances, and check that the joint values are finite",
        )

    def inverse(
        self, T: Float[Tensor, "*batch 4 4"], start: Float[Tensor, "*starts dof"]
    ) -> Float[Tensor, "*batch dof"]:
        """Return the joint values to command [rad or m] so that the true robot reaches the poses T.

        The actual joint values are computed on the true geometry by Newton steps from `start` (on its branch),
        followed by the commanded joint values, see `commanded_joints`.

        Args:
            T: desired T_base_tool.
            start: joint values near the solution, for example of the nominal inverse kinematics; broadcasts.

        Raises:
            PoseError: T is not a rigid transform, or the number of columns of `start` is not the robot's number of
                joints.
            UnreachablePoseError: the true robot cannot reach a pose on this branch, or it has encoder steps.
        """
        solution = solve_numeric(self.true_geometry, T, start)
        missed = solution.status == Status.NOT_CONVERGED
        if missed.any():
            index = tuple(missed.nonzero()[0].tolist())
            number = index if len(index) != 1 else index[0]
            raise UnreachablePoseError(
                f"the true robot does not reach pose {number} (counted from 0), with residuals of "
                f"{float(solution.position_residual[index]) * 1e3:.3g} mm and "
                f"{float(torch.rad2deg(solution.rotation_residual[index])):.3g} deg",
                option="T",
                value=number,
                remedy=Status.NOT_CONVERGED.sentence,
            )
        return self.commanded_joints(solution.q)


def _steps(source: AbstractErrorSource) -> bool:
    """Return whether a source gives any joint encoder steps."""
    return isinstance(source, AbstractJointSource) and bool(source.stepped_joints)
