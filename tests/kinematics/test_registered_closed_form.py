"""A closed form from outside the package: one class, registered by one line."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.inverse.corrected_ik import CorrectedIK
from pisigma.kinematics.closed_form import (
    AbstractClosedForm,
    closed_form_solver,
    register_closed_form,
    registry,
)
from pisigma.kinematics.closed_form.canonical import canonical_rows
from pisigma.kinematics.closed_form.scara import Scara
from pisigma.kinematics.components import Frame, Scalar, as_tensors
from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.status import Status
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot import Robot, Row


class Mast(AbstractClosedForm):
    """A joint that turns on one that slides along the same axis."""

    branches = ("only",)

    @classmethod
    def of(cls, robot: Robot) -> "Mast | None":
        rows = canonical_rows(robot, ("prismatic", "revolute"), (0.0,))
        return cls(robot, rows) if rows and not rows.a[0] else None

    def _solve_components(self, T: Frame, signs: Sequence[Scalar]):
        (r_00, r_10, _), _, (_, _, r_22), (x, y, z) = as_tensors(T)
        reached = (torch.hypot(x, y) < 1e-12) & (r_22 > 1 - 1e-12)
        turned = torch.atan2(r_10, r_00) - self.rows.theta[0]
        return [z, turned], reached, torch.zeros_like(reached)


@pytest.fixture
def mast() -> Robot:
    rows = (Row("lift", "prismatic", -1, 0.0, 2.0), Row("turn", "revolute", 1, -3.0, 3.0))
    dh = torch.tensor([[0.3, 0.1, 0.0, 0.0, 0.0], [0.0, 0.2, 0.05, 0.4, 0.0]], dtype=torch.float64)
    return Robot("mast", "test", "made up", rows, dh.numpy(), base=np.arange(1, 7) / 10)


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr(registry, "CLOSED_FORMS", [*registry.CLOSED_FORMS])
    return register_closed_form(Mast)


def test_a_robot_has_no_closed_form_before_it_is_registered(mast):
    assert closed_form_solver(mast) is None


def test_the_registered_form_inverts_the_forward_kinematics(mast, registered):
    solver = closed_form_solver(mast)
    assert type(solver) is Mast
    q = torch.tensor([[0.4, -1.2], [1.9, 2.5]], dtype=torch.float64)
    T = forward_kinematics(mast, q)
    solutions = solver.solve(T)
    assert_close(solutions.q[:, 0], q, atol=1e-14)
    assert (solutions.status == Status.REACHED).all()
    T[1, 0, 3] += 1e-3
    assert solver.solve(T).status[:, 0].tolist() == [Status.REACHED, Status.UNREACHABLE]


def test_forms_are_asked_in_their_order_and_registered_once(registered):
    assert [*registry.CLOSED_FORMS[:-1], register_closed_form(Mast)] == registry.CLOSED_FORMS
    assert type(closed_form_solver(Robot.load("kiro3"))) is Scara


def test_corrected_inverse_kinematics_solves_by_it(mast, registered):
    """Without a compiled form the model goes through the reference, on the registered branches."""
    q = torch.tensor([[0.4, -1.2], [1.9, 2.5]], dtype=torch.float64)
    model = CalibratedModel(
        name="mast", kind="geometric_calibration", robot=mast, network=None, domain=None, branches=(), starts=q,
        calibrated=mast,
    )  # fmt: skip
    ik = CorrectedIK(model)
    assert ik.branches == ("only",)
    T = forward_kinematics(mast, q)
    solution = ik(T, throw=False)
    assert_close(solution.q, q, atol=1e-9)
    assert solution.status.tolist() == [Status.REACHED, Status.REACHED]
