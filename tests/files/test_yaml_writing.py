"""Changes of single values in a YAML file: comments, order and all other values stay."""

import pytest
from testing.refusals import refused

from pisigma.files.errors import PisigmaError
from pisigma.files.yaml_file import parse_plain_yaml
from pisigma.files.yaml_writing import with_changed_value

TEXT = """# a cell
robot: ur5   # the arm
plan:
  # Number of poses.
  # count: 40
  seed: 3

surroundings:
  boxes:   # two
  - name: table  # first
    center_mm:
    - 1
    - 2
  - {name: wall, center_mm: [4, 5]}
  tracker:
    x_mm: 1  # east
calibrate:  # nothing yet
# the end"""


@pytest.mark.parametrize(
    ("keys", "value", "changed"),
    [
        ("robot", "ur10", ("robot: ur5 ", "robot: ur10 ")),
        ("robot", "1e-3", ("robot: ur5 ", "robot: '1e-3' ")),
        ("plan.count", 12, ("  # count: 40", "  count: 12\n  # count: 40")),
        ("plan.check", 2, ("  seed: 3\n", "  seed: 3\n  check: 2\n")),
        ("plan.seed", None, ("  seed: 3\n", "")),
        ("calibrate.folds", 5, ("nothing yet\n", "nothing yet\n  folds: 5\n")),
        ("limit_mm", 0.3, ("# the end\n", "limit_mm: 0.3\n# the end\n")),
        ("surroundings.boxes.0.center_mm", [7, 8], ("\n    - 1\n    - 2\n", "\n     [7, 8]\n")),
        (
            "surroundings.boxes.1.yaw_deg",
            9,
            ("wall, center_mm: [4, 5]", "wall, center_mm: [4, 5], yaw_deg: 9"),
        ),
        ("surroundings.boxes.2.name", "x", ("[4, 5]}\n", "[4, 5]}\n  - {name: x}\n")),
        ("surroundings.boxes.1", None, ("  - {name: wall, center_mm: [4, 5]}\n", "")),
        ("surroundings.tracker.x_mm", None, ("  tracker:\n    x_mm: 1  # east\n", "")),
        ("surroundings.floor_mm", -5, ("# east\n", "# east\n  floor_mm: -5\n")),
        ("instrument.name", "a: b", ("# the end\n", "instrument: {name: 'a: b'}\n# the end\n")),
    ],
)
def test_one_value_is_changed(keys, value, changed):
    stated = [int(key) if key.isdigit() else key for key in keys.split(".")]
    found = with_changed_value(TEXT, stated, value, "cell.yaml")
    assert found == f"{TEXT}\n".replace(*changed)
    assert with_changed_value(found, stated, value, "cell.yaml") == found


def test_aliased_values_cannot_be_changed_separately():
    text = "a: &same {b: 1}\nc: *same\n"
    with refused(PisigmaError, file="cell.yaml", column="a.b"):
        with_changed_value(text, ["a", "b"], {"x": 2}, "cell.yaml")
    assert parse_plain_yaml(text, PisigmaError, "") == {"a": {"b": 1}, "c": {"b": 1}}
