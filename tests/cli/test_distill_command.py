"""`pisigma distill`, and its model as an ONNX file."""

import json

import pytest
from testing.identified import geometric_model
from testing.models import hand_made_model
from testing.screens import assert_screen

import pisigma
from pisigma.deployment.export.onnx_model import INVERSE
from pisigma.files.errors import (
    IdentificationError,
    MeasurementError,
    ModelError,
    OutputError,
    PoseError,
    RecipeError,
)
from pisigma.model.folder.model_folder import save_model

SMALL = ("--poses", 200, "--orders", "1,2")


@pytest.fixture(scope="module")
def parents(tmp_path_factory):
    """A folder with a geometric model and one with a network only."""
    folder = tmp_path_factory.mktemp("parents")
    for name, model in (("geometric", geometric_model("kiro3")), ("network", hand_made_model("kiro3"))):
        (folder / name).mkdir()
        save_model(model, folder / name)
    return folder


@pytest.fixture(scope="module")
def distilled(run, parents):
    """What the command printed, and the folder it wrote."""
    out = parents / "small"
    result = run("distill", parents / "geometric", "--out", out, *SMALL, "--set", "seed=3", "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), out


def test_the_model_can_be_used(run, distilled):
    _, out = distilled
    ik = pisigma.load(out)
    assert (ik.model.kind, ik.model.name) == ("distilled", "small")
    T = ik.model.forward(ik.model.starts[:1])[0]
    x, y, z = (T[:3, 3] * 1e3).tolist()
    yaw = float(T[1, 0].atan2(T[0, 0]).rad2deg())
    flipped = 180.0 if float(T[2, 2]) < 0 else 0.0
    done = run("ik", out, "--pose", x, y, z, yaw, 0, flipped, "--json")
    assert done.exit_code == 0, done.output


def test_the_report_states_what_was_lost(distilled):
    report, out = distilled
    held_out = report["held_out"]
    assert held_out["full"]["max_mm"] < 1e-6
    assert held_out["distilled"]["rms_mm"] < 0.1 * held_out["nominal"]["rms_mm"]
    assert report["poses"]["held_out"] == 80
    assert [size["orders"] for size in report["sizes"]] == [[1, 2]]
    card = (out / "README.md").read_text()
    assert "`pisigma distill geometric --out small --poses 200 --set seed=3 --orders 1,2`" in card
    assert report["parent"]["sha256"] in card
    for sentence in report["limitations"]:
        assert sentence in card


def test_without_json_there_are_tables(run, parents, tmp_path):
    joints = tmp_path / "q.csv"
    rows = geometric_model("kiro3").starts[:20].rad2deg()
    rows[:, 2] *= 1e3 / rows.new_tensor(1.0).rad2deg()
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    joints.write_text("\n".join(["q1_deg,q2_deg,q3_mm,q4_deg", *lines]) + "\n")
    out = tmp_path / "tables"
    result = run("distill", parents / "geometric", "--out", out, "--joints", joints, *SMALL)
    assert result.exit_code == 0, result.output
    assert_screen(result.stdout, "80 held-out poses", "nominal", "distilled", "full")
    assert "--joints q.csv" in (out / "README.md").read_text()


def test_it_can_be_exported(run, distilled, tmp_path):
    onnx = pytest.importorskip("onnx")
    file = tmp_path / "small.onnx"
    result = run("export", distilled[1], "--format", "onnx", "--out", file, "--json")
    assert result.exit_code == 0, result.output
    about = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
    assert (about["model"], about["computes"], len(about["model_yaml_sha256"])) == ("small", INVERSE, 64)
    assert [path.name for path in tmp_path.iterdir()] == ["small.onnx"]


@pytest.mark.parametrize(
    ("options", "error", "fields"),
    [
        (("--orders", "1,x"), RecipeError, {"option": "--orders", "value": "1,x"}),
        (("--orders", "0"), RecipeError, {"option": "--orders", "value": "0"}),
        (("--harmonics", 4), RecipeError, {"option": "--harmonics", "value": None}),
        (("--orders", "1", "--harmonics", 0), RecipeError, {"option": "--harmonics", "value": 0}),
        (("--set", "seed=-1"), RecipeError, {"value": -1}),
        (("--poses", 5), IdentificationError, {"value": 5}),
        (("--region", 1, 0, 0, 1, 0, 1), PoseError, {"option": "--region", "value": "1 0 0 1 0 1"}),
        (("--region", 0, "nan", 0, 1, 0, 1), PoseError, {"option": "--region", "value": "0 nan 0 1 0 1"}),
        (("--region", 4000, 4100, 0, 100, 0, 100, *SMALL), IdentificationError, {}),
        (("--joints", "missing.csv"), MeasurementError, {"file": "missing.csv"}),
    ],
)
def test_bad_options_are_refused(refuses, parents, tmp_path, options, error, fields):
    out = tmp_path / "out"
    refuses("distill", parents / "geometric", "--out", out, *options, error=error, **fields)
    assert not out.exists()


def test_a_model_of_a_network_only_is_refused(refuses, parents, tmp_path):
    refuses(
        "distill", parents / "network", "--out", tmp_path / "out", error=ModelError, value="hand_made_kiro3"
    )


def test_another_folder_is_not_touched(refuses, parents, tmp_path):
    (tmp_path / "letter.txt").write_text("dear reader")
    refuses(
        "distill",
        parents / "geometric",
        "--out",
        tmp_path,
        error=OutputError,
        file="test_another_folder_is_not_tou0",
    )
    assert (tmp_path / "letter.txt").read_text() == "dear reader"
