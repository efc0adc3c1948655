"""Model folders are read back as they were written; damaged and foreign ones are refused."""

import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from testing.closeness import assert_close
from testing.edited_folders import edit, edit_tensors
from testing.models import HOMES, hand_made_model, joints_around
from testing.refusals import refused

from pisigma.files.errors import ModelError
from pisigma.files.model_files import check_model_hash
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.inverse.loading import load
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


WEIGHT = "network.networks.0.weight"


@pytest.fixture
def folder(tmp_path) -> Path:
    save_model(
        replace(hand_made_model("kiro3"), provenance=PROVENANCE, metrics={"rows": {"used": 64}}), tmp_path
    )
    return tmp_path


def hash_of(weights: bytes) -> str:
    """What the description of a folder expects of its weights."""
    return f"the SHA-256 {hashlib.sha256(weights).hexdigest()}"


def refuses(folder: Path, name: str | None = None, **fields: Any) -> ModelError:
    """Assert that a folder is refused in one line, with a file and other fields; gives the exception."""
    with refused(ModelError, **fields) as caught:
        load_model(folder)
    assert "\n" not in str(caught.value)
    assert str(folder if name is None else folder / name) in str(caught.value)
    return caught.value


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
    refuses(folder, "model.safetensors", expected="a safetensors file")


def test_windows_line_endings_are_not_edits(folder):
    path = folder / "model.yaml"
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_model(folder).name == "hand_made_kiro3"


def test_missing_folder_and_files(folder):
    for path in (folder / "nothing", folder / "model.yaml"):
        refuses(path, value=None)
    for name in ("model.yaml", "model.safetensors"):
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        refuses(folder, value=name)
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("name", ["model.yaml", "model.safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.97, 0.9999])
def test_truncated_files(folder, name, share):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: int(share * len(content))])
    refuses(folder, name, expected="a checksum" if name == "model.yaml" else hash_of(content))


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
    refuses(folder, "model.yaml")


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b'{"a": 1}', b"\xff" * 64])
def test_garbage_in_place_of_the_weights(folder, content):
    expected = hash_of((folder / "model.safetensors").read_bytes())
    (folder / "model.safetensors").write_bytes(content)
    refuses(folder, "model.safetensors", expected=expected)


def test_an_edited_description_is_refused(folder):
    path = folder / "model.yaml"
    path.write_text(path.read_text().replace("a_mm: 320.0", "a_mm: 321.0", 1))
    refuses(folder, "model.yaml", expected="a checksum")


def test_weights_of_another_model_are_refused(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    save_model(hand_made_model("kiro3", scale=0.03), other)
    expected = hash_of((folder / "model.safetensors").read_bytes())
    (folder / "model.safetensors").write_bytes((other / "model.safetensors").read_bytes())
    refuses(folder, "model.safetensors", expected=expected)


def test_a_newer_format_is_refused(folder):
    path = folder / "model.yaml"
    path.write_text(path.read_text().replace("format: 5\n", "format: 6\n", 1))
    refuses(folder, "model.yaml", column="format", value=6)


def test_an_earlier_format_names_the_command_that_upgrades(folder):
    path = folder / "model.yaml"
    document = yaml.load(path.read_text().rsplit("sha256: ", 1)[0], Loader=yaml.CSafeLoader)
    text = yaml.dump(document | {"format": 2}, Dumper=yaml.CSafeDumper, sort_keys=False)
    path.write_text(f"{text}sha256: {hashlib.sha256(text.encode()).hexdigest()}\n")
    problem = refuses(folder, "model.yaml", column="format", value=2)
    assert f"`pisigma upgrade {folder}`" in problem.remedy


def _set(key: str, value):
    return lambda document: document.update({key: value})


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (_set("format", 0), "format"),
        (_set("format", "one"), "format"),
        (_set("colour", "red"), "colour"),
        (lambda document: document.pop("branches"), "branches"),
        (_set("branches", ["elbow_left"]), "elbow_left"),
        (_set("network", [{"joints": ["theta_1"]}]), "inputs"),
        (_set("network", []), "domain.radius"),
        (lambda document: document["network"][0].update(inputs=["theta_9"]), "theta_9"),
        (lambda document: document["network"][0].update(joints=["theta_9"] * 4), "theta_9"),
        (lambda document: document["network"][0].update(orders=[0]), "orders"),
        (lambda document: document["network"][0].update(orders=[1, 1]), WEIGHT),
        (lambda document: document["network"][0].update(joints=["theta_1"] * 4), "[0, 0, 0, 0]"),
        (lambda document: document["robot"]["rows"][0].update(a_mm=float("nan")), "a_mm"),
        (lambda document: document["robot"]["rows"][0].update(alpha_deg=3.0), "elbow_positive"),
        (lambda document: document["robot"]["rows"].pop(), "elbow_positive"),
        (lambda document: document["robot"]["rows"][1].update(name="theta_1"), "theta_1"),
    ],
)
def test_descriptions_that_do_not_fit(folder, change, named):
    """Each of the messages names the key, joint, branch or tensor at fault."""
    edit(folder, change)
    with pytest.raises(ModelError, match=re.escape(named)):
        load_model(folder)


def _replace(name: str, value: torch.Tensor):
    return lambda tensors: tensors.update({name: value})


@pytest.mark.parametrize(
    ("change", "value"),
    [
        (lambda tensors: tensors.pop(WEIGHT), WEIGHT),
        (lambda tensors: tensors.pop("starts"), "starts"),
        (lambda tensors: tensors.pop("domain.radius"), "domain.radius"),
        (_replace("extra", torch.zeros(1)), "extra"),
        (_replace("starts", torch.zeros(4, 6, dtype=torch.float64)), (4, 6)),
        (_replace("starts", torch.zeros(4, 4)), torch.float32),
        (_replace("domain.samples", torch.zeros(5, 2, dtype=torch.float64)), (5, 2)),
        (lambda tensors: tensors[WEIGHT].view(-1)[3:4].fill_(torch.nan), WEIGHT),
        (lambda tensors: tensors["domain.radius"].fill_(torch.inf), "domain.radius"),
        (lambda tensors: tensors["starts"][0].fill_(torch.nan), "starts"),
    ],
)
def test_tensors_that_do_not_fit(folder, change, value):
    edit_tensors(folder, change)
    refuses(folder, "model.safetensors", value=value)


@pytest.mark.parametrize(("rows", "radius"), [(5, 0.0), (0, 1.0)])
def test_domains_without_extent_are_refused(folder, rows, radius):
    values = {"domain.samples": torch.zeros(rows, 6), "domain.radius": torch.tensor(radius)}
    edit_tensors(
        folder, lambda tensors: tensors.update({key: value.double() for key, value in values.items()})
    )
    with pytest.raises(ModelError, match=f"{rows} samples and radius {radius:g}"):
        load_model(folder)


def test_an_unchanged_model_survives_the_editing_of_these_tests(folder):
    edit_tensors(folder, lambda tensors: None)
    assert isinstance(load_model(folder), CalibratedModel)


@pytest.mark.parametrize("orders", [[10**8], [100] * 1000, [1] * 2_000])
def test_more_weights_than_the_file_holds_are_not_allocated(folder, orders):
    edit(folder, lambda document: document["network"][0].update(orders=orders))
    assert "orders" in str(refuses(folder, "model.yaml"))


def test_a_description_that_grows_when_it_is_read_is_refused(folder):
    text = (folder / "model.yaml").read_text()
    body, texts = text[: text.index("\nmetrics:") + 1], ", ".join(["*a"] * 10_000)
    body += f"metrics: {{text: &a {'x' * 40_000}, texts: [{texts}]}}\n"
    (folder / "model.yaml").write_text(f"{body}sha256: {hashlib.sha256(body.encode()).hexdigest()}\n")
    refuses(folder, "model.yaml")


@pytest.mark.parametrize("name", ["model.yaml", "model.safetensors", "compiled.npz"])
def test_pipes_and_endless_files_are_refused(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    if name != "compiled.npz":
        refuses(folder, name)
    assert "compiled" not in vars(load(folder)) if name == "compiled.npz" else True
    (folder / name).unlink()
    with (folder / name).open("wb") as file:
        file.truncate(20 * 2**30)  # sparse
    if name == "compiled.npz":
        assert "compiled" not in vars(load(folder))
    else:
        refuses(folder, name)


def test_arrays_for_the_kernels_are_those_that_the_description_states(folder, tmp_path_factory):
    """A file of another model is not used, though it is intact."""
    assert "compiled" in vars(load(folder))
    other = tmp_path_factory.mktemp("other")
    save_model(hand_made_model("kiro3", scale=0.03), other)
    (folder / "compiled.npz").write_bytes((other / "compiled.npz").read_bytes())
    assert "compiled" not in vars(load(folder))


def test_a_model_with_another_hash_is_refused(folder):
    sha256 = hashlib.sha256((folder / "model.yaml").read_bytes()).hexdigest()
    check_model_hash(folder, sha256)
    check_model_hash(folder, sha256.upper() + "\n")
    with pytest.raises(ModelError, match=sha256):
        check_model_hash(folder, "00ab")


@pytest.mark.parametrize("name", ["1e3", "no", "010", "1:30", "=", "~", "a: b"])
def test_names_that_look_like_other_yaml_types_are_kept(tmp_path, name):
    model = hand_made_model("kiro3")
    save_model(replace(model, bases={name: np.zeros(6)}), tmp_path)
    assert list(load_model(tmp_path).bases) == [name]
