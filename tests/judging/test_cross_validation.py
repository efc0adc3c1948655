"""Cross-validation on a simulated robot that is handed over as if it were measured."""

import pytest
import torch
from testing.models import no_type_checker, trained_run

from pisigma.errors import RecipeError
from pisigma.judging.cross_validation import CrossValidation, cross_validate
from pisigma.judging.pose_statistics import Comparison, PoseErrors
from pisigma.recipes.recipe import MeasuredData


def test_the_correction_helps_on_rows_that_it_never_saw():
    recipe, run = trained_run("kiro4")
    measured = recipe.model_copy(update={"data": MeasuredData(kind="measured", folds=3, seed=1)})
    seen: list[tuple[int, int]] = []
    with no_type_checker():
        result = cross_validate(measured, run.measurements, lambda *step: seen.append(step))
    assert seen == [(0, 3), (1, 3), (2, 3)]
    figures = result.in_file_units()
    assert (figures["folds"], figures["rows_not_predicted"]) == (3, 0)
    assert figures["corrected"]["rms_mm"] < figures["nominal"]["rms_mm"] / 3
    assert not result.comparison.corrected.position.isnan().any()
    assert not result.comparison.nominal.rotation.isnan().any()
    assert result.verdict.startswith("On held-out rows the correction lowers the position error (")


def test_a_simulated_recipe_has_held_out_rows_of_its_own():
    recipe, run = trained_run("kiro3")
    with pytest.raises(RecipeError, match="simulates its data"):
        cross_validate(recipe, run.measurements)


def verdict(position: float, rotation: float | None, largest: float | None = None) -> str:
    one = torch.ones(4, dtype=torch.float64)
    turn = None if rotation is None else one
    moved = position * one
    if largest is not None:
        moved[0] = largest
    after = PoseErrors(moved, None if rotation is None else rotation * one)
    return CrossValidation(2, Comparison(PoseErrors(one, turn), after, 0)).verdict


@pytest.mark.parametrize(
    ("position", "rotation", "said"),
    [
        (0.5, None, "lowers the position error (1000.000 to 500.000 mm RMS)."),
        (
            1.01,
            None,
            "does not change the position error (1000.000 to 1010.000 mm RMS, but the largest rises from "
            "1000.000 to 1010.000 mm); do not use it.",
        ),
        (
            2.0,
            None,
            "raises the position error (1000.000 to 2000.000 mm RMS, and the largest rises from 1000.000 to "
            "2000.000 mm); do not use it.",
        ),
        (0.5, 0.5, "and lowers the orientation error (57.296 to 28.648 deg RMS)."),
        (
            0.5,
            2.0,
            "and raises the orientation error (57.296 to 114.592 deg RMS, and the largest rises from 57.296 to "
            "114.592 deg); use it with care.",
        ),
        (1.0, 1.0, "and does not change the orientation error (57.296 to 57.296 deg RMS); do not use it."),
    ],
)
def test_the_verdict_is_honest(position, rotation, said):
    assert verdict(position, rotation).startswith("On held-out rows the correction ")
    assert verdict(position, rotation).endswith(said)


def test_a_largest_error_that_rises_is_said():
    assert verdict(0.1, None, 1.04).endswith(
        "lowers the position error (1000.000 to 527.162 mm RMS, but the largest rises from 1000.000 to 1040.000 "
        "mm); use it with care."
    )
    assert verdict(0.1, None, 1 + 1e-9).endswith("lowers the position error (1000.000 to 507.445 mm RMS).")
