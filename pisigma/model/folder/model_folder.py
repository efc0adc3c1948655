"""Models as folders: `model.yaml` and `model.safetensors`, checked when read."""

import hashlib
import os
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from pisigma.files.errors import ModelError, PisigmaError, nearest_choice
from pisigma.files.model_files import COMPILED, DESCRIPTION, DRAWING, WEIGHTS, content_hash, read_model_file
from pisigma.measurement.copies import ROW_READINGS, ROW_STEPS, RowValues
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.compiled_model import save_compiled
from pisigma.model.domain import Domain
from pisigma.model.folder.hybrid_folder import (
    DTYPES,
    Shape,
    check_size,
    hybrid_sections,
    hybrid_shapes,
    hybrid_tensors,
    with_hybrid,
)
from pisigma.model.folder.model_document import ModelDocument, document_text, read_document, write_document
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.writing import robot_document

_PREFIX = "network."
_ROWS = ("rows.numbers", "rows.measured", "rows.steps")
"""Of the rows that a model was made of: what was measured, whether it was, and what it was rounded to."""


def save_model(model: CalibratedModel, folder: Path) -> None:
    """Write the files of a model into a folder, such as `staged_folder` gives.

    Next to `model.yaml` and `model.safetensors` it gets what the compiled kernels read, where they know the model's
    kind of correction, and the URDF file that the robot was drawn in, where it was.

    Raises:
        ModelError: the model is under given conditions.
    """
    if model.conditions:
        raise ModelError(
            f"model '{model.name}' is under given conditions, which a folder does not keep; save it as calibrated."
        )
    weights = save_tensors(_tensors(model))
    groups = [
        {
            "joints": [model.robot.joints[index].name for index in group.joints],
            "inputs": list(group.inputs.names),
            "orders": list(network.orders),
            "reference": group.inputs.reference.tolist(),
        }
        for group, network in (model.network.members() if model.network else ())
    ]
    document = {
        "name": model.name,
        "kind": model.kind,
        "branches": list(model.branches),
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
        "drawing_sha256": None if model.robot.urdf is None else hashlib.sha256(model.robot.urdf).hexdigest(),
        "robot": robot_document(model.robot),
        "calibrated": robot_document(model.calibrated) if model.calibrated else None,
        "bases": {name: frame.tolist() for name, frame in model.bases.items()},
        "tools": {name: frame.tolist() for name, frame in model.tools.items()},
        "network": groups,
        **hybrid_sections(model),
        "provenance": asdict(model.provenance),
        "metrics": model.metrics,
    }
    (folder / WEIGHTS).write_bytes(weights)
    if model.robot.urdf is not None:
        (folder / DRAWING).write_bytes(model.robot.urdf)
    describe(document_text(document), model, folder)


def describe(text: str, model: CalibratedModel, folder: Path) -> None:
    """Write the description of a model whose weights the folder holds, and what the compiled kernels read.

    Args:
        text: of the description, from `document_text`.
        model: that it describes.
        folder: with the weights file.
    """
    compiled, sha256 = folder / COMPILED, None
    with suppress(ModelError):  # the kernels do not evaluate every kind of model
        save_compiled(model, compiled, content_hash(text.encode(), (folder / WEIGHTS).read_bytes()))
        sha256 = hashlib.sha256(compiled.read_bytes()).hexdigest()
    write_document(text, sha256, folder / DESCRIPTION)


def load_model(folder: str | os.PathLike[str]) -> CalibratedModel:
    """Read a model folder and check all of it.

    Raises:
        ModelError: a file is missing, truncated, foreign, changed or of a newer format; nothing is half
            loaded.
    """
    path = Path(folder)
    if not path.is_dir():
        raise ModelError(
            f"{path}: there is no such model folder; give a folder that `pisigma calibrate` or `pisigma train` wrote."
        )
    for name in (DESCRIPTION, WEIGHTS):
        if not (path / name).exists():
            raise ModelError(
                f"{path}: {name} is missing, so this is no whole model folder; train or copy it again."
            )
    document = read_document(path / DESCRIPTION)
    tensors = read_weights(path / WEIGHTS, document.weights_sha256)
    drawing = document.drawing_sha256 and _read_whole(path / DRAWING, document.drawing_sha256)
    try:
        return _build_model(document, tensors, drawing or None)
    except (PisigmaError, ValueError) as problem:
        reason = " ".join(str(problem).rstrip(".").split())
        raise ModelError(
            f"{path}: {WEIGHTS} and {DESCRIPTION} do not fit ({reason}); train the model again."
        ) from None


def _tensors(model: CalibratedModel) -> dict[str, Tensor]:
    tensors = {"starts": model.starts, **hybrid_tensors(model)}
    if (rows := model.made_of) is not None:
        there = torch.isfinite(rows.numbers)
        values = torch.where(there, rows.numbers, 0.0), there.to(torch.uint8), rows.steps
        tensors |= dict(zip(_ROWS, values, strict=True))
    for prefix, module in (("network", model.network), ("domain", model.domain)):
        if module is not None:
            tensors |= {f"{prefix}.{key}": value for key, value in module.state_dict().items()}
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def read_weights(path: Path, sha256: str) -> dict[str, Tensor]:
    """Read the tensors of a weights file.

    Raises:
        ModelError: its hash is another one, it is no such file, or it holds numbers that are not finite.
    """
    content = _read_whole(path, sha256)
    try:
        tensors: dict[str, Tensor] = load_tensors(content)
    except SafetensorError as problem:
        raise ModelError(
            f"{path}: is no safetensors file ({problem}); train or copy the model again."
        ) from None
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ModelError(
                f"{path}: the tensor '{name}' has entries that are not finite; train the model again."
            )
    return tensors


def _read_whole(path: Path, sha256: str) -> bytes:
    """Read a file that the description states the hash of.

    Raises:
        ModelError: its hash is another one, or it cannot be read.
    """
    content = read_model_file(path.parent, path.name)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ModelError(
            f"{path}: is truncated, changed or of another model (its hash is not the one in {DESCRIPTION}); "
            "train or copy the model again."
        )
    return content


def _build_model(
    document: ModelDocument, tensors: dict[str, Tensor], drawing: bytes | None
) -> CalibratedModel:
    """Put the model together from parts that fit.

    Raises:
        ValueError: a tensor is missing, too many or of another shape or type; or a name or count is wrong.
    """
    robot = Robot(*document.robot.drawing()._replace(urdf=drawing))
    check_size(document, robot, sum(value.numel() for value in tensors.values()))
    _check_branches(robot, document.branches)
    network = _empty_network(document, robot)
    samples = "domain.samples" in tensors
    expected: dict[str, Shape] = {"starts": (None, robot.dof), **hybrid_shapes(document, robot)}
    if network is not None:
        expected |= {_PREFIX + key: tuple(value.shape) for key, value in network.state_dict().items()}
        inputs = sum(len(group.inputs.names) for group in network.groups)
        expected |= {"domain.samples": (None, inputs), "domain.radius": ()} if samples else {}
    if _ROWS[0] in tensors:  # folders do not have to keep them
        columns = len(robot.axes) + ROW_READINGS
        expected |= dict(zip(_ROWS, ((None, columns), (None, columns), (None, ROW_STEPS)), strict=True))
    _check_tensors(tensors, expected)
    if network is not None:
        network.load_state_dict(
            {k.removeprefix(_PREFIX): v for k, v in tensors.items() if k.startswith(_PREFIX)}
        )
        network.requires_grad_(False)
    bases, tools = (
        {name: np.array(frame) for name, frame in frames.items()}
        for frames in (document.bases, document.tools)
    )
    model = CalibratedModel(
        name=document.name,
        kind=document.kind,
        robot=robot,
        network=network,
        domain=Domain(tensors["domain.samples"], tensors["domain.radius"]) if samples else None,
        branches=document.branches,
        starts=tensors["starts"],
        calibrated=_calibrated_robot(document, robot),
        bases=bases,
        tools=tools,
        made_of=_made_of(robot, *(tensors[name] for name in _ROWS)) if _ROWS[0] in tensors else None,
        provenance=Provenance(**document.provenance.model_dump()),
        metrics=document.metrics,
    )
    return with_hybrid(model, document, tensors)


def _made_of(robot: Robot, numbers: Tensor, measured: Tensor, steps: Tensor) -> RowValues:
    if not len(numbers) == len(measured) == len(steps):
        raise ValueError("the rows that the model was made of lack numbers or steps")
    return RowValues.kept(torch.where(measured.bool(), numbers, torch.nan), steps, robot)


def _calibrated_robot(document: ModelDocument, robot: Robot) -> Robot | None:
    if document.calibrated is None:
        return None
    calibrated = Robot(*document.calibrated.drawing()._replace(urdf=robot.urdf))
    if [(row.name, row.type) for row in calibrated.rows] != [(row.name, row.type) for row in robot.rows]:
        raise ValueError("the calibrated robot has other rows than the nominal one")
    if not (np.array_equal(calibrated.base, robot.base) and np.array_equal(calibrated.tool, robot.tool)):
        raise ValueError("the calibrated robot has another base or tool than the nominal one")
    return calibrated


def _check_branches(robot: Robot, branches: tuple[str, ...]) -> None:
    solver = closed_form_solver(robot)
    for name in branches:
        if solver is None:
            raise ValueError(f"branch '{name}' is named, but robot '{robot.name}' has no closed-form inverse")
        if name not in solver.branches:
            raise ValueError(
                f"robot '{robot.name}' has no branch '{name}'; {nearest_choice(name, solver.branches)}"
            )


def _empty_network(document: ModelDocument, robot: Robot) -> CorrectionNetwork | None:
    """The network as described, its weights still to be filled in."""
    names = [joint.name for joint in robot.joints]
    groups, networks = [], []
    for section in document.network:
        for name in section.joints:
            if name not in names:
                raise ValueError(f"the network corrects joint '{name}'; {nearest_choice(name, names)}")
        inputs = Inputs.of(robot, section.inputs, np.array(section.reference))
        groups.append(JointGroup(tuple(names.index(name) for name in section.joints), inputs))
        networks.append(PiSigma(len(section.inputs), len(section.joints), section.orders))
    return CorrectionNetwork(robot.dof, groups, networks) if groups else None


def _check_tensors(tensors: dict[str, Tensor], expected: dict[str, Shape]) -> None:
    """Refuse tensors that are not exactly the expected ones; None in a shape is any length."""
    for name in sorted(set(tensors) ^ set(expected)):
        raise ValueError(f"the tensor '{name}' is {'unknown' if name in tensors else 'missing'}")
    for name, shape in expected.items():
        value = tensors[name]
        fits = len(shape) == value.ndim and all(
            want in (None, got) for want, got in zip(shape, value.shape, strict=True)
        )
        if not fits:
            wanted = str(tuple("any" if length is None else length for length in shape)).replace("'", "")
            raise ValueError(f"the tensor '{name}' of shape {wanted} was wanted, got {tuple(value.shape)}")
        dtype = DTYPES.get(name, torch.float64)
        if value.dtype != dtype:
            kind = str(dtype).removeprefix("torch.")
            raise ValueError(f"the tensor '{name}' in {kind} was wanted, got {value.dtype}")
