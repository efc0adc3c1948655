"""`pisigma upgrade`."""

import json

from pisigma.model.folder.model_document import FORMAT


def test_what_is_new_already_is_said(run, models):
    result = run("upgrade", models / "kiro3", "--json")
    assert json.loads(result.stdout) == {
        "model": str(models / "kiro3"),
        "name": "hand_made_kiro3",
        "before": FORMAT,
        "after": FORMAT,
        "changes": [],
    }
    assert f"({FORMAT})" in run("upgrade", models / "kiro3").stdout


def test_a_folder_without_a_model_is_refused(refuses, tmp_path):
    refuses("upgrade", tmp_path)
