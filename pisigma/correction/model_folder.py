"""Models as folders: `model.yaml` and `model.safetensors`, written whole or not at all, checked when read."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from pydantic import ConfigDict, Field
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel, Provenance
from pisigma.correction.domain import Domain
from pisigma.errors import ModelError, OutputError
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot.robot_file import RobotDocument, robot_to_yaml
from pisigma.yaml_file import Section, parse_yaml

FORMAT = 1
DESCRIPTION = "model.yaml"
WEIGHTS = "model.safetensors"


class GroupSection(Section):
    """One joint group of the network."""

    joints: tuple[str, ...]
    inputs: tuple[str, ...]
    orders: tuple[int, ...]
    reference: tuple[tuple[float, float, float], ...] = Field(min_length=3, max_length=3)


class ProvenanceSection(Section):
    """See `Provenance`."""

    recipe: str
    recipe_sha256: str
    data_source: str
    data_sha256: str
    rows: int
    rows_left_out: int
    rule: str
    seed: int
    versions: dict[str, str]


class ModelDocument(Section):
    """The whole of `model.yaml`."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())

    format: Literal[1]
    name: str
    kind: str
    branches: tuple[str, ...]
    weights_sha256: str
    robot: RobotDocument
    network: tuple[GroupSection, ...]
    provenance: ProvenanceSection
    metrics: dict[str, Any]


class _FormatOnly(Section):
    model_config = ConfigDict(extra="ignore")
    format: int


def check_replaceable(folder: Path) -> None:
    """Make sure that a model may be written to a folder: before the work, not after it.

    Raises:
        OutputError: it is a file, or a folder that holds something that is no model.
    """
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not (folder / DESCRIPTION).is_file())):
        raise OutputError(f"{folder}: exists and is no model folder; choose another --out or remove it.")


@contextmanager
def staged_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a scratch folder that becomes `folder` when the block ends well, and is removed when it does not.

    A model folder that is there already is replaced; any other folder or file is not touched.

    Raises:
        OutputError: `folder` is a file, or a folder that holds no model, or its parent cannot be written to.
    """
    target = Path(folder)
    check_replaceable(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
    except OSError as problem:
        raise OutputError(f"{target}: cannot be written ({problem.strerror}); choose another --out.") from None
    try:
        scratch.chmod(0o755)
        yield scratch
        old = None
        if target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".old", dir=target.parent))
            os.replace(target, old / "model")
        os.replace(scratch, target)
        if old is not None:
            shutil.rmtree(old)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def save_model(model: CalibratedModel, folder: Path) -> None:
    """Write `model.yaml` and `model.safetensors` into a folder (see `staged_folder`)."""
    weights = save_tensors(_tensors(model))
    groups = []
    for group, network in model.network.members() if model.network else []:
        groups.append(
            {
                "joints": [model.robot.joints[index].name for index in group.joints],
                "inputs": list(group.inputs.names),
                "orders": list(network.orders),
                "reference": group.inputs.reference.tolist(),
            }
        )
    document = {
        "format": FORMAT,
        "name": model.name,
        "kind": model.kind,
        "branches": list(model.branches),
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
        "robot": yaml.safe_load(robot_to_yaml(model.robot)),
        "network": groups,
        "provenance": asdict(model.provenance),
        "metrics": model.metrics,
    }
    (folder / WEIGHTS).write_bytes(weights)
    (folder / DESCRIPTION).write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")


def load_model(folder: str | os.PathLike[str]) -> CalibratedModel:
    """Read a model folder and check all of it.

    Raises:
        ModelError: a file is missing, truncated, foreign, changed or of a newer format; nothing is half loaded.
    """
    path = Path(folder)
    if not path.is_dir():
        raise ModelError(f"{path}: there is no such model folder; give a folder that `pisigma train` wrote.")
    for name in (DESCRIPTION, WEIGHTS):
        if not (path / name).is_file():
            raise ModelError(f"{path}: {name} is missing, so this is no whole model folder; train or copy it again.")
    document = _read_description(path / DESCRIPTION)
    tensors = _read_weights(path / WEIGHTS, document.weights_sha256)
    robot = document.robot.to_robot()
    try:
        network = _build_network(document, robot.dof, tensors)
        domain = Domain(tensors["domain.samples"], tensors["domain.radius"]) if "domain.samples" in tensors else None
        starts = tensors["starts"]
    except (KeyError, RuntimeError, ValueError) as problem:
        raise ModelError(f"{path}: {WEIGHTS} does not fit {DESCRIPTION} ({problem}); train the model again.") from None
    return CalibratedModel(
        name=document.name,
        kind=document.kind,
        robot=robot,
        network=network,
        domain=domain,
        branches=document.branches,
        starts=starts,
        provenance=Provenance(**document.provenance.model_dump()),
        metrics=document.metrics,
    )


def _tensors(model: CalibratedModel) -> dict[str, Tensor]:
    tensors = {"starts": model.starts.contiguous()}
    for prefix, module in (("network", model.network), ("domain", model.domain)):
        if module is not None:
            tensors |= {f"{prefix}.{key}": value.contiguous() for key, value in module.state_dict().items()}
    return tensors


def _read_description(path: Path) -> ModelDocument:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        raise ModelError(f"{path}: cannot be read ({problem}); train or copy the model again.") from None
    version = parse_yaml(text, _FormatOnly, ModelError, source=str(path)).format
    if version > FORMAT:
        raise ModelError(f"{path}: format {version} is newer than this pisigma reads ({FORMAT}); upgrade pisigma.")
    return parse_yaml(text, ModelDocument, ModelError, source=str(path))


def _read_weights(path: Path, sha256: str) -> dict[str, Tensor]:
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ModelError(
            f"{path}: is truncated, changed or of another model (its hash is not the one in {DESCRIPTION}); "
            "train or copy the model again."
        )
    try:
        tensors: dict[str, Tensor] = load_tensors(content)
    except SafetensorError as problem:
        raise ModelError(f"{path}: is no safetensors file ({problem}); train or copy the model again.") from None
    bad = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if bad:
        raise ModelError(f"{path}: the tensor '{bad[0]}' has entries that are not finite; train the model again.")
    return tensors


def _build_network(document: ModelDocument, dof: int, tensors: dict[str, Tensor]) -> CorrectionNetwork | None:
    if not document.network:
        return None
    robot = document.robot.to_robot()
    names = [joint.name for joint in robot.joints]
    groups, networks = [], []
    for index, section in enumerate(document.network):
        inputs = Inputs.of(robot, section.inputs, np.array(section.reference))
        groups.append(JointGroup(tuple(names.index(name) for name in section.joints), inputs))
        dtype = tensors[f"network.networks.{index}.weight"].dtype
        networks.append(PiSigma(len(section.inputs), len(section.joints), section.orders, dtype=dtype))
    network = CorrectionNetwork(dof, groups, networks)
    prefix = "network."
    network.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
    return network.requires_grad_(False)
