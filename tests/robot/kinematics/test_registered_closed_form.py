"""A closed form from outside the package: one class with its compiled form, registered by one line."""

import importlib
import math
import sys
from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import ModelError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.compiled_model import describe_as_arrays
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot, Row
from pisigma.robot.kernels import machine_code
from pisigma.robot.kernels.forms import KernelForms
from pisigma.robot.kernels.layout import pack
from pisigma.robot.kinematics.closed_form import (
    AbstractClosedForm,
    closed_form_solver,
    register_closed_form,
    registry,
)
from pisigma.robot.kinematics.closed_form.canonical import canonical_rows
from pisigma.robot.kinematics.closed_form.scara import Scara
from pisigma.robot.kinematics.components import Frame, Scalar, as_tensors
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status


@no_type_check
def far_from_axis(P: Any, rounding: float) -> bool:
    return math.hypot(P[0, 3], P[1, 3]) > max(1e-12, rounding)


@no_type_check
def mast_branches(form: Any, P: Any, only: int, rounding: float, q: Any) -> None:
    if far_from_axis(P, rounding) or P[2, 2] <= 1 - 1e-12:
        return
    q[0, 0], q[0, 1] = P[2, 3], math.atan2(P[1, 0], P[0, 0]) - form.theta[0]


class Mast(AbstractClosedForm):
    """A revolute joint on a prismatic one along the same axis."""

    name = "mast"
    branches = ("only",)

    @classmethod
    def from_robot(cls, robot: Robot) -> "Mast | None":
        rows = canonical_rows(robot, ("prismatic", "revolute"), (0.0,))
        return cls(robot, rows) if rows and not rows.a[0] else None

    def _solve_components(self, T: Frame, signs: Sequence[Scalar]):
        (r_00, r_10, _), _, (_, _, r_22), (x, y, z) = as_tensors(T)
        reached = (torch.hypot(x, y) < 1e-12) & (r_22 > 1 - 1e-12)
        turned = torch.atan2(r_10, r_00) - self.rows.theta[0]
        return [z, turned], reached, torch.zeros_like(reached)


def model_of(mast: Robot, q: torch.Tensor) -> CalibratedModel:
    return CalibratedModel(
        name="mast", kind="geometric_calibration", robot=mast, network=None, domain=None, branches=(), starts=q,
        calibrated=mast,
    )  # fmt: skip


@pytest.fixture
def mast() -> Robot:
    rows = (Row("lift", "prismatic", -1, 0.0, 2.0), Row("turn", "revolute", 1, -3.0, 3.0))
    dh = torch.tensor([[0.3, 0.1, 0.0, 0.0, 0.0], [0.0, 0.2, 0.05, 0.4, 0.0]], dtype=torch.float64)
    return Robot("mast", "test", "made up", rows, dh.numpy(), base=np.arange(1, 7) / 10)


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr(registry, "CLOSED_FORMS", {**registry.CLOSED_FORMS})
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


def test_forms_are_tried_in_order_and_registered_once(registered):
    assert register_closed_form(Mast) is [*registry.CLOSED_FORMS.values()][-1]
    with pytest.raises(ValueError, match="'mast'"):
        register_closed_form(type("Other", (Mast,), {}))
    assert type(closed_form_solver(Robot.load("kiro3"))) is Scara


def test_corrected_inverse_kinematics_solves_by_it(mast, registered):
    """Without a compiled form the model is solved in torch, on the registered branches."""
    q = torch.tensor([[0.4, -1.2], [1.9, 2.5]], dtype=torch.float64)
    ik = CorrectedIK(model_of(mast, q))
    assert ik.branches == ("only",)
    T = forward_kinematics(mast, q)
    solution = ik(T, throw=False)
    assert_close(solution.q, q, atol=1e-9)
    assert solution.status.tolist() == [Status.REACHED, Status.REACHED]


def test_a_compiled_form_is_added_to_the_kernels(mast, registered, monkeypatch):
    """Only two closed forms are compiled here, not all kernels, which would take a minute."""
    pytest.importorskip("numba")
    monkeypatch.setattr(registry, "CLOSED_FORMS", {"scara": Scara, "mast": Mast})
    monkeypatch.setattr(Mast, "compiled", staticmethod(mast_branches))
    monkeypatch.delitem(sys.modules, "pisigma.robot.kernels.closed_form", raising=False)
    forms = KernelForms.registered()
    assert forms.closed_forms == ("scara", "mast")
    assert not (machine_code.stored_code_forms() or forms).cover(forms)
    q = np.array([0.4, -1.2])
    description, branches = describe_as_arrays(model_of(mast, torch.from_numpy(q)[None]))
    assert description.forms.closed_forms == ("mast",)
    assert branches == ("only",)
    arm = np.rec.array(pack(description, "mast", forms))[0]
    solved, work = np.empty((8, 8)), np.empty((4, 4))
    closed_form = importlib.import_module("pisigma.robot.kernels.closed_form")
    del sys.modules["pisigma.robot.kernels.closed_form"]  # other tests must not see this one
    T = forward_kinematics(mast, torch.from_numpy(q)).numpy()
    closed_form.all_branches(arm.arms, arm.closed_form, T, -1, 1e-13, work, solved)
    assert_close(solved[0, :2], q, atol=1e-14)
    T[0, 3] += 1e-3
    closed_form.all_branches(arm.arms, arm.closed_form, T, -1, 1e-13, work, solved)
    assert np.isnan(solved[0, 0])


def test_the_key_of_machine_code_changes_with_a_registered_form(registered, monkeypatch):
    ready = KernelForms(("series",), ("scara",))
    monkeypatch.setattr(Mast, "compiled", staticmethod(mast_branches))
    before = KernelForms(("series",), ("scara", "mast")).fingerprints(ready)
    assert before[:2] == ["series", "scara"]
    monkeypatch.setitem(mast_branches.__globals__, "far_from_axis", lambda P, rounding: P[0, 3] > rounding)
    assert KernelForms(("series",), ("scara", "mast")).fingerprints(ready)[2] != before[2]


def test_kernels_without_a_form_are_rejected(mast, registered, monkeypatch):
    monkeypatch.setattr(Mast, "compiled", staticmethod(mast_branches))
    description, _ = describe_as_arrays(model_of(mast, torch.tensor([[0.4, -1.2]]).double()))
    with refused(ModelError, value="mast"):
        pack(description, "mast", KernelForms())
