"""Model cards: sections and figures."""

import pytest
from PIL import Image
from testing.models import no_type_checker, trained_run
from testing.simulated_arm import simulate

from pisigma.files.model_files import CARD, CORRELATION_PNG, HELD_OUT_PNG, RESIDUALS_PNG
from pisigma.reporting.cards import CardTexts, write_training_card
from pisigma.reporting.tables import joint_table
from pisigma.validation.held_out.training_summary import summarise_training
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

SECTIONS = ("Data", "Joint errors", "Figures", "Domain", "Not validated", "Use", "Provenance")


@pytest.fixture(scope="module", params=["kiro3", "kiro4"])
def card(request, tmp_path_factory):
    """Recipe, run, report, folder and text of a card."""
    recipe, run = trained_run(request.param)
    command = f"pisigma train training/{request.param}.yaml"
    report = summarise_training(run, recipe.paper).model_copy(update={"command": command})
    folder = tmp_path_factory.mktemp("card")
    texts = CardTexts(recipe.description, recipe.not_validated)
    write_training_card(recipe.name, texts, run, report, folder)
    return recipe, run, report, folder, (folder / CARD).read_text()


def test_sections_and_pictures_are_there(card):
    recipe, _, _, folder, text = card
    assert text.startswith(f"# {recipe.name}\n\n{recipe.description.strip()}\n")
    assert [line[3:] for line in text.splitlines() if line.startswith("## ")] == list(SECTIONS)
    for name in ("energy.csv", "energy.png", "errors_over_workspace.png"):
        assert f"]({name})" in text
        assert (folder / name).stat().st_size > 0
    assert recipe.not_validated.strip() in text


def test_the_table_is_that_of_the_report(card):
    _, run, report, _, text = card
    assert joint_table(report.joints) in text
    assert len(report.joints) == len(run.history.joints)
    assert f"Trained on {run.model.provenance.rows} simulated rows, none left out." in text
    assert "Judged on 200 other simulated rows (held-out)." in text


def test_domain_names_inputs_and_branches(card):
    _, run, _, _, text = card
    for name in (*run.model.branches, *run.model.network.groups[0].inputs.names):
        assert f"`{name}`" in text


def test_provenance_is_complete(card):
    _, run, _, _, text = card
    provenance = run.model.provenance
    assert provenance.data_sha256 in text
    for name, version in provenance.versions.items():
        assert f"{name} {version}" in text


def test_the_figures_of_a_calibration_are_drawn(tmp_path):
    arm = simulate("ur5", rows=40, noise=5e-5)
    with no_type_checker():
        calibrate("ur5", arm.measurements, CalibrationSettings(model="geometric", folds=2, repeats=1)).save(
            tmp_path / "arm"
        )
    for name in (CORRELATION_PNG, RESIDUALS_PNG, HELD_OUT_PNG):
        with Image.open(tmp_path / "arm" / name) as image:
            assert min(image.size) > 300
        assert f"]({name})" in (tmp_path / "arm" / CARD).read_text()
