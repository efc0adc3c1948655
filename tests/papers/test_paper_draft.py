"""The figures of the paper draft are those of the stored results and of the models."""

import json
import re

import yaml
from testing.closeness import assert_close

FOLDERS = {
    "landgraf2021": "ur10_landgraf",
    "jacobi2025": "ur5_jacobi",
    "burakov2020": "fanuc_burakov",
    "platonics2024": "panda_platonics",
}


def test_the_figures_of_the_draft_are_stored(repository):
    text = (repository / "paper" / "paper.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|]+\[@(\w+)\] \| (\d+) \| (\S+) \| (\S+) \| (\S+) \|$", text, re.MULTILINE)
    assert {key for key, *_ in rows} == set(FOLDERS)
    for key, count, *errors in rows:
        model = yaml.safe_load(
            (repository / "models" / FOLDERS[key] / "model.yaml").read_text(encoding="utf-8")
        )
        assert int(count) == model["provenance"]["rows"]
        for name, error in zip(("nominal", "geometric", "hybrid"), errors, strict=True):
            assert_close(float(error), model["metrics"]["cross_validation"][name]["rms_mm"], atol=5e-4)
    stored = json.loads(
        (repository / "training" / "results" / "ur10_hybrid.json").read_text(encoding="utf-8")
    )
    (few,) = (one for one in stored["learning_curve"] if one["rows"] == 100)
    stated = re.search(r"With 100 rows of the UR10 [^\d]+(\d\.\d+) mm [^\d]+(\d\.\d+) mm", text)
    for name, error in zip(("hybrid", "geometric"), stated.groups(), strict=True):
        assert_close(float(error), few[name]["rms_mm"], atol=5e-4)
    share = float(re.search(r"UR10, (\d+\.\d) % are inside", text)[1])
    assert_close(share / 100, stored["cross_validation"]["coverage"], atol=5e-4)


def test_every_citation_has_an_entry(repository):
    text = (repository / "paper" / "paper.md").read_text(encoding="utf-8")
    entries = re.findall(
        r"^@\w+\{(\w+),", (repository / "paper" / "paper.bib").read_text("utf-8"), re.MULTILINE
    )
    assert set(re.findall(r"\[-?@(\w+)\]", text)) == set(entries)
