"""Epochs and points of a training, as `--json` prints them."""

import pytest
from testing.closeness import assert_close

from pisigma.workflow.recipes.data import load_data
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.train import train_networks
from training_course import EPOCHS_SHOWN, epochs_shown, report_course


@pytest.mark.parametrize("epochs", [0, 1, 2, 7, 80, 3000])
def test_first_and_last_epoch_are_shown_and_none_twice(epochs):
    shown = epochs_shown(epochs).tolist()
    assert len(shown) <= min(EPOCHS_SHOWN, epochs)
    assert shown == sorted(set(shown))
    if epochs:
        assert (shown[0], shown[-1]) == (1, epochs)


def test_energies_and_points_are_those_of_the_training(repository):
    recipe = read_recipe(repository / "training" / "kiro3_paper.yaml")
    recipe = recipe.model_copy(update={"fit": recipe.fit.model_copy(update={"epochs": 100})})
    run = train_networks(recipe, load_data(recipe))
    course = report_course(run)
    epochs = course["energies"].pop("epoch")
    assert list(course["energies"]) == ["theta_1", "theta_2"]
    assert_close(course["energies"]["theta_2"], run.history.energies[[e - 1 for e in epochs], 1], rtol=1e-5)
    points = course["points"]
    radii = [(x * x + y * y) ** 0.5 for x, y in zip(points["x_mm"], points["y_mm"], strict=True)]
    assert_close(
        sorted({round(radius, 1) for radius in radii}), [200.0 + 40 * k for k in range(10)], atol=1e-6
    )
    for place, joint in enumerate(("theta_1", "theta_2")):
        errors = points["errors"][joint]
        assert_close(errors["before_deg"], run.training.before[:, place].rad2deg(), rtol=1e-5, atol=1e-12)
        assert_close(errors["after_deg"], run.training.after[:, place].rad2deg(), rtol=1e-5, atol=1e-12)
