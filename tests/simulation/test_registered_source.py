"""An error source from outside the package: recipes accept it, and errors state file and line."""

from typing import Literal

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import parse_yaml
from pisigma.robot import Robot
from pisigma.simulation import TrueRobotSection, register_error_source
from pisigma.simulation.errors.source import AbstractJointSource, JointErrorFunction, joint_index
from pisigma.simulation.true_robot import ERROR_SOURCES


class Drift(AbstractJointSource):
    """A joint with a relative error: `e_j = share · q_j`."""

    kind: Literal["drift"] = "drift"
    joint: str
    share: float

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the drift as a function of the joint values."""
        factor = torch.zeros(robot.dof, dtype=torch.float64)
        factor[joint_index(robot, self.joint, place_in_recipe)] = self.share
        return lambda q: factor.to(q) * q


@pytest.fixture
def drift(monkeypatch):
    """The source, registered for one test."""
    monkeypatch.setitem(ERROR_SOURCES, "drift", Drift)
    del ERROR_SOURCES["drift"]
    return register_error_source(Drift)


def read(text: str):
    return parse_yaml(text, TrueRobotSection, RecipeError, source="recipe.yaml")


RECIPE = """robot: ur5
errors:
  - kind: joint_offset
    offset_deg: {theta_1: 1.0}
  - kind: drift
    joint: theta_2
    share: 1e-3
"""


def test_recipes_take_a_registered_source(drift):
    section = read(RECIPE)
    q = torch.linspace(0.1, 0.6, 6, dtype=torch.float64)
    error = section.true_robot().joint_error(q)
    assert_close(error, [torch.pi / 180, 1e-3 * 0.2, 0, 0, 0, 0], atol=1e-15)
    assert read(RECIPE) == section
    restored = TrueRobotSection(**section.model_dump())
    assert isinstance(restored.errors[1], Drift)
    assert_close(restored.true_robot().joint_error(q), error, atol=0)
    assert section.model_dump()["errors"][1] == {"kind": "drift", "joint": "theta_2", "share": 1e-3}


@pytest.mark.parametrize(
    ("text", "line", "column", "name"),
    [
        (RECIPE.replace("share: 1e-3", "share: much"), 7, "errors.1.share", "'much'"),
        (RECIPE.replace("share:", "shrae:"), 7, "errors.1.shrae", "'share'"),
        (RECIPE.replace("drift", "drfit"), 5, "errors.1.kind", "'drift'"),
        (RECIPE.replace("kind: drift", "joint: a"), 6, None, "'joint'"),
        (RECIPE.replace("  - kind: drift\n    joint", "  - joint"), 5, "errors.1.kind", "drift"),
    ],
)
def test_errors_state_file_line_and_key(drift, text, line, column, name):
    with refused(RecipeError, file="recipe.yaml", line=line, column=column) as caught:
        read(text)
    assert name in str(caught.value)


def test_a_kind_that_is_not_registered_is_refused():
    with refused(RecipeError, column="errors.1.kind", value="drift") as caught:
        read(RECIPE)
    assert "encoder, geometric," in caught.value.remedy


def test_registering_twice_is_allowed_but_not_a_second_source_of_a_kind(drift):
    assert register_error_source(drift) is drift

    class Other(AbstractJointSource):
        kind: Literal["encoder"]

    class Nameless(AbstractJointSource):
        pass

    with refused(RecipeError, option="Other", value="encoder"):
        register_error_source(Other)
    with refused(RecipeError, option="Nameless", value=0):
        register_error_source(Nameless)
