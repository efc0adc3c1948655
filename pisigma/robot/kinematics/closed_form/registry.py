"""Registry of closed forms, and the choice of a form by the rows of a robot."""

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.robot.kinematics.closed_form.scara import Scara
from pisigma.robot.kinematics.closed_form.spherical_wrist import SphericalWristArm
from pisigma.robot.kinematics.closed_form.three_parallel import ThreeParallelArm

CLOSED_FORMS: dict[str, type[AbstractClosedForm]] = {}
"""Closed forms by name; the first form whose `from_robot` accepts a robot is used."""


def register_closed_form(form: type[AbstractClosedForm]) -> type[AbstractClosedForm]:
    """Register a closed form after the existing ones; may be used as a decorator.

    The kernels are recompiled at the first use of a form with compiled functions, which requires numba
    (`pip install 'pisigma[compile]'`).

    Raises:
        ValueError: a form with this name is already registered.
    """
    if CLOSED_FORMS.setdefault(form.name, form) is not form:
        raise ValueError(f"a closed form '{form.name}' is already registered; choose another name.")
    return form


def closed_form_solver(robot: Robot) -> AbstractClosedForm | None:
    """Return the closed-form inverse of a robot, or None if no registered form accepts it.

    The rows must match exactly; twists with a calibrated error or a nonzero beta result in None.
    Signs of twists, offsets, directions, base, tool, fixed rows before the first and after the last joint do
    not matter, nor do twist and beta of the last row.
    """
    return next(
        (solver for form in CLOSED_FORMS.values() if (solver := form.from_robot(robot)) is not None), None
    )


for _form in (
    Scara,
    SphericalWristArm,
    ThreeParallelArm,
):
    register_closed_form(_form)
