"""Model folders that were edited and given a matching hash."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from safetensors.torch import load_file, save_file


def edit(folder: Path, change: Callable[[Any], Any]) -> None:
    """Change the description, and store its new hash."""
    text = (folder / "model.yaml").read_text()
    document = yaml.load(text[: text.index("\nsha256: ") + 1], Loader=yaml.CSafeLoader)
    change(document)
    body = yaml.dump(document, Dumper=yaml.CSafeDumper, sort_keys=False)
    (folder / "model.yaml").write_text(f"{body}sha256: {hashlib.sha256(body.encode()).hexdigest()}\n")


def edit_tensors(folder: Path, change: Callable[[Any], Any]) -> None:
    """Change the weights, and store their new hash."""
    path = folder / "model.safetensors"
    tensors = load_file(path)
    change(tensors)
    save_file({name: value.contiguous() for name, value in tensors.items()}, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit(folder, lambda document: document.update(weights_sha256=digest))
