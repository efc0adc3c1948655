"""Which closed form a robot has, decided from its rows: the registry of closed forms."""

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.robot.kinematics.closed_form.scara import Scara
from pisigma.robot.kinematics.closed_form.spherical_wrist import SphericalWristArm
from pisigma.robot.kinematics.closed_form.three_parallel import ThreeParallelArm

CLOSED_FORMS: dict[str, type[AbstractClosedForm]] = {}
"""The registry, by name: the first form whose `of` takes a robot is its closed form."""


def register_closed_form(form: type[AbstractClosedForm]) -> type[AbstractClosedForm]:
    """Add a closed form behind those that are registered; may be used as a decorator.

    A form with compiled functions has the kernels made again where it is first used, which needs numba
    (`pip install 'pisigma[compile]'`).

    Raises:
        ValueError: another form has the name.
    """
    if CLOSED_FORMS.setdefault(form.name, form) is not form:
        raise ValueError(f"there is a closed form '{form.name}' already; give yours another name.")
    return form


def closed_form_solver(robot: Robot) -> AbstractClosedForm | None:
    """The closed-form inverse of a robot, or None where no registered form takes it.

    The rows decide, exactly: twists that are off by a calibrated error, or a beta that is not 0, mean None.
    Signs of twists, offsets, directions, base, tool, fixed rows before the first and behind the last joint do
    not matter, nor do twist and beta of the last row.
    """
    return next((solver for form in CLOSED_FORMS.values() if (solver := form.of(robot)) is not None), None)


for _form in (
    Scara,
    SphericalWristArm,
    ThreeParallelArm,
):
    register_closed_form(_form)
