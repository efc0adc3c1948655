"""`pisigma new --from`, `pisigma fleet run` and `pisigma fleet status`."""

import json

import pytest
from testing.aged import original_model, rows_after_change
from testing.models import REPOSITORY
from testing.screens import assert_screen

from pisigma.files.errors import FleetError, PlanningError

pytest.importorskip("pyarrow", reason="Parquet comes with the extra fleet")


@pytest.fixture(scope="module")
def plant(tmp_path_factory, run):
    """Cells of two robots, of which one has a bad file, that a process has advanced."""
    folder = tmp_path_factory.mktemp("plant")
    for name in ("cell1", "cell2"):
        (folder / "in" / name).mkdir(parents=True)
    rows_after_change(30, 1).write_csv(folder / "in" / "cell1" / "2026-10-01.csv", original_model().robot)
    (folder / "in" / "cell2" / "2026-10-02.csv").write_text("<b>\n1\n", encoding="utf-8")
    made = run("new", "rb5", "--from", folder / "in", "--out", folder / "cells", "--json")
    assert made.exit_code == 0, made.output
    for name in ("cell1", "cell2"):
        with (folder / "cells" / name / "cell.yaml").open("a") as file:
            file.write("  model: geometric\n")
    return folder, json.loads(made.stdout), run("fleet", "run", folder / "cells", "--jobs", "1", "--json")


def test_a_cell_is_created_for_every_robot(plant):
    folder, made, _ = plant
    assert made["cells"] == [str(folder / "cells" / name) for name in ("cell1", "cell2")]
    assert (made["created"], made["sessions"], made["refused"]) == (2, 2, [])


def test_run_ends_with_3_where_a_cell_needs_attention(plant):
    folder, _, done = plant
    assert done.exit_code == 3, done.output
    report = json.loads(done.stdout)
    assert (report["cells"], report["done"], report["unchanged"]) == (2, 1, 0)
    assert report["results"] == str(folder / "cells" / "results.parquet")
    assert [one["cell"] for one in report["refused"]] == ["cell2"]
    assert "line 1" in report["refused"][0]["reason"]


def test_status_prints_and_writes_a_page(plant, run):
    folder, *_ = plant
    page = folder / "page.html"
    shown = run("fleet", "status", folder / "cells", "--page", page)
    assert shown.exit_code == 3, shown.output
    assert_screen(shown.stdout, "1 file_refused", "cell2: ", "not_verified")
    text = page.read_text(encoding="utf-8")
    assert '<span class="badge bad">file refused</span>' in text
    assert "<b>" not in text
    assert 'src="http' not in text
    of_folder = run("status", folder / "cells", "--json")
    assert of_folder.exit_code == 0
    assert json.loads(of_folder.stdout) == json.loads(
        run("fleet", "status", folder / "cells", "--json").stdout
    )
    assert run("status", folder / "cells", "--exit-code").exit_code == 3


def test_what_is_not_a_fleet_is_refused(refuses, tmp_path):
    for arguments, error, fields in (
        (("fleet", "status", tmp_path), PlanningError, {}),
        (("fleet", "run", tmp_path), PlanningError, {}),
        (("fleet", "run", tmp_path, "--jobs", "0"), FleetError, {"value": 0}),
        (("new", "--from", tmp_path, "--out", tmp_path / "cells"), FleetError, {"value": "no robot"}),
    ):
        refuses(*arguments, error=error, **fields)


def test_a_cell_is_created_from_a_model_folder(run, tmp_path):
    made = run("new", "--from", REPOSITORY / "models" / "kiro4", "--out", tmp_path / "cell", "--json")
    assert made.exit_code == 0, made.output
    assert json.loads(made.stdout)["model"] == "kiro4"
    for arguments in (("kiro4", "--from", REPOSITORY / "models" / "kiro4"), ()):
        assert run("new", *arguments, "--out", tmp_path / "other").exit_code == 2
