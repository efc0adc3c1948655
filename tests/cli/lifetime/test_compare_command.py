"""`pisigma compare`."""

import json

import pytest
from testing.aged import rows_after_change
from testing.compared import COLLISION, model_of
from testing.screens import assert_screen

from pisigma.files.errors import IdentificationError, ModelError, OutputError
from pisigma.model.folder.model_folder import save_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the models before and after a collision, new rows and poses of a program."""
    folder = tmp_path_factory.mktemp("compare")
    for name, model in (("before", model_of(50)), ("after", model_of(61, COLLISION))):
        (folder / name).mkdir()
        save_model(model, folder / name)
    rows_after_change(20, 70).write_csv(folder / "rows.csv", model_of(50).robot)
    poses = "x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n400,100,400,0,180,0\n450,120,400,10,180,0\n"
    (folder / "poses.csv").write_text(poses)
    return folder


def test_differences_are_printed_and_shown_on_a_page(run, folder):
    page = folder / "page.html"
    done = run(
        *("compare", folder / "before", folder / "after", "--rows", folder / "rows.csv"),
        *("--program", folder / "poses.csv", "--page", page),
    )
    assert done.exit_code == 0, done.output
    assert_screen(done.stdout, "joint 3 by 0.", "before predicts", heading="Difference")
    text = page.read_text(encoding="utf-8")
    assert "joint 3 by 0." in text
    assert "along poses.csv" in text
    assert 'src="http' not in text


def test_a_model_is_compared_with_the_nominal_robot(run, folder):
    done = run("compare", folder / "before", "nominal", "--program", folder / "poses.csv", "--json")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert [one["name"] for one in report["models"]] == ["before", "nominal"]
    assert (report["program"]["poses"], report["program"]["poses_not_predicted"]) == (2, 0)
    assert report["differs"]


def test_inputs_at_fault_are_refused(refuses, folder):
    both = ("compare", folder / "before", folder / "after")
    refuses("compare", folder / "before", folder / "before", error=ModelError)
    refuses(*both, "--page", folder / "page.pdf", error=OutputError, file="page.pdf", value=".pdf")
    refuses(*both, "--set", "level=2", error=IdentificationError, value=2.0)
