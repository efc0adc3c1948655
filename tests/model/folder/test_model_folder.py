"""Model folders: what is written is read back, and everything else is refused in one sentence."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from testing.closeness import assert_close
from testing.edited_folders import edit, edit_tensors
from testing.models import HOMES, hand_made_model, joints_around

from pisigma.files.errors import ModelError
from pisigma.files.model_files import check_model_hash
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.inverse.corrected_ik import load
from pisigma.robot.kinematics.forward import forward_kinematics

PROVENANCE = Provenance(
    recipe="test",
    recipe_sha256="ab",
    rows=64,
    rows_left_out=3,
    rule="3 singular",
    seed=5,
    versions={"torch": "2"},
)


@pytest.fixture
def folder(tmp_path) -> Path:
    save_model(
        replace(hand_made_model("kiro3"), provenance=PROVENANCE, metrics={"rows": {"used": 64}}), tmp_path
    )
    return tmp_path


def refused(folder: Path) -> str:
    """The complaint: one sentence that names the folder."""
    with pytest.raises(ModelError) as caught:
        load_model(folder)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.startswith(str(folder))
    assert sentence.endswith((".", "findings)"))
    return sentence.removeprefix(str(folder))


@pytest.mark.parametrize("name", HOMES)
def test_a_model_is_read_back_as_it_was(tmp_path, name):
    model = replace(hand_made_model(name), provenance=PROVENANCE, metrics={"joints": [{"name": "ü"}]})
    save_model(model, tmp_path)
    loaded = load_model(tmp_path)
    T = forward_kinematics(model.robot, joints_around(name, 5))
    assert (loaded.name, loaded.kind, loaded.branches) == (model.name, model.kind, model.branches)
    assert (loaded.provenance, loaded.metrics) == (model.provenance, model.metrics)
    assert_close(loaded.robot.dh, model.robot.dh, atol=1e-15)
    assert torch.equal(loaded.starts, model.starts)
    assert_close(load(tmp_path)(T).q, load(tmp_path).__class__(model)(T).q, atol=1e-13)
    assert not any(parameter.requires_grad for parameter in loaded.network.parameters())


def test_a_model_without_network_is_read_back(tmp_path):
    model = replace(hand_made_model("kiro4"), network=None, domain=None)
    save_model(model, tmp_path)
    loaded = load_model(tmp_path)
    assert loaded.network is None
    assert loaded.domain is None


def test_no_pickle_is_read_or_written(folder):
    names = sorted(entry.name for entry in folder.iterdir())
    assert names == ["compiled.npz", "model.safetensors", "model.yaml"]
    np.load(folder / "compiled.npz", allow_pickle=False).close()
    torch.save({"starts": torch.zeros(1)}, folder / "model.safetensors")
    digest = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    edit(folder, lambda document: document.update(weights_sha256=digest))
    assert "is no safetensors file" in refused(folder)


def test_windows_line_ends_do_not_count_as_edits(folder):
    path = folder / "model.yaml"
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_model(folder).name == "hand_made_kiro3"


def test_missing_folder_and_files(folder):
    with pytest.raises(
        ModelError, match="there is no such model folder; give a folder that `pisigma calibrate` or"
    ):
        load_model(folder / "nothing")
    with pytest.raises(ModelError, match="there is no such model folder"):
        load_model(folder / "model.yaml")
    for name in ("model.yaml", "model.safetensors"):
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        assert f"{name} is missing, so this is no whole model folder" in refused(folder)
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("name", ["model.yaml", "model.safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.97, 0.9999])
def test_truncated_files(folder, name, share):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: int(share * len(content))])
    assert "truncated" in refused(folder)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00\x01\x02",
        b"\xff\xfe\x00",
        b"- a\n- b\n",
        b"name: x\n",
        b"{[}",
        b"a: &a [*a]\n",
        b"[" * 5000,
    ],
)
def test_garbage_in_place_of_the_description(folder, content):
    (folder / "model.yaml").write_bytes(content)
    assert "model.yaml: " in refused(folder)


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b'{"a": 1}', b"\xff" * 64])
def test_garbage_in_place_of_the_weights(folder, content):
    (folder / "model.safetensors").write_bytes(content)
    assert "model.safetensors: is truncated, changed or of another model" in refused(folder)


def test_an_edited_description_is_noticed(folder):
    path = folder / "model.yaml"
    path.write_text(path.read_text().replace("a_mm: 320.0", "a_mm: 321.0", 1))
    assert "was edited" in refused(folder)


def test_weights_of_another_model_are_noticed(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    save_model(hand_made_model("kiro3", scale=0.03), other)
    (folder / "model.safetensors").write_bytes((other / "model.safetensors").read_bytes())
    assert "of another model" in refused(folder)


def test_a_newer_format_asks_for_an_upgrade(folder):
    path = folder / "model.yaml"
    path.write_text(path.read_text().replace("format: 5\n", "format: 6\n", 1))
    assert "model.yaml: format 6 is newer than this pisigma reads (5); upgrade pisigma." in refused(folder)


def test_an_earlier_format_names_the_command_that_upgrades(folder):
    path = folder / "model.yaml"
    document = yaml.load(path.read_text().rsplit("sha256: ", 1)[0], Loader=yaml.CSafeLoader)
    text = yaml.dump(document | {"format": 2}, Dumper=yaml.CSafeDumper, sort_keys=False)
    path.write_text(f"{text}sha256: {hashlib.sha256(text.encode()).hexdigest()}\n")
    said = refused(folder)
    assert (
        f"model.yaml: format 2 is of an earlier version; run `pisigma upgrade {folder}` once to read it."
        in said
    )


def _set(key: str, value):
    return lambda document: document.update({key: value})


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (_set("format", 0), "format"),
        (_set("format", "one"), "format"),
        (_set("colour", "red"), "unknown key 'colour'"),
        (lambda document: document.pop("branches"), "'branches' is missing"),
        (_set("branches", ["elbow_left"]), "has no branch 'elbow_left'"),
        (_set("network", [{"joints": ["theta_1"]}]), "missing"),
        (_set("network", []), "is unknown"),
        (
            lambda document: document["network"][0].update(inputs=["theta_9"]),
            "unknown network input 'theta_9'",
        ),
        (lambda document: document["network"][0].update(joints=["theta_9"] * 4), "corrects joint 'theta_9'"),
        (lambda document: document["network"][0].update(orders=[0]), "orders"),
        (lambda document: document["network"][0].update(orders=[1, 1]), "of shape"),
        (lambda document: document["network"][0].update(joints=["theta_1"] * 4), "two groups"),
        (lambda document: document["robot"]["rows"][0].update(a_mm=float("nan")), "finite"),
        (lambda document: document["robot"]["rows"][0].update(alpha_deg=3.0), "no closed-form inverse"),
        (lambda document: document["robot"]["rows"].pop(), "do not fit"),
        (lambda document: document["robot"]["rows"][1].update(name="theta_1"), "stands twice"),
    ],
)
def test_descriptions_that_do_not_fit(folder, change, complaint):
    edit(folder, change)
    assert complaint in refused(folder)


def _replace(name: str, value: torch.Tensor):
    return lambda tensors: tensors.update({name: value})


WEIGHT = "network.networks.0.weight"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda tensors: tensors.pop(WEIGHT), f"the tensor '{WEIGHT}' is missing"),
        (lambda tensors: tensors.pop("starts"), "the tensor 'starts' is missing"),
        (lambda tensors: tensors.pop("domain.radius"), "the tensor 'domain.radius' is missing"),
        (_replace("extra", torch.zeros(1)), "the tensor 'extra' is unknown"),
        (
            _replace("starts", torch.zeros(4, 6, dtype=torch.float64)),
            r"'starts' of shape (any, 4) was wanted, got (4, 6)",
        ),
        (_replace("starts", torch.zeros(4, 4)), "'starts' in float64 was wanted, got torch.float32"),
        (_replace("domain.samples", torch.zeros(5, 2, dtype=torch.float64)), "'domain.samples' of shape"),
        (_replace("domain.radius", torch.zeros((), dtype=torch.float64)), "radius above 0"),
        (_replace("domain.samples", torch.zeros(0, 6, dtype=torch.float64)), "needs a sample"),
        (lambda tensors: tensors[WEIGHT].view(-1)[3:4].fill_(torch.nan), "not finite"),
        (lambda tensors: tensors["domain.radius"].fill_(torch.inf), "not finite"),
        (lambda tensors: tensors["starts"][0].fill_(torch.nan), "not finite"),
    ],
)
def test_tensors_that_do_not_fit(folder, change, complaint):
    edit_tensors(folder, change)
    assert complaint in refused(folder)


def test_an_unchanged_model_survives_the_editing_of_these_tests(folder):
    edit_tensors(folder, lambda tensors: None)
    assert isinstance(load_model(folder), CalibratedModel)


@pytest.mark.parametrize("orders", [[10**8], [100] * 1000, [1] * 2_000])
def test_more_weights_than_the_file_holds_are_not_allocated(folder, orders):
    edit(folder, lambda document: document["network"][0].update(orders=orders))
    assert any(word in refused(folder) for word in ("orders", "calls for"))


def test_a_description_that_grows_when_it_is_read_is_refused(folder):
    text = (folder / "model.yaml").read_text()
    body, texts = text[: text.index("\nmetrics:") + 1], ", ".join(["*a"] * 10_000)
    body += f"metrics: {{text: &a {'x' * 40_000}, texts: [{texts}]}}\n"
    (folder / "model.yaml").write_text(f"{body}sha256: {hashlib.sha256(body.encode()).hexdigest()}\n")
    assert "values with its aliases written out" in refused(folder)


@pytest.mark.parametrize("name", ["model.yaml", "model.safetensors", "compiled.npz"])
def test_pipes_and_endless_files_are_no_part_of_a_model(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    if name != "compiled.npz":
        assert "no regular file" in refused(folder)
    assert "compiled" not in vars(load(folder)) if name == "compiled.npz" else True
    (folder / name).unlink()
    with (folder / name).open("wb") as file:
        file.truncate(20 * 2**30)  # sparse
    if name == "compiled.npz":
        assert "compiled" not in vars(load(folder))
    else:
        assert "MB, which no file of its kind has" in refused(folder)


def test_arrays_for_the_kernels_are_those_that_the_description_states(folder, tmp_path_factory):
    """An exchanged file is not used, though it is a whole one by itself."""
    assert "compiled" in vars(load(folder))
    other = tmp_path_factory.mktemp("other")
    save_model(hand_made_model("kiro3", scale=0.03), other)
    (folder / "compiled.npz").write_bytes((other / "compiled.npz").read_bytes())
    assert "compiled" not in vars(load(folder))


def test_another_model_than_the_one_that_is_meant_is_refused(folder):
    sha256 = hashlib.sha256((folder / "model.yaml").read_bytes()).hexdigest()
    check_model_hash(folder, sha256)
    check_model_hash(folder, sha256.upper() + "\n")
    with pytest.raises(
        ModelError, match=f"SHA-256 00ab was wanted, but it is {sha256}; this is another model"
    ):
        check_model_hash(folder, "00ab")


@pytest.mark.parametrize("name", ["1e3", "no", "010", "1:30", "=", "~", "a: b"])
def test_names_that_look_like_something_else_come_back(tmp_path, name):
    model = hand_made_model("kiro3")
    save_model(replace(model, bases={name: np.zeros(6)}), tmp_path)
    assert list(load_model(tmp_path).bases) == [name]
