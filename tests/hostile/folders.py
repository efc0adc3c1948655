"""Hostile model folders: files that are missing, damaged, exchanged, special or consistently changed."""

import hashlib
import os
import shutil
from pathlib import Path

import yaml
from hostile.case import Case, Rng, one_of
from hostile.clean import Clean
from hostile.damage import damaged
from hostile.documents import mutated, written

FILES = ("model.yaml", "model.safetensors", "compiled.npz")


def wrong_model(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a wrong model folder, for any command that reads one."""
    models = list(clean.models)
    source = one_of(rng, models)
    model = folder / "model"
    shutil.copytree(source, model)
    file, change = model / one_of(rng, FILES), one_of(rng, _CHANGES)
    change(rng, file, one_of(rng, models))
    commands = (
        ("ik", "model", "--pose", "300", "200", "400", "0", "0", "0"),
        ("evaluate", "model", str(clean.models[source]), "--set", "resamples=20"),
        ("verify", "model", str(clean.models[source])),
        ("export", "model", "--format", "offsets", "--poses", str(clean.poses), "--out", "offsets.csv"),
        ("export", "model", "--format", "dh", "--out", "dh.csv"),
    )
    what = f"{source.name}, {file.name}: {change.__name__.strip('_').replace('_', ' ')}"
    return Case(what, one_of(rng, commands))


def _missing(rng: Rng, file: Path, other: Path) -> None:
    file.unlink()


def _damaged(rng: Rng, file: Path, other: Path) -> None:
    file.write_bytes(damaged(rng, file.read_bytes())[1])


def _of_another_model(rng: Rng, file: Path, other: Path) -> None:
    shutil.copy(other / file.name, file)


def _a_folder(rng: Rng, file: Path, other: Path) -> None:
    file.unlink()
    file.mkdir()


def _a_pipe(rng: Rng, file: Path, other: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _of_20_gigabytes(rng: Rng, file: Path, other: Path) -> None:
    os.truncate(file, 20 * 10**9)


def _a_dangling_link(rng: Rng, file: Path, other: Path) -> None:
    file.unlink()
    file.symlink_to(one_of(rng, ("nowhere", "/dev/zero", "model.yaml", "/etc/passwd")))


def _another_document(rng: Rng, file: Path, other: Path) -> None:
    description = file.parent / "model.yaml"
    description.write_bytes(written(rng, description)[1])


def _signed_again(rng: Rng, file: Path, other: Path) -> None:
    """Change the weights with a matching hash, or the description."""
    weights, description = file.parent / "model.safetensors", file.parent / "model.yaml"
    document = yaml.load(description.read_bytes(), Loader=yaml.CSafeLoader)
    if rng.random() < 0.5:
        weights.write_bytes(damaged(rng, weights.read_bytes())[1])
    if rng.random() < 0.7:
        _, document = mutated(rng, document)
    document["weights_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
    description.write_text(yaml.dump(document, Dumper=yaml.CSafeDumper, sort_keys=False), encoding="utf-8")


def _with_more_files(rng: Rng, file: Path, other: Path) -> None:
    (file.parent / "notes\n.txt").write_text("mine", encoding="utf-8")
    shutil.copytree(other, file.parent / "old")


_CHANGES = (
    _missing, _damaged, _damaged, _of_another_model, _a_folder, _a_pipe, _of_20_gigabytes, _a_dangling_link,
    _another_document, _another_document, _signed_again, _signed_again, _with_more_files,
)  # fmt: skip
