"""Folders of earlier versions are upgraded as a whole or not at all."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from testing.identified import hybrid_model
from testing.models import hand_made_model
from testing.refusals import numbers_in, refused
from testing.report import hybrid_under_test

from pisigma.files.errors import ModelError, OutputError
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_document import FORMAT
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.folder.upgrade import Upgrade, upgrade_folder
from pisigma.model.inverse.written_model import check_written
from pisigma.robot import Robot
from pisigma.validation.held_out.calibration_summary import CalibrationSummary

pytestmark = pytest.mark.usefixtures("without_type_checker")

OLD = {
    "weak_directions": "unseen",
    "effective_parameters": "told_by_the_data",
    "repeats": "dealings",
    "rms_mm_of_repeats": "rms_mm_of_dealings",
    "prior_scale": "variance_widening",
    "warnings": "warnings",
}

OLD_REMARKS = {
    "no effect": "without effect on what was measured",
    "outliers": "too few rows that count show it, the others are outliers",
    "in a sum": "theta_2 + theta_3 is identified, the single values are not",
    "in a sum; prior": "theta_2 + theta_3 is identified, the single values are not; the data hardly determine it",
}
"""Remarks of the earlier version on parameters, which had no labels, by their label."""

CARD = "Kept; beyond the measured joint values {}."


def old(values: Any, names: dict[str, str] = OLD) -> Any:
    """Return the values with the keys of the earlier version."""
    if isinstance(values, dict):
        if values.get("label") in OLD_REMARKS:
            values = values | {"remark": OLD_REMARKS[values["label"]]}
        return {names.get(key, key): old(value, names) for key, value in values.items() if key != "label"}
    return [old(value, names) for value in values] if isinstance(values, list) else values


def without_remarks(metrics: dict[str, Any]) -> dict[str, Any]:
    """Return the metrics with the labels of the parameters, but without their remarks."""
    rows = [{key: value for key, value in row.items() if key != "remark"} for row in metrics["parameters"]]
    return metrics | {"parameters": rows}


def unknowns_before(uncertainty: dict[str, Any]) -> list[str]:
    """Convert the unknowns of the root to formats up to 4; returns the features, whose order those did not state."""
    groups = {group.pop("name"): group for group in uncertainty.pop("unknowns")}
    for name in ("socket", "anchor"):
        uncertainty[f"{name}s"] = groups.pop(name, {"owners": []})["owners"]
    uncertainty["others"] = groups
    return uncertainty.pop("features")


def write_old(model: CalibratedModel, folder: Path, turns: Sequence[int] = ()) -> dict[str, bytes]:
    """Write a model folder as the earlier version did, with the factors `turns` of product units; returns its files."""
    folder.mkdir()
    save_model(model, folder)
    path = folder / "model.yaml"
    document = yaml.load(path.read_text().rsplit("sha256: ", 1)[0], Loader=yaml.CSafeLoader)
    document["metrics"] = old(document["metrics"])
    if "uncertainty" in document:
        document["uncertainty"] = old(document["uncertainty"], {"prior_scale": "widening"})
        document["uncertainty"]["unexplained_m"] = 1e-4
        unknowns_before(document["uncertainty"])
        document["uncertainty"]["turns"] = list(turns)
    if "learned" in document:
        document["learned"]["fade_rad"] = 0.17
        for feature in document["learned"]["features"]:
            feature.pop("measured", None)
        document["metrics"]["hybrid"]["learned"]["fades_over_deg"] = 10.0
    text = yaml.dump(
        document | {"format": 2 if "uncertainty" in document else 1}, Dumper=yaml.CSafeDumper, sort_keys=False
    )
    path.write_text(f"{text}sha256: {hashlib.sha256(text.encode()).hexdigest()}\n")
    (folder / "compiled.npz").write_bytes(b"of the earlier version")
    (folder / "README.md").write_text(CARD.format("the correction fades to nothing over 10 deg"))
    return {entry.name: entry.read_bytes() for entry in folder.iterdir()}


def test_a_hybrid_calibration_comes_back_with_all_figures(tmp_path):
    _, model = hybrid_under_test()
    files = write_old(model, tmp_path / "arm")
    with refused(ModelError, file="model.yaml", column="format", value=2):
        load_model(tmp_path / "arm")
    done = upgrade_folder(tmp_path / "arm", check_written)
    assert (done.name, done.format_before, done.format_after) == ("arm", 2, 5)
    assert numbers_in(done.changes[0]) == [3]  # the last format whose correction faded
    upgraded = load_model(tmp_path / "arm")
    assert without_remarks(upgraded.metrics) == without_remarks(model.metrics)
    kept = replace(model, metrics=model.metrics | {"parameters": upgraded.metrics["parameters"]})
    assert CalibrationSummary.read(upgraded) == CalibrationSummary.read(kept)
    assert upgraded.uncertainty.variance_factor == model.uncertainty.variance_factor
    assert (tmp_path / "arm" / "model.safetensors").read_bytes() == files["model.safetensors"]
    assert (tmp_path / "arm" / "README.md").read_text() == CARD.format("the correction is an extrapolation")
    assert (tmp_path / "arm" / "compiled.npz").read_bytes() != files["compiled.npz"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["arm"]
    before = (tmp_path / "arm" / "model.yaml").read_bytes()
    assert upgrade_folder(tmp_path / "arm", check_written) == Upgrade("arm", 5, 5)
    assert (tmp_path / "arm" / "model.yaml").read_bytes() == before


def test_other_files_in_a_folder_are_kept(tmp_path):
    _, model = hybrid_under_test()
    write_old(model, tmp_path / "arm")
    (tmp_path / "arm" / "notes.txt").write_text("mine")
    (tmp_path / "arm" / ".git").mkdir()
    with pytest.raises(OutputError, match=r"\.git"):
        upgrade_folder(tmp_path / "arm", check_written)
    (tmp_path / "arm" / ".git").rmdir()
    upgrade_folder(tmp_path / "arm", check_written)
    assert (tmp_path / "arm" / "notes.txt").read_text() == "mine"


def test_kernels_of_another_version_are_written_again(tmp_path):
    """The folder becomes the one that this version writes, byte for byte."""
    folder = tmp_path / "m"
    folder.mkdir()
    save_model(hand_made_model("kiro4"), folder)
    written = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert not upgrade_folder(folder, check_written).changes
    (folder / "compiled.npz").write_bytes(b"of another version")
    done = upgrade_folder(folder, check_written)
    assert (done.format_before, done.format_after, len(done.changes)) == (FORMAT, FORMAT, 1)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == written


def test_product_units_of_an_earlier_version_are_refused_and_nothing_is_changed(tmp_path):
    _, model = hybrid_under_test()
    files = write_old(model, tmp_path / "arm", turns=(11,))
    with refused(ModelError, expected="a joint correction without product units"):
        upgrade_folder(tmp_path / "arm", check_written)
    assert {entry.name: entry.read_bytes() for entry in (tmp_path / "arm").iterdir()} == files


def test_measured_conditions_are_about_the_mean_where_a_folder_does_not_say(tmp_path):
    robot = Robot.load("kiro4")
    names = ("payload_kg", "temperature_c")
    learned = ConditionFeatures(robot, names, (2.0, 20.0), (1.0, 3.0), ((0.0, 4.0), (15.0, 26.0)))
    model = replace(hybrid_model("kiro4", [learned]), metrics={"parameters": [], "hybrid": {"learned": {}}})
    write_old(model, tmp_path / "arm")
    done = upgrade_folder(tmp_path / "arm", check_written)
    assert numbers_in(done.changes[1]) == [0, 5, 11, 29]
    features = load_model(tmp_path / "arm").hybrid.correction.features
    assert features[0].measured == ((0.0, 5.0), (11.0, 29.0))


def test_figures_of_other_kinds_change_their_form(tmp_path):
    network = hand_made_model("kiro3")
    names = ("mean", "rms", "max")
    flat = {f"{part}_{name}_deg": 1.0 for part in ("correction", "error") for name in names}
    metrics = {"doubts": ["so"], "gives_up": ["much"], "joints": [{"name": "theta_1", "unit": "deg", **flat}]}
    write_old(replace(network, kind="distilled", metrics=metrics), tmp_path / "small")
    upgrade_folder(tmp_path / "small", check_written)
    figures = dict.fromkeys(names, 1.0)
    assert load_model(tmp_path / "small").metrics == {
        "warnings": ["so"],
        "limitations": ["much"],
        "joints": [{"name": "theta_1", "unit": "deg", "correction": figures, "error": figures}],
    }
    write_old(replace(network, metrics={"joints": [{"name": "theta_1"}]}), tmp_path / "net")
    assert upgrade_folder(tmp_path / "net", check_written) == Upgrade("hand_made_kiro3", 1, 5)
    assert load_model(tmp_path / "net").metrics == {"joints": [{"name": "theta_1"}]}


def test_a_folder_that_cannot_be_loaded_remains_unchanged(tmp_path):
    files = write_old(hand_made_model("kiro3"), tmp_path / "arm")
    (tmp_path / "arm" / "model.safetensors").write_bytes(files["model.safetensors"][:-8])
    with refused(ModelError, file="model.safetensors"):
        upgrade_folder(tmp_path / "arm", check_written)
    assert (tmp_path / "arm" / "model.yaml").read_bytes() == files["model.yaml"]
    (tmp_path / "arm" / "model.yaml").write_bytes(files["model.yaml"][:-80])
    with refused(ModelError, file="model.yaml", expected="a checksum"):
        upgrade_folder(tmp_path / "arm", check_written)
    assert [entry.name for entry in tmp_path.iterdir()] == ["arm"]


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(ModelError, match=r"model\.yaml"):
        upgrade_folder(tmp_path, check_written)
