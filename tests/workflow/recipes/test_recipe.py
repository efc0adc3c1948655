"""Mistakes in recipes are refused when read, with file, line, key and the nearest valid name."""

import pytest
from testing.refusals import refused

from pisigma.files.errors import RecipeError, RobotError, UnknownRobotError
from pisigma.network.sections import GradientDescentSection
from pisigma.workflow.recipes.data import load_data, simulate
from pisigma.workflow.recipes.reader import read_recipe, recipe_hash

PAPER = "kiro3_paper"


@pytest.mark.parametrize(
    ("old", "new", "key", "named"),
    [
        ("epochs:", "epoch:", "fit.epoch", "'epochs'"),
        ("gradient_descent", "gradient_decent", "fit.method", "'gradient_descent'"),
        ("kind: simulated", "kind: simulate", "data.kind", "'simulated'"),
        ("kind: transmission", "kind: transmision", "data.errors.1.kind", "'transmission'"),
        ("inputs: [x, y]", "inputs: [x, Y]", "network.0.inputs", "'Y'"),
        ("inputs: [x, y]", "inputs: [x, x]", "network.0.inputs", "x"),
        ("r_steps: 10", "r_steps: 20000", "data.training.poses", "200,000"),
        ("inputs: [x, y]", "inputs: []", "network.0.inputs", "1"),
        ("orders: [3]", "orders: [0]", "network.0.orders.0", "1"),
        (
            "orders: [3]",
            "orders: [3], reference: [[1, 0, 0], [0, 1, 0], [0, 0, 2]]",
            "network.0.reference",
            "",
        ),
        (
            "orders: [3]",
            "orders: [3], reference: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]",
            "network.0.reference",
            "",
        ),
        ("joints: [theta_1, theta_2]", "joints: [theta_1, theta_3]", "network.0.joints", "'theta_3'"),
        ("joints: [theta_1, theta_2]", "joints: [theta_1, theta_1]", "network.0.joints", "'theta_1'"),
        ("{theta_1: 0.05, theta_2: 0.5}", "{theta_1: 0.05}", "fit.learning_rate", "'theta_2'"),
        ("theta_2: 0.5}\n", "theta_2: 0.5, theta_4: 1}\n", "fit.learning_rate.theta_4", "'theta_4'"),
        ("{theta_1: 0.05,", "{theta_1: -0.05,", "fit.learning_rate.theta_1", "0"),
        ("  theta_2:\n    before", "  theta2:\n    before", "paper.theta2", "'theta_2'"),
        ("offset_deg: {theta_1", "offset_deg: {theta1", "data.errors", "'theta_1'"),
        ("elbow_positive", "elbow_positiv", "data.training.branch", "'elbow_positive'"),
        ("seed: 0\npaper", "seed: -1\npaper", "fit.seed", ""),
        ("seed: 0\npaper", "seed: 99999999999999999999\npaper", "fit.seed", ""),
        ("epochs: 3000", "epochs: 9000000", "fit.epochs", ""),
        ("name: kiro3_paper", "name: ../up", "name", "pattern"),
        ("robot: kiro3\n", "", "robot", ""),
    ],
)
def test_mistakes_are_refused_with_place(write_recipe, old, new, key, named):
    path = write_recipe(PAPER, (old, new))
    with refused(RecipeError, file=path, column=key) as caught:
        read_recipe(path)
    assert caught.value.line >= 1
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_line_is_the_one_of_the_mistake(write_recipe):
    path = write_recipe(PAPER, ("inputs: [x, y]", "inputs: [x, yy]"))
    line = next(i for i, text in enumerate(path.read_text().splitlines(), 1) if "[x, yy]" in text)
    with refused(RecipeError, file=path, line=line):
        read_recipe(path)


def test_unknown_and_broken_robots_are_refused_with_place(write_recipe, tmp_path):
    path = write_recipe(PAPER, ("robot: kiro3\n", "robot: kiro33\n"))
    with refused(UnknownRobotError, file=path, column="robot") as caught:
        read_recipe(path)
    assert {"'kiro33'", "'kiro3'?"} <= set(str(caught.value).split())
    (tmp_path / "arm.yaml").write_text("name: arm\n")
    path = write_recipe(PAPER, ("robot: kiro3\n", f"robot: {tmp_path}/arm.yaml\n"))
    with refused(RobotError, file="arm.yaml", line=1, column="maker") as caught:
        read_recipe(path)
    assert path.name in str(caught.value)


def test_data_and_recipe_must_match(repository, small_recipe, tmp_path):
    simulated = small_recipe(PAPER)
    with refused(RecipeError, option="--data", value=simulated.name):
        load_data(simulated, tmp_path / "data.csv")
    measured = read_recipe(repository / "training" / "ur10_inverse.yaml")
    with refused(RecipeError, option="", value=measured.name):
        load_data(measured)
    with refused(RecipeError, expected="a recipe that simulates its data", value=measured.name):
        simulate(measured)


def test_the_hash_is_of_the_bytes(write_recipe):
    path = write_recipe(PAPER)
    first = recipe_hash(path)
    path.write_text(path.read_text() + "# comment\n")
    assert recipe_hash(path) != first
    assert len(first) == 64


def test_learning_rates_are_in_the_order_of_the_joints():
    fit = GradientDescentSection(method="gradient_descent", learning_rate={"a": 1.0, "b": 2.0})
    assert fit.rates(["b", "a"]).tolist() == [2.0, 1.0]
    with pytest.raises(RecipeError) as caught:
        fit.rates(["c"])
    assert "'c'" in str(caught.value)
    assert "a, b" in str(caught.value)
