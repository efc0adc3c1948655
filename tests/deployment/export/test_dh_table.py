"""DH tables: the YAML is a robot file, and the CSV has the same numbers."""

import csv
import json
import math

import numpy as np
import pytest
import yaml
from testing.closeness import assert_close
from testing.coupled import coupled_robot

from pisigma.deployment.export.dh_table import CONVENTION, dh_csv, dh_json, dh_yaml
from pisigma.robot import DH_COLUMNS, FRAME_COLUMNS, Robot, catalogue

LENGTHS = ("d", "a", "x", "y", "z")


def calibrated(name: str) -> Robot:
    """A catalogue robot with errors in all parameters."""
    nominal, random = Robot.load(name), np.random.default_rng(3)
    return nominal.with_geometry(
        nominal.dh + random.normal(0, 1e-3, nominal.dh.shape),
        random.normal(0, 0.5, 6),
        random.normal(0, 0.2, 6),
    )


def in_si(line: dict[str, str], names: tuple[str, ...]) -> list[float]:
    return [
        float(line[f"{name}_mm"]) / 1e3 if name in LENGTHS else math.radians(float(line[f"{name}_deg"]))
        for name in names
    ]


@pytest.mark.parametrize("name", catalogue())
def test_the_yaml_is_a_robot_file(name, tmp_path):
    robot = calibrated(name)
    (tmp_path / "robot.yaml").write_text(dh_yaml(robot, ("two\nlines", "a: b")))
    again = Robot.load(tmp_path / "robot.yaml")
    for part in ("dh", "base", "tool", "limits"):
        assert_close(getattr(again, part), getattr(robot, part), atol=1e-15, rtol=1e-15)
    assert [(row.name, row.type, row.direction) for row in again.rows] == [
        (row.name, row.type, row.direction) for row in robot.rows
    ]
    same = {"convention": CONVENTION, "remarks": ["said"], **yaml.safe_load(dh_yaml(robot))}
    assert json.loads(dh_json(robot, ("said",))) == same
    lines = (tmp_path / "robot.yaml").read_text().splitlines()
    assert lines[0].startswith("# A_i = RotZ(theta_i")
    assert lines[1:4] == ["# two lines", "# a: b", f"name: {name}"]


@pytest.mark.parametrize("name", catalogue())
def test_the_csv_has_the_same_numbers(name):
    robot = calibrated(name)
    lines = dh_csv(robot, ("said",)).splitlines()
    assert [line[0] for line in lines[:3]] == ["#", "#", "p"]
    base, *rows, tool = csv.DictReader(line for line in lines if not line.startswith("#"))
    assert (base["part"], tool["part"]) == ("base", "tool")
    assert_close([in_si(row, DH_COLUMNS) for row in rows], robot.dh, atol=1e-15, rtol=1e-15)
    assert_close(in_si(base, FRAME_COLUMNS), robot.base, atol=1e-15, rtol=1e-15)
    assert_close(in_si(tool, FRAME_COLUMNS), robot.tool, atol=1e-15, rtol=1e-15)
    for line, row in zip(rows, robot.rows, strict=True):
        assert (line["name"], line["type"], int(line["direction"])) == (row.name, row.type, row.direction)
        assert {line["x_mm"], line["yaw_deg"]} == {""}
        unit, factor = ("deg", math.radians(1)) if row.type == "revolute" else ("mm", 1e-3)
        other = "mm" if unit == "deg" else "deg"
        assert line[f"lower_{other}"] == line[f"upper_{other}"] == ""
        if row.type != "fixed":
            found = [float(line[f"{side}_{unit}"]) * factor for side in ("lower", "upper")]
            assert_close(found, [row.lower, row.upper], rtol=1e-15, atol=0)


def test_the_coupling_of_joints_is_stated_above_the_table():
    (line,) = [line for line in dh_csv(coupled_robot()).splitlines() if "coupling" in line]
    stated = yaml.safe_load("coupling: " + line.partition("coupling: ")[2])
    assert stated == {"coupling": [{"joint": "theta_3", "factors": {"theta_2": 1.0, "theta_3": 1.0}}]}
