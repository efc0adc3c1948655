"""Read and write model folders: `model.yaml` and `model.safetensors`."""

import hashlib
import os
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from pisigma.files.errors import ModelError, PisigmaError, Place, choice_remedy
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
from pisigma.model.folder.model_document import (
    InconsistentFolderError,
    ModelDocument,
    document_text,
    read_document,
    write_document,
)
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.writing import robot_document

_PREFIX = "network."
_ROWS = ("rows.numbers", "rows.measured", "rows.steps")
"""Names of the tensors of training rows: values, whether they were measured, and rounding steps."""


def save_model(model: CalibratedModel, folder: Path) -> None:
    """Write the files of a model into a folder, for example one from `staged_folder`.

    The files are `model.yaml`, `model.safetensors`, the arrays of the compiled kernels if these support the model's
    kind of correction, and the URDF file of the robot if the robot was read from one.

    Raises:
        ModelError: the model is evaluated at fixed conditions.
    """
    if model.conditions:
        stated = {name: model.conditions[name] for name in model.measured_conditions}
        raise ModelError(
            f"model '{model.name}' is evaluated at fixed conditions, which a folder does not store",
            value=stated,
            remedy="save the model as it was calibrated",
        )
    weights = save_tensors(_tensors(model))
    groups = [
        {
            "joints": [model.robot.joints[index].name for index in group.joints],
            "inputs": list(group.inputs.names),
            "orders": list(network.orders),
            "reference": group.inputs.reference_rotation.tolist(),
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
    write_description(document_text(document), model, folder)


def write_description(text: str, model: CalibratedModel, folder: Path) -> None:
    """Write the description of a model whose weights are in the folder, and the arrays of the compiled kernels.

    Args:
        text: text of the description, from `document_text`.
        model: model to describe.
        folder: folder with the weights file.
    """
    compiled, sha256 = folder / COMPILED, None
    with suppress(ModelError):  # kernels do not support every kind of model
        save_compiled(model, compiled, content_hash(text.encode(), (folder / WEIGHTS).read_bytes()))
        sha256 = hashlib.sha256(compiled.read_bytes()).hexdigest()
    write_document(text, sha256, folder / DESCRIPTION)


def load_model(folder: str | os.PathLike[str]) -> CalibratedModel:
    """Read and check a model folder.

    Raises:
        ModelError: a file is missing, truncated, changed, from another model or in a newer format; nothing is loaded in
            these cases.
    """
    path = Path(folder)
    if not path.is_dir():
        raise ModelError(
            "there is no such model folder",
            at=Place(path),
            remedy="give a folder that `pisigma calibrate` or `pisigma train` wrote",
        )
    for name in (DESCRIPTION, WEIGHTS):
        if not (path / name).exists():
            raise ModelError(
                f"{name} is missing, so the model folder is incomplete",
                at=Place(path),
                value=name,
                remedy="train or copy the model again",
            )
    document = read_document(path / DESCRIPTION)
    tensors = read_weights(path / WEIGHTS, document.weights_sha256)
    drawing = document.drawing_sha256 and _read_whole(path / DRAWING, document.drawing_sha256)
    try:
        return _build_model(document, tensors, drawing or None)
    except (PisigmaError, ValueError) as problem:
        reason = " ".join(str(problem).rstrip(".").split())
        file = problem.file if isinstance(problem, InconsistentFolderError) else DESCRIPTION
        raise ModelError(
            f"{WEIGHTS} and {DESCRIPTION} do not fit together: {reason}",
            value=getattr(problem, "value", None),
            at=Place(path / file, column=getattr(problem, "column", None)),
            remedy="train the model again",
        ) from None


def _tensors(model: CalibratedModel) -> dict[str, Tensor]:
    tensors = {"starts": model.starts, **hybrid_tensors(model)}
    if (rows := model.training_values) is not None:
        there = torch.isfinite(rows.numbers)
        values = torch.where(there, rows.numbers, 0.0), there.to(torch.uint8), rows.rounding_steps
        tensors |= dict(zip(_ROWS, values, strict=True))
    for prefix, module in (("network", model.network), ("domain", model.domain)):
        if module is not None:
            tensors |= {f"{prefix}.{key}": value for key, value in module.state_dict().items()}
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def read_weights(path: Path, sha256: str) -> dict[str, Tensor]:
    """Read the tensors of a weights file.

    Raises:
        ModelError: the hash of the file differs, it is not a safetensors file, or it contains values that are not
            finite.
    """
    content = _read_whole(path, sha256)
    try:
        tensors: dict[str, Tensor] = load_tensors(content)
    except SafetensorError as problem:
        raise ModelError(
            f"expected a safetensors file: {problem}",
            expected="a safetensors file",
            at=Place(path),
            remedy="train or copy the model again",
        ) from None
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ModelError(
                f"the tensor '{name}' has entries that are not finite",
                value=name,
                at=Place(path),
                remedy="train the model again",
            )
    return tensors


def _read_whole(path: Path, sha256: str) -> bytes:
    """Return the content of a file whose hash the description states.

    Raises:
        ModelError: the hash of the file differs, or it cannot be read.
    """
    content = read_model_file(path.parent, path.name)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ModelError(
            f"the file was truncated or changed, or belongs to another model: its SHA-256 is not the one in "
            f"{DESCRIPTION}",
            expected=f"the SHA-256 {sha256}",
            at=Place(path),
            remedy="train or copy the model again",
        )
    return content


def _build_model(
    document: ModelDocument, tensors: dict[str, Tensor], drawing: bytes | None
) -> CalibratedModel:
    """Build the model from its description and tensors.

    Raises:
        ValueError: a tensor is missing, unknown or of a wrong shape or type, or a name or count is wrong.
    """
    robot = Robot(*document.robot.to_fields()._replace(urdf=drawing))
    check_size(document, robot, sum(value.numel() for value in tensors.values()))
    _check_branches(robot, document.branches)
    network = _empty_network(document, robot)
    samples = "domain.samples" in tensors
    expected: dict[str, Shape] = {"starts": (None, robot.dof), **hybrid_shapes(document, robot)}
    if network is not None:
        expected |= {_PREFIX + key: tuple(value.shape) for key, value in network.state_dict().items()}
        inputs = sum(len(group.inputs.names) for group in network.groups)
        expected |= {"domain.samples": (None, inputs), "domain.radius": ()} if samples else {}
    if _ROWS[0] in tensors:  # these tensors are optional in a folder
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
        training_values=_training_values(robot, *(tensors[name] for name in _ROWS))
        if _ROWS[0] in tensors
        else None,
        provenance=Provenance(**document.provenance.model_dump()),
        metrics=document.metrics,
    )
    return with_hybrid(model, document, tensors)


def _training_values(robot: Robot, numbers: Tensor, measured: Tensor, steps: Tensor) -> RowValues:
    if not len(numbers) == len(measured) == len(steps):
        raise InconsistentFolderError(
            f"the tensors {', '.join(_ROWS)} differ in their number of rows", file=WEIGHTS, value=_ROWS[0]
        )
    return RowValues.from_stored_numbers(torch.where(measured.bool(), numbers, torch.nan), steps, robot)


def _calibrated_robot(document: ModelDocument, robot: Robot) -> Robot | None:
    if document.calibrated is None:
        return None
    calibrated = Robot(*document.calibrated.to_fields()._replace(urdf=robot.urdf))
    if [(row.name, row.type) for row in calibrated.rows] != [(row.name, row.type) for row in robot.rows]:
        raise InconsistentFolderError(
            "the rows of the calibrated robot differ from those of the nominal one", column="calibrated"
        )
    if not (np.array_equal(calibrated.base, robot.base) and np.array_equal(calibrated.tool, robot.tool)):
        raise InconsistentFolderError(
            "the base or tool of the calibrated robot differs from the nominal one", column="calibrated"
        )
    return calibrated


def _check_branches(robot: Robot, branches: tuple[str, ...]) -> None:
    solver = closed_form_solver(robot)
    for name in branches:
        if solver is None:
            raise InconsistentFolderError(
                f"branch '{name}' is stated, but robot '{robot.name}' has no closed-form inverse",
                column="branches",
                value=name,
            )
        if name not in solver.branches:
            raise InconsistentFolderError(
                f"robot '{robot.name}' has no branch '{name}'; {choice_remedy(name, solver.branches)}",
                column="branches",
                value=name,
            )


def _empty_network(document: ModelDocument, robot: Robot) -> CorrectionNetwork | None:
    """Return the network as described, without weights."""
    names = [joint.name for joint in robot.joints]
    groups, networks = [], []
    for section in document.network:
        for name in section.joints:
            if name not in names:
                raise InconsistentFolderError(
                    f"the network corrects the unknown joint '{name}'; {choice_remedy(name, names)}",
                    column="network",
                    value=name,
                )
        inputs = Inputs.from_names(robot, section.inputs, np.array(section.reference))
        groups.append(JointGroup(tuple(names.index(name) for name in section.joints), inputs))
        networks.append(PiSigma(len(section.inputs), len(section.joints), section.orders))
    return CorrectionNetwork(robot.dof, groups, networks) if groups else None


def _check_tensors(tensors: dict[str, Tensor], expected: dict[str, Shape]) -> None:
    """Check that the tensors are exactly the expected ones; None in a shape stands for any length."""
    for name in sorted(set(tensors) ^ set(expected)):
        problem = "unknown" if name in tensors else "missing"
        raise InconsistentFolderError(f"the tensor '{name}' is {problem}", file=WEIGHTS, value=name)
    for name, shape in expected.items():
        value = tensors[name]
        fits = len(shape) == value.ndim and all(
            want in (None, got) for want, got in zip(shape, value.shape, strict=True)
        )
        if not fits:
            wanted = str(tuple("any" if length is None else length for length in shape)).replace("'", "")
            raise InconsistentFolderError(
                f"expected shape {wanted} for the tensor '{name}', got {tuple(value.shape)}",
                file=WEIGHTS,
                value=tuple(value.shape),
            )
        dtype = DTYPES.get(name, torch.float64)
        if value.dtype != dtype:
            kind = str(dtype).removeprefix("torch.")
            raise InconsistentFolderError(
                f"expected type {kind} for the tensor '{name}', got {str(value.dtype).removeprefix('torch.')}",
                file=WEIGHTS,
                value=value.dtype,
            )


ModelSource = CalibratedModel | str | os.PathLike[str]
"""A model, or the path of its folder."""


@runtime_checkable
class HasModel(Protocol):
    """Object that has a model: a `pisigma.CorrectedIK`, or a result of `pisigma.calibrate` or a similar function."""

    @property
    def model(self) -> CalibratedModel:
        """The calibrated model."""


def loaded_model(source: ModelSource | HasModel) -> tuple[CalibratedModel, str | os.PathLike[str] | None]:
    """Return a model, and its folder if it was read from one; see `load_model`."""
    source = model_or_folder(source)
    return (source, None) if isinstance(source, CalibratedModel) else (load_model(source), source)


def model_or_folder(source: ModelSource | HasModel) -> ModelSource:
    """Return the model of an object that has one; a model or a folder is returned unchanged."""
    return source.model if isinstance(source, HasModel) else source
