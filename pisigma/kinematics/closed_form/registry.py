"""Which closed form a robot has, decided from its rows: the registry of closed forms."""

from pisigma.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.kinematics.closed_form.scara import Scara
from pisigma.kinematics.closed_form.spherical_wrist import SphericalWristArm
from pisigma.kinematics.closed_form.three_parallel import ThreeParallelArm
from pisigma.robot.description import Robot

CLOSED_FORMS: list[type[AbstractClosedForm]] = [Scara, SphericalWristArm, ThreeParallelArm]
"""The registry: the first form whose `of` takes a robot is its closed form."""


def register_closed_form(form: type[AbstractClosedForm]) -> type[AbstractClosedForm]:
    """Add a closed form behind those that are registered; may be used as a decorator."""
    if form not in CLOSED_FORMS:
        CLOSED_FORMS.append(form)
    return form


def closed_form_solver(robot: Robot) -> AbstractClosedForm | None:
    """The closed-form inverse of a robot, or None where no registered form takes it.

    The rows decide, exactly: twists that are off by a calibrated error, or a beta that is not 0, mean None.
    Signs of twists, offsets, directions, base, tool, fixed rows before the first and behind the last joint do
    not matter, nor do twist and beta of the last row.
    """
    return next((solver for form in CLOSED_FORMS if (solver := form.of(robot)) is not None), None)
