"""Components of the uncertainty come from the model and from what is stated; what is missing is named, not guessed."""

import math

import numpy as np
import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.cell_rows import ROBOT
from testing.closeness import assert_close
from testing.hybrid import few_choices
from testing.models import no_type_checker
from testing.simulated_arm import BASE, TOOL, dh_errors, draw_joints

from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.iso9283.pose import position_repeatability
from pisigma.validation.uncertainty.budget import Component
from pisigma.validation.uncertainty.components import (
    instrument_component,
    parameter_component,
    repeatability_component,
    thermal_component,
    uncertainty_budget,
)
from pisigma.validation.uncertainty.instrument import Instrument
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

CERTIFIED = Instrument(certificate="K-1", expanded_uncertainty_mm=0.03, coverage_factor=2)


def test_the_instrument_is_that_of_its_certificate():
    found = instrument_component(CERTIFIED)
    assert (found.evaluation, found.degrees_of_freedom) == ("B", math.inf)
    assert_close(found.standard_uncertainty, 0.015e-3, rtol=1e-12)
    assert "K-1" in found.source


@pytest.mark.parametrize("stated", [{}, {"expanded_uncertainty_mm": 0.03}, {"coverage_factor": 2}])
def test_an_instrument_without_uncertainty_or_factor_is_not_guessed(stated):
    assert isinstance(instrument_component(Instrument(**stated)), str)


@pytest.mark.parametrize(
    ("temperatures", "kelvin"),
    [
        ({"a": 20.0}, 0.0),
        ({"a": 20.0, "b": 22.0, "c": 27.0}, 6.0),
        ({"a": 20.0, "b": 22.0, "c": 14.0}, 7.0),
    ],
)
def test_thermal_expansion_is_that_of_the_reach(temperatures, kelvin):
    """Sessions a and b made the model, so that the calibration was at their mean."""
    model = original_model()
    found = thermal_component(model, temperatures, ("a", "b"), 1.2e-5)
    assert (found.evaluation, found.degrees_of_freedom) == ("B", math.inf)
    assert_close(found.standard_uncertainty, 1.2e-5 * model.robot.reach * kelvin / math.sqrt(3), atol=1e-15)


@pytest.mark.parametrize(
    ("temperatures", "expansion"),
    [({"a": 20.0, "b": None}, 1.2e-5), ({"a": 20.0}, None), ({"b": 20.0}, 1.2e-5), ({}, 1.2e-5)],
)
def test_thermal_expansion_is_not_guessed(temperatures, expansion):
    assert isinstance(thermal_component(original_model(), temperatures, ("a",), expansion), str)


def test_the_repeatability_of_the_maker_is_that_of_its_axes():
    errors = 0.02 * torch.randn(200_000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = repeatability_component(float(position_repeatability(errors)))
    assert_close(found.standard_uncertainty, 0.02e-3, rtol=0.005)
    assert found.evaluation == "B"
    assert isinstance(repeatability_component(None), str)


def test_the_parameters_are_those_of_the_posterior():
    rows = rows_after_change(12, 3)
    found = parameter_component(original_model(), rows, "session a")
    deviation = sigma_of_rows(original_model(), rows)
    assert_close(found.standard_uncertainty, float(deviation.square().mean().sqrt()))
    assert found.degrees_of_freedom is None or found.degrees_of_freedom > 1
    assert isinstance(parameter_component(original_model(), None, ""), str)


def test_missing_components_are_named_and_do_not_contribute():
    found = uncertainty_budget(
        original_model(), rows_after_change(12, 3), "a", Instrument(), {"a": None}, ("a",), None
    )
    assert [one.evaluation for one in found.components] == ["A", "A"]
    assert [line.partition(":")[0] for line in found.missing_components] == [
        "instrument",
        "thermal expansion",
    ]


SEEDS, REPEATABILITY, NOISE, SCALE = 6, 30e-6, 5e-6, 15e-6
"""Standard deviations of a coordinate [m]: of the robot, of the instrument, and of the error of its scale."""


def test_the_expanded_uncertainty_covers_true_errors():
    """Simulated arms, calibrated by an instrument with noise and a wrong scale as its certificate allows."""
    stated = Instrument(expanded_uncertainty_mm=2e3 * math.hypot(NOISE, SCALE), coverage_factor=2)
    covered, within = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, 11])
        dh = ROBOT.dh + dh_errors(ROBOT, 3e-4, 5e-4, rng)
        true = ROBOT.with_geometry(dh=dh, base=BASE, tool=TOOL)
        (q, attained), (new_q, new) = (_attained(true, rows, rng) for rows in (40, 200))
        scale = 1 + rng.normal() * SCALE / float(attained.std(0).mean())
        center = attained.mean(0)
        measured = (
            center + scale * (attained - center) + NOISE * torch.from_numpy(rng.normal(size=attained.shape))
        )
        with no_type_checker(), few_choices():
            model = calibrate(
                "ur10", Measurements(q=q, position=measured), CalibrationSettings(folds=0)
            ).model
            at = Measurements(q=new_q, position=new)
            budget = uncertainty_budget(model, at, "new poses", stated, {}, (), None)
            error = new - poses_of_rows(model, at)[:, :3, 3]
        assert all(isinstance(one, Component) and one.standard_uncertainty > 0 for one in budget.components)
        covered.append(float((error.abs() < budget.expanded_uncertainty).double().mean()))
        within.append(float((error.norm(dim=1) < budget.coverage_radius).double().mean()))
    assert 0.92 < np.mean(covered) < 0.985
    assert 0.92 < np.mean(within) < 0.985


def _attained(true, rows, rng):
    q = draw_joints(ROBOT, rows, rng)
    position = forward_kinematics(true, q)[:, :3, 3]
    return q, position + REPEATABILITY * torch.from_numpy(rng.normal(size=position.shape))
