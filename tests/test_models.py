"""Shipped models: each folder loads, has its card and figures, and reproduces the numbers of the card."""

import csv
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker

import pisigma
from pisigma.model.folder.model_folder import load_model
from pisigma.network.pairs import build_pairs
from pisigma.reporting.tables import joint_table
from pisigma.validation.held_out.training_summary import AbsoluteJointErrorFigures, TrainingSummary
from pisigma.workflow.recipes.data import simulate
from pisigma.workflow.recipes.reader import read_recipe, recipe_hash
from pisigma.workflow.recipes.recipe import SimulatedData

MODELS = Path(__file__).parent.parent / "models"
FOLDERS = [MODELS / name for name in ("kiro3", "kiro4")]
"""Models of the paper's robots, which the recipes with the same names train."""
MEASURED = [MODELS / name for name in ("fanuc_burakov", "panda_platonics", "ur10_landgraf", "ur5_jacobi")]
"""Models of measured robots, from the commands in training/README.md."""
MAX_BYTES = 2_000_000
"""Largest size of a model folder [byte]."""
SECTIONS = ("Joint errors", "Figures", "Domain", "Not validated", "Use", "Provenance")

each = pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
each_measured = pytest.mark.parametrize("folder", MEASURED, ids=lambda path: path.name)


def test_only_these_models_are_shipped():
    shipped = {path for path in MODELS.iterdir() if path.is_dir() and not path.name.startswith("my_")}
    assert shipped == {*FOLDERS, *MEASURED}


@each_measured
def test_a_measured_model_is_small_and_loads(folder):
    """Its corrected joint values lead to the poses of held-out rows under the model itself."""
    assert sum(path.stat().st_size for path in folder.iterdir()) <= MAX_BYTES
    model, ik = load_model(folder), pisigma.load(folder)
    assert model.name == ik.name == folder.name
    assert "compiled" in vars(ik)  # read, not made
    q = model.starts[:20]
    T = model.forward(q).numpy()
    solution = ik(T, near=q.numpy(), throw=False)
    statuses = set(solution.status.tolist())
    assert statuses <= {int(pisigma.Status.REACHED), int(pisigma.Status.OUTSIDE_DOMAIN)}
    assert_close(model.forward(torch.from_numpy(solution.q)), torch.from_numpy(T), atol=1e-9)


@each_measured
def test_a_measured_model_has_the_figures_of_its_held_out_rows(folder):
    figures = load_model(folder).metrics["cross_validation"]
    with open(folder / "held_out.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    card = (folder / "README.md").read_text(encoding="utf-8")
    shown = re.search(r"^\| position, RMS \| mm \| (\S+) \| (\S+) \| (\S+) \|$", card, re.MULTILINE)
    rtol = 0.1 if "repeats" in figures else 1e-3  # the file has the rows of the first repeat only
    for name, on_card in zip(("nominal", "geometric", "hybrid"), shown.groups(), strict=True):
        errors = torch.tensor([float(row[f"{name}_mm"]) for row in rows], dtype=torch.float64)
        assert_close(errors.square().mean().sqrt(), figures[name]["rms_mm"], rtol=rtol)
        assert_close(float(on_card), figures[name]["rms_mm"], rtol=2e-3)


@each_measured
def test_the_page_cites_the_data_of_a_measured_model(folder, repository):
    provenance = load_model(folder).provenance
    page = (folder.parent / "README.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith(f"| [{folder.name}]"))
    assert provenance.data_sha256[:12] in row
    assert "MIT" in row
    assert f"--out {folder.name}\n" in (repository / "training" / "README.md").read_text(encoding="utf-8")


@each
def test_a_folder_is_whole(folder):
    files = {path.name for path in folder.iterdir()}
    assert {"README.md", "energy.csv", "energy.png", "errors_over_workspace.png"} <= files
    assert {"model.yaml", "model.safetensors"} <= files
    model = load_model(folder)
    assert model.name == folder.name
    solution = pisigma.load(folder)(model.forward(model.starts[:5]))
    assert bool(torch.isfinite(solution.q).all())


@each
def test_a_card_is_complete(folder):
    text = (folder / "README.md").read_text()
    assert text.startswith(f"# {folder.name}\n")
    headings = {line[3:] for line in text.splitlines() if line.startswith("## ")}
    assert set(SECTIONS) <= headings
    assert f'pisigma.load("models/{folder.name}")' in text
    provenance = load_model(folder).provenance
    for value in (provenance.recipe_sha256, provenance.data_sha256, *provenance.versions.values()):
        assert value in text
    assert joint_table(TrainingSummary.model_validate(load_model(folder).metrics).joints) in text


@each
def test_a_model_comes_from_the_shipped_recipe(folder, repository):
    recipe = repository / "training" / f"{folder.name}.yaml"
    assert recipe.is_file()
    assert load_model(folder).provenance.recipe_sha256 == recipe_hash(recipe)


@each
def test_every_corrected_joint_has_energies(folder):
    head, *rows = csv.reader((folder / "energy.csv").read_text().splitlines())
    joints = [joint["name"] for joint in load_model(folder).metrics["joints"]]
    assert head == ["epoch", *(f"energy_{joint}" for joint in joints)]
    energies = torch.tensor([[float(cell) for cell in row[1:]] for row in rows])
    assert bool(torch.isfinite(energies).all())
    assert bool((energies[-1] <= energies[0]).all())


@each
def test_figures_are_reproduced(folder, repository):
    """Training and held-out figures, computed again from the stored model and the recipe's true robot."""
    recipe = read_recipe(repository / "training" / f"{folder.name}.yaml")
    if not isinstance(recipe.data, SimulatedData):
        pytest.skip("the measured rows are not part of the project")
    model = load_model(folder)
    names = [joint.name for joint in model.robot.joints]
    bound = recipe.singular_rows.below if recipe.singular_rows.rule == "leave_out" else None
    with no_type_checker():
        data = simulate(recipe)
        parts = {
            "training": build_pairs(model.robot, data.training, bound),
            "held_out": build_pairs(model.robot, data.held_out, None),
        }
    for part, pairs in parts.items():
        T, q, before = (
            pairs.T[pairs.used_rows],
            pairs.q_nominal[pairs.used_rows],
            pairs.target[pairs.used_rows],
        )
        after = before - model.correction(T, q)
        for joint in model.metrics["joints"]:
            index = names.index(joint["name"])
            for when, errors in (("before", before), ("after", after)):
                found = AbsoluteJointErrorFigures.from_errors(errors[:, index], model.robot.revolute[index])
                for name, value in joint[part][when].items():
                    assert_close(getattr(found, name), value, rtol=1e-6, atol=1e-9)


def test_the_wheel_of_models_contains_all_of_them(repository, tmp_path):
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    done = subprocess.run(
        [*command, str(repository / "packaging" / "pisigma-models")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("pisigma_models/")}
    files = {path for folder in (*FOLDERS, *MEASURED) for path in folder.iterdir()}
    inside = {f"pisigma_models/{path.relative_to(MODELS).as_posix()}" for path in files}
    assert names == inside | {"pisigma_models/__init__.py", "pisigma_models/README.md"}
