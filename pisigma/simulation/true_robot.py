"""The true robot of a simulation: a nominal robot with error sources that add up."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeVar, get_args

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.files.errors import RecipeError, UnreachablePoseError
from pisigma.files.yaml_file import OneOf, Section
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
"""The registry: every error source by its kind."""

ErrorSource = Annotated[AbstractErrorSource, OneOf(ERROR_SOURCES)]
"""A section of a recipe that is one of the registered error sources, told apart by `kind`."""

Source = TypeVar("Source", bound=AbstractErrorSource)

ITERATIONS = 200
"""Steps after which solving for the commanded joints is given up; errors of a real robot need about ten."""


def register_error_source(source: type[Source]) -> type[Source]:
    """Make recipes know an error source by its kind; to be called once, or used as a decorator.

    Args:
        source: subclass of `AbstractJointSource`, `AbstractGeometrySource` or `AbstractPlaySource` whose `kind` is a
            `Literal`.

    Raises:
        RecipeError: the class states no kind, or another source has it.
    """
    kinds = get_args(source.model_fields["kind"].annotation)
    if len(kinds) != 1:
        raise RecipeError(
            f"{source.__name__}: a Literal of one kind was wanted; declare it such as "
            'kind: Literal["backlash"] = "backlash".'
        )
    if ERROR_SOURCES.setdefault(kinds[0], source) is not source:
        raise RecipeError(
            f"{source.__name__}: the kind '{kinds[0]}' is that of {ERROR_SOURCES[kinds[0]].__name__}; name yours "
            "otherwise."
        )
    return source


class TrueRobotSection(Section):
    """The part of a recipe that states the true robot, completely.

    Attributes:
        robot: catalogue name or robot file of the nominal robot.
        errors: what is wrong with the true one; they add up.
    """

    robot: str
    errors: tuple[ErrorSource, ...] = ()

    def true_robot(self) -> "TrueRobot":
        """The true robot.

        Raises:
            RobotError: there is no such robot.
            RecipeError: an error source does not fit the robot.
        """
        return TrueRobot(Robot.load(self.robot), self.errors)


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """A robot as it really is: `T_base_tool = FK(q + Σ e_i(q) - half_play · approach; nominal geometry + Σ changes)`.

    The approach of a joint is +1 where its value grew before it stopped, -1 where it fell, and 0, the middle of its
    play, where that is not stated.

    Every joint error e_i, the rounding of the encoder among them, is evaluated at the commanded joints q and
    on the nominal geometry, and then all are added. So their order does not matter, and the effect of one
    source does not depend on the others.

    Attributes:
        nominal: the robot as drawn.
        errors: the error sources.
        geometry: the robot with the true geometric parameters; takes actual joint values.
        half_play: `(dof,)`, how far every joint stops short of the commanded value [rad or m].
    """

    nominal: Robot
    errors: Sequence[AbstractErrorSource] = ()
    geometry: Robot = field(init=False)
    half_play: Float64[Tensor, " dof"] = field(init=False, repr=False)
    _joint_errors: tuple[JointErrorFunction, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Add the geometric errors up and bind the joint errors to the robot."""
        dh, base, tool = self.nominal.dh.copy(), self.nominal.base.copy(), self.nominal.tool.copy()
        joint_errors: list[JointErrorFunction] = []
        half_play = torch.zeros(self.nominal.dof, dtype=torch.float64)
        stepped: set[str] = set()
        for index, source in enumerate(self.errors):
            place = f"errors[{index}] ({source.kind})"
            if isinstance(source, AbstractGeometrySource):
                change = source.change(self.nominal, place)
                dh, base, tool = dh + change.dh, base + change.base, tool + change.tool
                continue
            if isinstance(source, AbstractPlaySource):
                half_play += torch.from_numpy(source.half_play(self.nominal, place))
                continue
            assert isinstance(source, AbstractJointSource)
            joint_errors.append(source.bind(self.nominal, place))
            if twice := sorted(stepped & source.stepped_joints):
                raise RecipeError(
                    f"{place}: joint '{twice[0]}' has an encoder already; state one of the two."
                )
            stepped |= source.stepped_joints
        object.__setattr__(self, "errors", tuple(self.errors))
        object.__setattr__(self, "geometry", self.nominal.with_geometry(dh, base, tool))
        object.__setattr__(self, "half_play", half_play)
        object.__setattr__(self, "_joint_errors", tuple(joint_errors))

    @property
    def has_encoder(self) -> bool:
        """Whether a joint moves in steps."""
        return any(_steps(source) for source in self.errors)

    def without_encoder(self) -> "TrueRobot":
        """The same robot, its joints moving continuously."""
        return replace(self, errors=[source for source in self.errors if not _steps(source)])

    def draw_approach(self, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "rows dof"] | None:
        """From which side every joint comes, +1 or -1 at random; None where no joint has play.

        It is the same at every call: drawn with the seeds of the sources and the joint values.
        """
        if not bool(self.half_play.any()):
            return None
        seeds = [source.seed for source in self.errors if isinstance(source, AbstractPlaySource)]
        drawn = zlib.crc32(q.numpy(force=True).tobytes(), sum(seeds))
        generator = torch.Generator().manual_seed(drawn)
        return (2 * torch.randint(0, 2, q.shape, generator=generator) - 1).to(q)

    def joint_error(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch dof"]:
        """How far the joints end up from where they are commanded: actual minus commanded [rad or m].

        Args:
            q: commanded joint values [rad or m], as the controller counts.
            approach: from which side every joint comes; None for the middle of all play.

        Raises:
            PoseError: q has another number of columns than the robot has joints.
        """
        self.nominal.check_joint_count(q.shape[-1])
        total = torch.zeros_like(q) if approach is None else -self.half_play.to(q) * approach
        for error in self._joint_errors:
            total = total + error(q)
        return total

    def actual_joints(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch dof"]:
        """Where the joints end up [rad or m] when commanded to q: `q + joint_error(q, approach)`."""
        return q + self.joint_error(q, approach)

    def forward(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch 4 4"]:
        """T_base_tool that the robot really takes when commanded to q [rad or m]; no measurement noise.

        Args:
            q: commanded joint values [rad or m].
            approach: from which side every joint comes; None for the middle of all play.
        """
        return forward_kinematics(self.geometry, self.actual_joints(q, approach))

    def commanded_joints(self, actual: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """What to command [rad or m] so that the joints end up at `actual`.

        Solves `q + joint_error(q) = actual` by `q <- actual - joint_error(q)` until q moves less than 1e-14
        (16 machine epsilons in lower precision). This contracts by the slope of the joint errors, a few
        percent.

        Raises:
            PoseError: `actual` has another number of columns than the robot has joints.
            UnreachablePoseError: the robot has encoder steps, or the errors are too steep to be undone.
        """
        if self.has_encoder:
            raise UnreachablePoseError(
                "the true robot has encoder steps and cannot end up just anywhere; take the encoder out of "
                "its errors or use without_encoder()."
            )
        tolerance = max(1e-14, 16 * torch.finfo(actual.dtype).eps)
        q, moved = actual, torch.zeros_like(actual)
        for _ in range(ITERATIONS):
            following = actual - self.joint_error(q)
            moved, q = (following - q).abs(), following
            if bool((moved < tolerance).all()):
                return q
        worst = self.nominal.joints[int(moved.reshape(-1, self.nominal.dof).amax(0).argmax())].name
        raise UnreachablePoseError(
            f"no commanded joints found for the true robot in {ITERATIONS} iterations: joint '{worst}' still "
            f"moves by {float(moved.max()):.1e}; its error changes faster than the joint itself, so reduce "
            "amplitudes or compliances, and check that the joint values are finite."
        )

    def inverse(
        self, T: Float[Tensor, "*batch 4 4"], start: Float[Tensor, "*starts dof"]
    ) -> Float[Tensor, "*batch dof"]:
        """Joint values [rad or m] to command so that the true robot takes the poses T.

        First the actual joints on the true geometry, by Newton steps from `start` (so on its branch), then
        the commanded ones. See `commanded_joints`.

        Args:
            T: T_base_tool wanted.
            start: joint values near the solution, for example of the nominal inverse kinematics; broadcasts.

        Raises:
            PoseError: T is no rigid transform, or `start` has another number of columns than the robot has
                joints.
            UnreachablePoseError: the true robot cannot take a pose, or not on this branch; or it has encoder
                steps.
        """
        solution = solve_numeric(self.geometry, T, start)
        missed = solution.status == Status.NOT_CONVERGED
        if missed.any():
            index = tuple(missed.nonzero()[0].tolist())
            raise UnreachablePoseError(
                f"the true robot does not reach the wanted pose at index {index if len(index) != 1 else index[0]}: "
                f"{float(solution.position_residual[index]) * 1e3:.3g} mm and "
                f"{float(torch.rad2deg(solution.rotation_residual[index])):.3g} deg are left; "
                f"{Status.NOT_CONVERGED.sentence}"
            )
        return self.commanded_joints(solution.q)


def _steps(source: AbstractErrorSource) -> bool:
    """Whether a joint moves in steps by this source."""
    return isinstance(source, AbstractJointSource) and bool(source.stepped_joints)
