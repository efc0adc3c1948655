"""Plug-ins: the examples of the documentation, as files and as installed packages, through the real commands."""

import json
import re
import sys
from pathlib import Path

import pytest
from testing.engine_work import PicklingEngine
from testing.models import hand_made_model, no_type_checker
from testing.simulated_arm import simulate

from pisigma.deployment.export import registry as exports
from pisigma.files import plugins
from pisigma.files.errors import PluginError
from pisigma.joint_correction.registry import FEATURES
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.readings import READINGS
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.model.folder.model_folder import save_model
from pisigma.robot.kinematics.closed_form.registry import CLOSED_FORMS
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.simulation.true_robot import ERROR_SOURCES

HOW_TO = Path(__file__).parents[2] / "docs" / "how-to"
REGISTRIES = (FEATURES, CLOSED_FORMS, READINGS, SENSORS, ERROR_SOURCES)

EVIL = """from pathlib import Path
Path(__file__).with_suffix(".ran").touch()
"""


@pytest.fixture(autouse=True)
def nothing_stays(monkeypatch):
    """What a test registers is known to no other."""
    monkeypatch.setattr(plugins, "_loaded", plugins.Plugins())
    monkeypatch.setattr(exports, "_REGISTERED", dict(exports._REGISTERED))
    before = [dict(registry) for registry in REGISTRIES]
    yield
    for registry, entries in zip(REGISTRIES, before, strict=True):
        registry.clear()
        registry.update(entries)


@pytest.fixture
def example(tmp_path):
    """The plug-in of a page of the documentation, as a file."""

    def write(page: str) -> Path:
        first = re.search(
            r"<!-- runs -->\n+```python\n(.*?)^```", (HOW_TO / f"{page}.md").read_text(), re.M | re.S
        )
        path = tmp_path / f"{page.replace('-', '_')}.py"
        path.write_text(first[1])
        return path

    return write


@pytest.fixture
def arm(tmp_path):
    """Rows of a simulated arm, and the file that they are in."""
    simulated = simulate("kiro4", rows=40, noise=5e-5)
    simulated.measurements.write_csv(tmp_path / "rows.csv", simulated.nominal)
    return simulated


def test_a_feature_is_tried_by_calibrate(run, example, arm, tmp_path):
    """The feature is tried with the others by default, and alone if the option names it."""
    options = ("--folds", 0, "--json", "--plugin", example("add-a-feature"))
    printed = json.loads(
        run("calibrate", "kiro4", tmp_path / "rows.csv", "--out", tmp_path / "a", *options).stdout
    )
    usual = {one["name"] for one in printed["hybrid"]["trials"]}
    options = (*options, "--set", "features=belt", "--accept-implausible")
    printed = json.loads(
        run("calibrate", "kiro4", tmp_path / "rows.csv", "--out", tmp_path / "b", *options).stdout
    )
    assert any("belt" in name for name in usual)
    assert any("series" in name for name in usual)
    assert {one["name"] for one in printed["hybrid"]["trials"]} <= {"geometry", "belt", "products"}


def test_a_sensor_is_read_and_calibrated_with(run, example, arm, tmp_path):
    path = example("add-a-sensor")
    plugins.load_files([path])
    distance = forward_kinematics(arm.true, arm.measurements.q)[:, :2, 3].norm(dim=-1)
    plumb = Measurements(q=arm.measurements.q.flip(0), readings={"plumb": distance.flip(0)})
    join([arm.measurements, plumb]).write_csv(tmp_path / "both.csv", arm.nominal)
    options = ("--model", "geometric", "--folds", 0, "--out", tmp_path / "m", "--json")
    result = run("calibrate", "kiro4", tmp_path / "both.csv", *options, "--plugin", path)
    assert "plumb" in {one["sensor"] for one in json.loads(result.stdout)["noise"]}, result.stderr


def test_an_error_source_is_simulated(run, example, tmp_path, repository):
    text = (repository / "training" / "rb5_redundancy.yaml").read_text()
    source = "errors:\n  - {kind: hanging_play, width_deg: {theta_2: 0.02}}\n"
    (tmp_path / "recipe.yaml").write_text(re.sub(r"errors:\n", source, text, count=1))
    path = example("add-an-error-source")
    arguments = ("simulate", tmp_path / "recipe.yaml", "--out", tmp_path / "rows.csv")
    assert run(*arguments).exit_code == 2
    assert run(*arguments, "--plugin", path).exit_code == 0


def test_a_format_is_exported_and_what_a_plug_in_prints_is_no_result(run, example, tmp_path):
    (tmp_path / "model").mkdir()
    save_model(hand_made_model("kiro3"), tmp_path / "model")
    path = example("add-an-export")
    path.write_text(path.read_text() + "print('hello')\n")
    arguments = (
        "export",
        tmp_path / "model",
        "--format",
        "limits",
        "--out",
        tmp_path / "limits.txt",
        "--json",
    )
    assert run(*arguments).exit_code == 2
    result = run(*arguments, "--plugin", path)
    assert json.loads(result.stdout)["format"] == "limits"
    assert "hello" in result.stderr


def test_a_closed_form_solves(run, example, tmp_path):
    (tmp_path / "mast.yaml").write_text(
        "name: mast\nmaker: We\nsource: made up\nrows:\n"
        "  - {name: lift, type: prismatic, limits_mm: [0, 2000], d_mm: 100}\n"
        "  - {name: turn, type: revolute, limits_deg: [-170, 170], d_mm: 200}\n"
    )
    arguments = ("robots", "--check", tmp_path / "mast.yaml", "--json")
    assert json.loads(run(*arguments).stdout)["closed_form"] is None
    found = json.loads(run(*arguments, "--plugin", example("add-a-closed-form")).stdout)["closed_form"]
    assert found == {"name": "mast", "branches": ["only"]}


def test_an_installed_package_is_loaded_by_every_command(run, example, tmp_path, monkeypatch):
    """An installed package has a folder with its entry points next to it."""
    example("add-an-export").rename(tmp_path / "limits_of_joints.py")
    folder = tmp_path / "limits_of_joints-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: limits-of-joints\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[pisigma.plugins]\nlimits = limits_of_joints\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run("robots").exit_code == 0
    assert "limits" in exports.export_names()
    monkeypatch.setattr(plugins, "_loaded", plugins.Plugins())
    (folder / "entry_points.txt").write_text("[pisigma.plugins]\nlimits = limits_of_nothing\n")
    result = run("robots")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "plug-in 'limits' of limits-of-joints" in result.stderr


@pytest.mark.parametrize("text", ["import no_such_module", "1 / 0", "def f(:", "raise SystemExit(0)", None])
def test_a_file_that_cannot_be_loaded_is_refused(run, tmp_path, text):
    if text is not None:
        (tmp_path / "bad.py").write_text(text)
    result = run("robots", "--plugin", tmp_path / "bad.py")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "bad.py" in result.stderr


def test_a_file_runs_once(tmp_path):
    (tmp_path / "count.py").write_text("import sys\nsys.counted = getattr(sys, 'counted', 0) + 1\n")
    for _ in range(2):
        plugins.load_files([tmp_path / "count.py", tmp_path / ".." / tmp_path.name / "count.py"])
    assert vars(sys).pop("counted") == 1


def test_other_processes_load_what_they_are_sent_before_they_read_it(tmp_path):
    """As where a calibration holds a feature of a plug-in."""
    (tmp_path / "work.py").write_text("class Item(int):\n    pass\n\ndef twice(i): return 2 * i\n")
    plugins.load_files([tmp_path / "work.py"])
    (name,) = (name for name in sys.modules if name.startswith("pisigma_plugin_work"))
    module = sys.modules[name]

    def forget() -> None:
        sys.modules.pop(name, None)
        plugins._loaded = plugins.Plugins()

    items = [module.Item(3), module.Item(4)]
    results = PicklingEngine(before_each=forget).results(module.twice, items, 1)
    assert sorted(result for _, result in results) == [6, 8]


@pytest.mark.parametrize("key", ["plugin", "plugins"])
def test_no_file_that_others_may_have_sent_names_a_plug_in(run, tmp_path, repository, models, arm, key):
    """A robot, a recipe, a manifest, a cell and a model; whether they are refused or the key is not looked at."""
    evil = tmp_path / "evil.py"
    evil.write_text(EVIL)
    recipe = (repository / "training" / "rb5_redundancy.yaml").read_text()
    (tmp_path / "recipe.yaml").write_text(f"{recipe}{key}: {evil}\n")
    robot = (repository / "pisigma" / "robot" / "catalogue" / "kiro4.yaml").read_text()
    (tmp_path / "robot.yaml").write_text(f"{robot}{key}: {evil}\n")
    (tmp_path / "cell.yaml").write_text(f"{key}: {evil}\n")
    (tmp_path / "fleet.csv").write_text(
        f"id,robot,data,{key},options\n1,kiro4,rows.csv,{evil},{key}={evil}\n"
    )
    model = tmp_path / "model"
    with no_type_checker():
        model.mkdir()
        save_model(hand_made_model("kiro4"), model)
    description = (model / "model.yaml").read_text()
    (model / "model.yaml").write_text(f"{key}: {evil}\n{description}")
    for arguments in (
        ("simulate", tmp_path / "recipe.yaml", "--out", tmp_path / "x.csv"),
        ("robots", "--check", tmp_path / "robot.yaml"),
        ("plan", "kiro4", "--out", tmp_path / "p.csv", "--surroundings", tmp_path / "cell.yaml"),
        ("new", "--from", tmp_path / "fleet.csv", "--out", tmp_path / "fleet"),
        ("evaluate", model, tmp_path / "rows.csv"),
    ):
        assert run(*arguments).exit_code == 2, arguments
    assert not evil.with_suffix(".ran").exists()
    with pytest.raises(PluginError):
        plugins.load_files([tmp_path / "nothing.py"])
    plugins.load_files([evil])
    assert evil.with_suffix(".ran").exists(), "the file of this test does what it shall"
