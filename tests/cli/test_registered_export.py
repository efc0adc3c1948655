"""An export from outside the package: one format, registered by one line, is written by the command."""

import json

import pytest

from pisigma.cli.arguments import complete_export, complete_model, complete_robot
from pisigma.deployment.export import registry
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.registry import export_names, register_export
from pisigma.files.errors import OutputError


def write_limits(request: ExportRequest) -> Exported:
    """Joint limits, a line a joint; with `branch` as a title."""
    model = request.load()
    lines = [f"{joint.name} {joint.lower:.3f} {joint.upper:.3f}" for joint in model.robot.joints]
    return Exported("\n".join([request.branch or "", *lines]), model_facts(model), ("Nothing is corrected.",))


LIMITS = ExportFormat("limits", "a list of limits", (".txt",), write_limits, frozenset(["branch"]))


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})
    register_export(LIMITS)


def test_the_command_writes_it(run, models, tmp_path):
    out = tmp_path / "limits.txt"
    result = run("export", models / "ur10", "--format", "limits", "--out", out, "--branch", "up")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.startswith("Nothing is corrected.\n")
    assert str(out) in result.stdout
    assert out.read_text().splitlines()[0] == "up"
    assert len(out.read_text().splitlines()) == 7
    told = json.loads(run("export", models / "ur10", "--format", "limits", "--out", out, "--json").stdout)
    assert told == {
        "file": str(out), "format": "limits", "robot": "ur10", "joints": 6, "remarks": ["Nothing is corrected."]
    }  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("limts", "--out", "x.txt"), ("--format", "'limts'", "'limits'")),
        (("limits", "--out", "x.csv"), ("x.csv", ".txt")),
        (("limits", "--out", "x.txt", "--poses", "p.csv"), ("--poses", "targets", "limits")),
        (("dh", "--out", "x.csv", "--branch", "up"), ("--branch", "targets", "limits", "dh")),
    ],
)
def test_options_and_files_are_checked_as_those_of_others(refuses, models, arguments, words):
    message = refuses("export", models / "ur10", "--format", *arguments, error=OutputError)
    assert all(word in message for word in words)


def test_names_and_options_are_checked_when_registering():
    assert register_export(LIMITS) is LIMITS
    with pytest.raises(OutputError, match="'urdf'"):
        register_export(ExportFormat("urdf", "a", (), write_limits))
    with pytest.raises(OutputError, match="'limits'"):
        register_export(ExportFormat("limits", "a", (), write_limits))
    with pytest.raises(OutputError, match="'poses'"):
        register_export(ExportFormat("other", "a", (), write_limits, frozenset(["pose"])))
    assert export_names() == (*registry.BUILT_IN, "limits")


def test_shells_complete_names_of_robots_models_and_formats(models, monkeypatch):
    assert complete_export("") == list(export_names())
    assert complete_export("lim") == ["limits"]
    assert complete_robot("kiro") == ["kiro3", "kiro4"]
    monkeypatch.chdir(models.parent)
    assert f"{models.name}/" in complete_model(models.name[:3])
    assert complete_model(f"{models.name}/k") == [f"{models.name}/kiro3", f"{models.name}/kiro4"]
    assert complete_model(f"{models.name}/") == [
        f"{models.name}/{name}" for name in ("kiro3", "kiro4", "ur10")
    ]
