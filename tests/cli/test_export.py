"""`pisigma export`: URDF, DH table and joint offsets of a model."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from testing.closeness import assert_close
from testing.models import joints_around
from testing.urdf import peer_poses

from pisigma.deployment.export.mjcf import urdf_to_mjcf
from pisigma.files.errors import ModelError, OutputError, RobotError
from pisigma.files.output_folder import staged_folder
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import robot_to_urdf

NOT_TOLD = "The learned joint correction of the model is not in this file"


@pytest.fixture(scope="module")
def geometric(tmp_path_factory):
    """A model folder of a UR10 with all parameters off their nominal values."""
    nominal, random = Robot.load("ur10"), np.random.default_rng(4)
    robot = nominal.with_geometry(base=random.normal(0, 1, 6), tool=random.normal(0, 0.2, 6))
    model = CalibratedModel(
        name="cell_3",
        kind="geometric_calibration",
        robot=robot,
        network=None,
        domain=None,
        branches=(),
        starts=joints_around("ur10", 50, spread=0.6),
        calibrated=robot.with_geometry(nominal.dh + random.normal(0, 1e-3, nominal.dh.shape)),
        bases={"tracker": robot.base, "arm": robot.base},
        tools={"": robot.tool},
    )
    folder = tmp_path_factory.mktemp("models") / "cell_3"
    folder.mkdir()
    save_model(model, folder)
    return folder


def test_urdf(run, geometric, tmp_path):
    out = tmp_path / "robot.urdf"
    printed = run("export", geometric, "--format", "urdf", "--out", out)
    assert printed.exit_code == 0
    assert str(out) in printed.stdout
    assert "'tracker'" in printed.stdout
    assert "(tracker, arm)" in printed.stdout
    assert NOT_TOLD not in out.read_text()
    calibrated = load_model(geometric).calibrated
    q = joints_around("ur10", 100, spread=2.0)
    expected = forward_kinematics(calibrated, q)
    again = Robot.load(out)
    assert_close(forward_kinematics(again, q), expected, atol=1e-12)
    assert_close(peer_poses(out, "tool0", q), expected, atol=1e-10)
    assert [joint.name for joint in again.joints] == [joint.name for joint in calibrated.joints]
    assert_close(again.limits, calibrated.limits, atol=0)


def test_mjcf_as_a_new_file_and_into_a_drawing(run, geometric, tmp_path):
    drawn, out = tmp_path / "drawn.xml", tmp_path / "robot.xml"
    printed = run("export", geometric, "--format", "mjcf", "--out", drawn)
    assert printed.exit_code == 0
    assert NOT_TOLD not in drawn.read_text()
    nominal = tmp_path / "nominal.xml"
    text = urdf_to_mjcf(robot_to_urdf(Robot.load("ur10")))[0]
    nominal.write_text(text.replace("<asset/>", '<asset><mesh file="arm.obj"/></asset>'))
    printed = run("export", geometric, "--format", "mjcf", "--like", nominal, "--out", out, "--json")
    assert printed.exit_code == 0
    assert json.loads(printed.stdout)["geometry"] == "geometric"
    assert 'site name="calibrated_tool"' in out.read_text()
    assert "(tracker, arm)" in out.read_text()
    assert "arm.obj" in out.read_text()
    assert "arm.obj" in printed.stderr


def test_urdf_in_calibrated_and_out_again(run, tmp_path):
    """A robot from a URDF with other errors than its nominal ones; its file, calibrated, is the true robot's."""
    nominal, random = Robot.load("ur10"), np.random.default_rng(5)
    (tmp_path / "nominal.urdf").write_text(robot_to_urdf(nominal))
    described = Robot.load(tmp_path / "nominal.urdf")
    true = described.with_geometry(
        described.dh + random.normal(0, 1e-3, described.dh.shape),
        random.normal(0, 1, 6),
        random.normal(0, 0.1, 6),
    )
    q = joints_around("ur10", 120, spread=1.5)
    T = forward_kinematics(true, q)
    rows = Measurements(q=q, position=T[:, :3, 3], rotation=T[:, :3, :3])
    rows.write_csv(tmp_path / "data.csv", described)
    command = ("calibrate", tmp_path / "nominal.urdf", tmp_path / "data.csv", "--out", tmp_path / "model")
    assert run(*command, "--folds", "0", "--set", "prior_mm=0", "--set", "prior_mrad=0").exit_code == 0
    assert load_model(tmp_path / "model").robot.joints == described.joints
    out, like = tmp_path / "calibrated.urdf", ("--like", tmp_path / "nominal.urdf", "--tip", "tool0")
    export = ("export", tmp_path / "model", "--format", "urdf", "--out", out)
    assert run(*export).exit_code == 0
    by_default = out.read_text()
    assert run(*export, *like).exit_code == 0
    assert out.read_text() == by_default
    (tmp_path / "nominal.urdf").rename(tmp_path / "elsewhere.urdf")
    assert run(*export).exit_code == 0
    assert out.read_text() == by_default
    new = joints_around("ur10", 50, seed=1, spread=2.0)
    model = load_model(tmp_path / "model")
    assert_close(
        peer_poses(out, "calibrated_tool", new), forward_kinematics(model.calibrated, new), atol=1e-10
    )
    assert_close(peer_poses(out, "calibrated_tool", new), forward_kinematics(true, new), atol=1e-8)
    with staged_folder(
        tmp_path / "model", overwrite=True
    ) as folder:  # as models were before they kept the file
        save_model(replace(model, robot=replace(model.robot, urdf=None)), folder)
    assert "--like FILE" in " ".join(run(*export).stderr.split())
    assert_close(peer_poses(out, "tool0", new), forward_kinematics(model.calibrated, new), atol=1e-10)


def test_dh_as_yaml_and_csv(run, geometric, tmp_path):
    calibrated = load_model(geometric).calibrated
    for name in ("dh.yaml", "dh.csv"):
        result = run("export", geometric, "--format", "dh", "--out", tmp_path / name, "--json")
        assert result.exit_code == 0
        told = json.loads(result.stdout)
        assert (told["file"], told["format"], told["robot"]) == (str(tmp_path / name), "dh", "ur10")
    again = Robot.load(tmp_path / "dh.yaml")
    for part in ("dh", "base", "tool"):
        assert_close(getattr(again, part), getattr(calibrated, part), atol=1e-15, rtol=1e-15)
    rows = [line for line in (tmp_path / "dh.csv").read_text().splitlines() if line.startswith("row,")]
    assert len(rows) == 6


def test_offsets(run, geometric, tmp_path):
    result = run("export", geometric, "--format", "offsets", "--out", tmp_path / "o.yaml", "--json")
    told = json.loads(result.stdout)
    lost, of_nominal = told["off_the_whole_model"], told["robot_as_drawn"]
    assert 0 < lost["mean_mm"] < lost["p95_mm"] < lost["max_mm"]
    assert lost["mean_mm"] < of_nominal["mean_mm"]
    text = (tmp_path / "o.yaml").read_text()
    assert f" {lost['mean_mm']:.4g} mm" in text
    written = yaml.safe_load(text)
    assert written["off_the_whole_model"] == lost
    printed = run("export", geometric, "--format", "offsets", "--out", tmp_path / "o.csv")
    assert f"{lost['mean_mm']:.4g} mm" in printed.stdout
    lines = (tmp_path / "o.csv").read_text().splitlines()
    assert f"{lost['max_mm']:.4g} mm at most" in "".join(line for line in lines if line.startswith("#"))
    *joints, base, tool = csv.DictReader(line for line in lines if not line.startswith("#"))
    assert [float(joint["offset_deg"]) for joint in joints] == [j["offset_deg"] for j in written["joints"]]
    model = load_model(geometric)
    frames = [
        np.array([*np.array([float(line[f"{c}_mm"]) for c in "xyz"]) / 1e3,
                  *np.deg2rad([float(line[f"{c}_deg"]) for c in ("roll", "pitch", "yaw")])])
        for line in (base, tool)
    ]  # fmt: skip
    moved = model.robot.with_geometry(base=frames[0], tool=frames[1])
    offset = torch.tensor([np.deg2rad(float(joint["offset_deg"])) for joint in joints])
    way = forward_kinematics(moved, model.starts + offset) - forward_kinematics(
        model.calibrated, model.starts
    )
    assert float(way[:, :3, 3].norm(dim=-1).max()) < 1.5e-3 * lost["max_mm"]


@pytest.mark.parametrize(
    ("form", "suffix"), [("urdf", "urdf"), ("dh", "csv"), ("dh", "yaml"), ("offsets", "csv")]
)
def test_a_missing_learned_correction_is_stated(run, models, tmp_path, form, suffix):
    out = tmp_path / f"out.{suffix}"
    result = run("export", models / "kiro3", "--format", form, "--out", out)
    assert result.exit_code == 0
    assert NOT_TOLD in " ".join(result.stdout.split())
    assert NOT_TOLD in out.read_text()
    told = json.loads(run("export", models / "kiro3", "--format", form, "--out", out, "--json").stdout)
    assert any(NOT_TOLD in remark for remark in told["remarks"])


@pytest.mark.parametrize(
    ("arguments", "error", "words", "file"),
    [
        (("--format", "urd", "--out", "x.urdf"), OutputError, ("--format", "'urd'", "'urdf'"), None),
        (("--format", "urdf", "--out", "x.xml"), OutputError, (".urdf",), "x.xml"),
        (("--format", "dh", "--out", "x.urdf"), OutputError, (".csv", ".yaml", ".yml"), "x.urdf"),
        (("--format", "dh", "--out", "x.csv", "--like", "x.urdf"), OutputError, ("--like", "staubli"), None),
        (("--format", "urdf", "--out", "x.urdf", "--tip", "a"), OutputError, ("--tip", "--like"), None),
        (("--format", "urdf", "--out", "x.urdf", "--like", "y.urdf"), RobotError, (), "y.urdf"),
        (("--format", "offsets", "--out", "none/x.csv"), OutputError, (), "x.csv"),
    ],
)
def test_what_cannot_be_written(refuses, models, arguments, error, words, file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fields = {} if file is None else {"file": file}
    message = refuses("export", models / "ur10", *arguments, error=error, **fields)
    assert all(word in message for word in words)
    assert not list(tmp_path.iterdir())


def test_no_model(refuses, tmp_path):
    refuses("export", tmp_path / "none", "--format", "urdf", "--out", tmp_path / "x.urdf", error=ModelError)
    assert not list(tmp_path.iterdir())


def test_the_command_explains_itself(run):
    result = run("export", "--help")
    assert result.exit_code == 0
    assert all(word in result.stdout for word in ("urdf", "offsets", "--json"))
    assert "export" in run("--help").stdout
