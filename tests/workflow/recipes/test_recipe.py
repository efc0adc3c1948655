"""Mistakes in recipes are refused when read, with file, line, key and the nearest valid name."""

import pytest

from pisigma.files.errors import RecipeError, RobotError, UnknownRobotError
from pisigma.network.sections import GradientDescentSection
from pisigma.workflow.recipes.data import load_data, simulate
from pisigma.workflow.recipes.reader import read_recipe, recipe_hash

PAPER = "kiro3_paper"


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("epochs:", "epoch:", r"unknown key 'epoch' in 'fit'; did you mean 'epochs'"),
        ("gradient_descent", "gradient_decent", "'fit.method' cannot be .* did you mean 'gradient_descent'"),
        ("kind: simulated", "kind: simulate", "'data.kind' cannot be .* did you mean 'simulated'"),
        ("kind: transmission", "kind: transmision", "'data.errors.1.kind' .* did you mean 'transmission'"),
        ("inputs: [x, y]", "inputs: [x, Y]", r"'network.0.inputs': unknown network input 'Y'; .*Valid: cos"),
        ("inputs: [x, y]", "inputs: [x, x]", r"'network.0.inputs': .*are the same"),
        ("r_steps: 10", "r_steps: 20000", "the grid has 200,000 poses, 100,000 at most were wanted"),
        ("inputs: [x, y]", "inputs: []", r"'network.0.inputs': .*at least 1 item"),
        ("orders: [3]", "orders: [0]", r"'network.0.orders.0': .*greater than or equal to 1"),
        ("orders: [3]", "orders: [3], reference: [[1, 0, 0], [0, 1, 0], [0, 0, 2]]", "'network.0.reference': .*no rotation"),  # noqa: E501
        ("orders: [3]", "orders: [3], reference: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "no rotation"),
        ("joints: [theta_1, theta_2]", "joints: [theta_1, theta_3]", "'network.0.joints': .*did you mean 'theta_"),
        ("joints: [theta_1, theta_2]", "joints: [theta_1, theta_1]", "'network.0.joints': .*stands twice"),
        ("{theta_1: 0.05, theta_2: 0.5}", "{theta_1: 0.05}", "'fit.learning_rate' has no rate for joint 'theta_2'"),
        ("theta_2: 0.5}\n", "theta_2: 0.5, theta_4: 1}\n", "'fit.learning_rate.theta_4': there is no joint 'theta_4' to correct"),  # noqa: E501
        ("{theta_1: 0.05,", "{theta_1: -0.05,", "'fit.learning_rate.theta_1': .*greater than 0"),
        ("  theta_2:\n    before", "  theta2:\n    before", "'paper.theta2': .*did you mean 'theta_2'"),
        ("offset_deg: {theta_1", "offset_deg: {theta1", "'data.errors': .*has no joint 'theta1'; did you mean 'theta_1'"),  # noqa: E501
        ("elbow_positive", "elbow_positiv", "'data.training.branch': .*did you mean 'elbow_positive'"),
        ("seed: 0\npaper", "seed: -1\npaper", "'fit.seed'"),
        ("seed: 0\npaper", "seed: 99999999999999999999\npaper", "'fit.seed'"),
        ("epochs: 3000", "epochs: 9000000", "'fit.epochs'"),
        ("name: kiro3_paper", "name: ../up", "'name': .*match pattern"),
        ("robot: kiro3\n", "", "the key 'robot' is missing"),
    ],
)  # fmt: skip
def test_mistakes_are_refused_with_place(write_recipe, old, new, complaint):
    path = write_recipe(PAPER, (old, new))
    with pytest.raises(RecipeError, match=complaint) as caught:
        read_recipe(path)
    assert str(caught.value).startswith(f"{path}, line ")
    assert "\n" not in str(caught.value)


def test_the_line_is_the_one_of_the_mistake(write_recipe):
    path = write_recipe(PAPER, ("inputs: [x, y]", "inputs: [x, yy]"))
    line = next(i for i, text in enumerate(path.read_text().splitlines(), 1) if "[x, yy]" in text)
    with pytest.raises(RecipeError, match=f"kiro3_paper.yaml, line {line}: "):
        read_recipe(path)


def test_unknown_and_broken_robots_are_refused_with_place(write_recipe, tmp_path):
    path = write_recipe(PAPER, ("robot: kiro3\n", "robot: kiro33\n"))
    with pytest.raises(UnknownRobotError, match=r"line \d+: 'robot': 'kiro33' .* did you mean 'kiro3'"):
        read_recipe(path)
    (tmp_path / "arm.yaml").write_text("name: arm\n")
    path = write_recipe(PAPER, ("robot: kiro3\n", f"robot: {tmp_path}/arm.yaml\n"))
    with pytest.raises(
        RobotError, match=r"kiro3_paper.yaml, line \d+: 'robot': .*arm.yaml, line 1: .*missing"
    ):
        read_recipe(path)


def test_data_and_recipe_must_go_together(repository, small_recipe, tmp_path):
    simulated = small_recipe(PAPER)
    with pytest.raises(RecipeError, match="has no use for --data"):
        load_data(simulated, tmp_path / "data.csv")
    measured = read_recipe(repository / "training" / "ur10_inverse.yaml")
    with pytest.raises(RecipeError, match="give the file with --data"):
        load_data(measured)
    with pytest.raises(RecipeError, match="is for measured data and simulates nothing"):
        simulate(measured)


def test_the_hash_is_of_the_bytes(write_recipe):
    path = write_recipe(PAPER)
    first = recipe_hash(path)
    path.write_text(path.read_text() + "# comment\n")
    assert recipe_hash(path) != first
    assert len(first) == 64


def test_rates_come_in_the_order_of_the_joints():
    fit = GradientDescentSection(method="gradient_descent", learning_rate={"a": 1.0, "b": 2.0})
    assert fit.rates(["b", "a"]).tolist() == [2.0, 1.0]
    with pytest.raises(RecipeError, match=r"no rate for joint 'c'.*\(a, b\)"):
        fit.rates(["c"])
