"""Adaptation of a model to new rows: after a collision, with a moved instrument, and row by row."""

import math
from dataclasses import replace

import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close
from testing.linearised import with_directions
from testing.models import hand_made_model
from testing.refusals import refused

from pisigma.files.errors import IdentificationError, ModelError
from pisigma.lifetime.recalibration.adaptation import Adaptation, adapt
from pisigma.lifetime.recalibration.candidates import recalibrated_model
from pisigma.lifetime.recalibration.movement import significant_movements
from pisigma.lifetime.recalibration.recalibration_problem import recalibration_problem
from pisigma.lifetime.recalibration.relocated_frames import relocated_frames
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.model.model_posterior import ModelPosterior

COLLISION = (0.0, 0.0, math.radians(0.25), 0.0, 0.0, 0.0)
SHIFTED = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)


def adapted(model, rows, relocated=frozenset()) -> Adaptation:
    posterior = ModelPosterior.from_model(model)
    return adapt(recalibration_problem(model, posterior, rows, relocated))


def rms(errors: torch.Tensor) -> float:
    return float(errors.square().sum(1).mean().sqrt())


def rms_of(model, rows) -> float:
    return rms(rows.position - poses_of_rows(model, rows)[:, :3, 3])


def with_turned_joint_3(adaptation: Adaptation) -> Adaptation:
    """The same of a robot whose joint 3 counts the other way round, as about an axis 0 0 -1 of a URDF file."""
    design = adaptation.problem.design
    robot = with_directions(design.problem.space.robot, (1, 1, -1, 1, 1, 1))
    problem = replace(design.problem, space=replace(design.problem.space, robot=robot))
    return replace(adaptation, problem=replace(adaptation.problem, design=replace(design, problem=problem)))


def test_a_collision_is_found_and_repaired():
    model = original_model()
    before = rms_of(model, rows_after_change(300, 50, noise=0.0))
    adaptation = adapted(model, rows_after_change(10, 2, COLLISION))
    after = rms(adaptation.errors_of(rows_after_change(300, 50, COLLISION, noise=0.0))["position"])
    assert after < 1.15 * before
    moved = significant_movements(adaptation)
    assert [one.what for one in moved] == ["joint 3"]
    low, high = moved[0].interval
    assert low < 0.25 < high
    assert high - low < 0.05
    (turned,) = significant_movements(with_turned_joint_3(adaptation))
    assert_close(turned.shift, -moved[0].shift)


def test_an_unchanged_robot_has_no_movements():
    adaptation = adapted(original_model(), rows_after_change(10, 2))
    assert significant_movements(adaptation) == ()


@pytest.mark.parametrize("moved", [(0.0,) * 6, COLLISION])
def test_a_moved_instrument_is_found(moved):
    model, rows = original_model(), rows_after_change(12, 2, moved, SHIFTED)
    posterior = ModelPosterior.from_model(model)
    assert relocated_frames(model, posterior, rows) == {("base", "")}
    assert not relocated_frames(model, posterior, rows_after_change(12, 2, moved))
    adaptation = adapted(model, rows, {("base", "")})
    errors = adaptation.errors_of(rows_after_change(300, 50, moved, SHIFTED, noise=0.0))["position"]
    assert rms(errors) < 1.5 * rms_of(model, rows_after_change(300, 50, noise=0.0))
    whats = [one.what for one in significant_movements(adaptation)]
    assert whats == [*(["joint 3"] if any(moved) else []), "base", "base"]


def test_a_moved_instrument_is_found_if_a_moved_tool_cannot_be_determined(monkeypatch):
    model, rows = original_model(), rows_after_change(12, 2, base=SHIFTED)

    def undetermined(model, posterior, rows, relocated):
        if ("tool", "") in relocated:
            raise IdentificationError(expected="more rows", value=rows.rows)
        return recalibration_problem(model, posterior, rows, relocated)

    monkeypatch.setitem(relocated_frames.__globals__, "recalibration_problem", undetermined)
    assert relocated_frames(model, ModelPosterior.from_model(model), rows) == {("base", "")}


def test_adapting_row_by_row_agrees_with_all_rows_at_once():
    model = chain = original_model()
    everything = rows_after_change(30, 11)
    for k in range(3):
        part = everything.select(torch.arange(10 * k, 10 * k + 10))
        chain = recalibrated_model(chain, adapted(chain, part), part)
    at_once = recalibrated_model(model, adapted(model, everything), everything)
    test = rows_after_change(300, 50, noise=0.0)
    assert_close(rms_of(chain, test), rms_of(at_once, test), rtol=0.05)
    assert rms_of(chain, test) < rms_of(model, test)
    deviations = [one.uncertainty.sigma(test).norm(dim=1).mean() for one in (chain, at_once, model)]
    assert_close(deviations[0], deviations[1], rtol=0.1)
    assert deviations[1] < deviations[2]


def test_a_model_without_a_posterior_is_refused():
    with refused(ModelError, value="inverse_calibration"):
        ModelPosterior.from_model(hand_made_model("kiro3"))
