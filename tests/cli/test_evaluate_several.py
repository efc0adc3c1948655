"""`pisigma evaluate` with several models, and as an acceptance test."""

import json

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.models import no_type_checker
from testing.refusals import problem_of
from testing.screens import assert_screen

from pisigma.files.errors import AcceptanceError, MeasurementError, ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.validation.held_out.reference_models import geometric_model

FIGURES = ("rms_mm", "mean_mm", "p95_mm", "max_mm", "intervals", "axes")


def numbers_in(value: object) -> list[float]:
    """All numbers in nested lists and mappings, in order."""
    if isinstance(value, dict | list):
        return [
            one for part in (value.values() if isinstance(value, dict) else value) for one in numbers_in(part)
        ]
    return [value] if isinstance(value, int | float) else []


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Models `hybrid` and `geometric_only` of one simulated robot, and `rows.csv`, measured elsewhere too."""
    path = tmp_path_factory.mktemp("several")
    arm = hybrid_of("kiro4", share=0.5)
    with no_type_checker():
        model = model_of_hybrid("kiro4", arm.true.nominal, arm.result, arm.measurements)
        q = joints_in(arm.true.nominal, 60, seed=5, share=0.7)
        rows = Measurements(q=q, position=arm.true.forward(q)[:, :3, 3])
        for name, one in (("hybrid", model), ("geometric_only", geometric_model(model))):
            (path / name).mkdir()
            save_model(one, path / name)
        rows.write_csv(path / "rows.csv", arm.true.nominal)
        arm.measurements.write_csv(path / "trained.csv", arm.true.nominal)
    return path


@pytest.fixture(scope="module")
def several(run, folder):
    """Everything compared on the rows."""
    arguments = ("nominal", "geometric", folder / "hybrid", folder / "geometric_only", folder / "rows.csv")
    result = run("evaluate", *arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_models_are_listed_in_the_given_order(several, folder):
    assert [model["name"] for model in several["models"]] == [
        "nominal",
        "geometric",
        "hybrid",
        "geometric_only",
    ]
    assert [model.get("model") for model in several["models"][2:]] == [
        str(folder / "hybrid"),
        str(folder / "geometric_only"),
    ]
    assert "accepted" not in several
    assert several["rows"] == several["rows_compared"] == several["configurations"] == 60
    nominal, geometric, hybrid, same = several["models"]
    assert nominal["rms_mm"] > geometric["rms_mm"] > hybrid["rms_mm"]
    leaves = [numbers_in([model[name] for name in FIGURES]) for model in (same, geometric)]
    assert len(leaves[0]) >= 10
    assert_close(leaves[0], leaves[1], atol=1e-12)  # each folder's angles went through degrees
    assert "inside_domain" not in geometric
    assert hybrid["inside_domain"]["rows"] + hybrid["outside_domain"]["rows"] == 60


def test_figures_are_those_of_the_models(several, folder):
    """From the model's own poses, by numpy alone."""
    model = load_model(folder / "hybrid")
    rows = Measurements.read_csv(folder / "rows.csv", model.robot)
    with no_type_checker():
        off = 1e3 * (rows.position - model.forward(rows.q)[:, :3, 3]).numpy()
    sizes = np.linalg.norm(off, axis=1)
    found = several["models"][2]
    assert_close(found["rms_mm"], np.sqrt((sizes**2).mean()), rtol=1e-12)
    assert_close(found["mean_mm"], sizes.mean(), rtol=1e-12)
    assert_close(found["p95_mm"], np.quantile(sizes, 0.95), rtol=1e-12)
    assert_close(found["max_mm"], sizes.max(), rtol=1e-12)
    for index, axis in enumerate("xyz"):
        assert_close(found["axes"][axis]["mean_mm"], off[:, index].mean(), rtol=1e-10)
        assert_close(found["axes"][axis]["max_mm"], np.abs(off[:, index]).max(), rtol=1e-12)
    with no_type_checker():
        geometric = (
            1e3 * (rows.position - geometric_model(model).forward(rows.q)[:, :3, 3]).norm(dim=-1).numpy()
        )
    difference = several["models"][3]["difference_to_first"]["position"]
    nominal = several["models"][0]
    assert_close(difference["mean_mm"], geometric.mean() - nominal["mean_mm"], rtol=1e-11)


def test_the_tables_name_every_model(run, folder):
    result = run("evaluate", "nominal", folder / "hybrid", folder / "geometric_only", folder / "rows.csv")
    assert result.exit_code == 0
    assert_screen(result.stdout, "RMS of 60 rows: nominal", "hybrid", "geometric_only", "from nominal")
    whole = run(
        "evaluate", "nominal", folder / "hybrid", folder / "geometric_only", folder / "rows.csv", "--verbose"
    )
    lines = whole.stdout.splitlines()
    heads = [line.split() for line in lines if set(line.split()) & {"nominal", "hybrid", "geometric_only"}]
    shown = [head for head in heads if set(head) <= {"nominal", "hybrid", "geometric_only"}]
    assert {name for head in shown for name in head} == {"nominal", "hybrid", "geometric_only"}
    outside = " ".join(line for line in lines if "position, RMS outside its domain [mm]" in line)
    assert outside.count(" rows)") == 1
    assert outside.split().count("-") == 2
    assert max(map(len, lines)) <= 80


def test_equal_arguments_give_equal_figures_and_the_seed_gives_others(run, folder):
    def intervals(*options: object) -> dict:
        result = run("evaluate", folder / "hybrid", folder / "rows.csv", "--json", *options)
        return json.loads(result.stdout)["models"][1]["intervals"]

    assert intervals() == intervals()
    assert intervals("--set", "seed=1") != intervals()


def test_a_single_model_is_compared_with_nominal(run, folder):
    printed = json.loads(run("evaluate", folder / "hybrid", folder / "trained.csv", "--json").stdout)
    assert printed["model"] == str(folder / "hybrid")
    assert printed["nominal"]["rms_mm"] == printed["models"][0]["rms_mm"] > printed["corrected"]["rms_mm"]
    assert [model["name"] for model in printed["models"]] == ["nominal", "hybrid"]


METS = ["--max-mean-mm", "1000", "--max-p95-mm", "1000", "--max-mm", "1000"]


def test_accepted(run, folder):
    result = run("evaluate", folder / "hybrid", folder / "geometric_only", folder / "rows.csv", *METS)
    assert (result.exit_code, result.stderr) == (0, "")
    assert_screen(result.stdout, "Trust: accepted", "mean_mm 1000")
    printed = json.loads(run("evaluate", folder / "hybrid", folder / "rows.csv", "--json", *METS).stdout)
    assert (printed["accepted"], printed["missed"]) == (True, [])


@pytest.mark.parametrize("option", ["--max-mean-mm", "--max-p95-mm", "--max-mm"])
def test_not_accepted(run, folder, several, option):
    """The hybrid meets the limit and the geometric model does not; nominal is not asked to."""
    key = {"--max-mean-mm": "mean_mm", "--max-p95-mm": "p95_mm", "--max-mm": "max_mm"}[option]
    better, worse = several["models"][2][key], several["models"][3][key]
    limit = (better + worse) / 2 if better < worse else better * 1.01
    arguments = ("evaluate", "nominal", folder / "hybrid", folder / "rows.csv", option, limit)
    assert run(*arguments).exit_code == 0
    too_small = 0.99 * min(better, worse)
    both = ("evaluate", folder / "hybrid", folder / "geometric_only", folder / "rows.csv", option, too_small)
    result = run(*both, "--json")
    assert result.exit_code == 3
    (line,) = result.stderr.strip().splitlines()
    assert isinstance(problem_of(result), AcceptanceError)
    assert all(word in line for word in (" hybrid ", " geometric_only ", option))
    printed = json.loads(result.stdout)
    assert printed["accepted"] is False
    assert len(printed["missed"]) == 2
    shown = run(*both)
    assert shown.exit_code == 3
    assert_screen(shown.stdout, "Trust: not accepted")


def test_one_model_of_two_is_not_enough(run, folder, several):
    limit = (several["models"][2]["mean_mm"] + several["models"][3]["mean_mm"]) / 2
    result = run(
        "evaluate", folder / "hybrid", folder / "geometric_only", folder / "rows.csv", "--max-mean-mm", limit
    )
    assert result.exit_code == 3
    assert " geometric_only " in result.stderr
    assert " hybrid " not in result.stderr


def test_refusals(refuses, run, folder):
    rows, hybrid = folder / "rows.csv", folder / "hybrid"
    refuses("evaluate", hybrid, rows, "--max-mm", -1, error=MeasurementError, option="--max-mm", value=-1.0)
    refuses(
        "evaluate",
        hybrid,
        rows,
        "--max-mean-deg",
        1,
        error=MeasurementError,
        option="--max-mean-deg",
        value=1.0,
    )
    refuses("evaluate", hybrid, hybrid, rows, error=ModelError)
    refuses("evaluate", "nominal", "geometric", rows, error=ModelError, value="nominal geometric")
    alone = run("evaluate", hybrid)
    assert alone.exit_code == 2
    assert "measurement file" in alone.stderr


def test_models_with_the_same_name_are_distinguished(run, folder, tmp_path):
    (tmp_path / "hybrid").symlink_to(folder / "geometric_only")
    (tmp_path / "other").mkdir()
    save_model(load_model(folder / "hybrid"), tmp_path / "other")
    (tmp_path / "nominal").symlink_to(folder / "hybrid")
    printed = json.loads(
        run(
            "evaluate",
            tmp_path / "nominal",
            folder / "hybrid",
            tmp_path / "other",
            folder / "rows.csv",
            "--json",
        ).stdout
    )
    names = [model["name"] for model in printed["models"]]
    assert names == [str(tmp_path / "nominal"), str(folder / "hybrid"), "other"]
    assert len({model["rms_mm"] for model in printed["models"]}) == 1


def test_sockets_whose_rows_meet_nowhere_are_implausible(run, folder, tmp_path):
    lines = (folder / "rows.csv").read_text().splitlines()
    joints = [",".join(line.split(",")[:6]) for line in lines]
    (tmp_path / "sockets.csv").write_text(
        "\n".join([f"{joints[0]},socket", *(f"{line},s/{row % 3}" for row, line in enumerate(joints[1:]))])
        + "\n"
    )
    for command in ("evaluate", "verify"):
        result = run(command, folder / "hybrid", tmp_path / "sockets.csv", "--json")
        assert result.exit_code == 3
        assert [one["kind"] for one in json.loads(result.stdout)["diagnostics"]] == ["implausible_errors"]
