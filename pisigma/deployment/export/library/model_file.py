"""A model as the file that the shared library reads."""

import struct
import zlib

import numpy as np

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.joint_input import Postures
from pisigma.robot.kernels.arrays import CORRECTED, IDENTIFIED
from pisigma.robot.kernels.build import source_hash
from pisigma.robot.kernels.layout import DESCRIPTION, DOF, MEMORY, pack
from pisigma.robot.kernels.machine_code import kernel_forms

_HEAD = struct.Struct(f"=8s7Qq{2 * DOF}dQ8d")
_WORD = 8
_GAP = 16
"""Words of zeros that are written rather than a new segment begun."""


def layout_key() -> int:
    """What ties a model file to the library that was exported with it: the first 64 bits of the sources' hash."""
    return int(source_hash()[:16], 16)


def model_file(model: CalibratedModel) -> bytes:
    """Write a model as the library reads it, in the byte order of this machine.

    It is a head, the names of the branches, the parts of the struct that are not zero, and a checksum (CRC-32) of all
    of it; see `pisigma_ik.c`.

    Raises:
        ModelError: the model corrects by something that has no compiled form.
    """
    compiled = CompiledIK.of(model)
    description, branches = compiled.description, compiled.branches
    packed = pack(description, model.name, kernel_forms(description.forms))
    postures = Postures(
        model.robot.limits, np.array(model.robot.revolute), [j.name for j in model.robot.joints]
    )
    bounds = np.zeros((2, DOF))
    for row, infinity in enumerate((-np.inf, np.inf)):
        bounds[row, : model.robot.dof] = postures.clip(np.full(model.robot.dof, infinity))
    names = b"".join(name.encode() + b"\0" for name in branches)
    arm = -1 if description.network.used else CORRECTED if description.arms.corrected else IDENTIFIED
    segments = _segments(packed)
    sizes = DESCRIPTION.itemsize, MEMORY.itemsize, model.robot.dof, len(branches), len(segments), len(names)
    axes = np.zeros(8)
    axes[: compiled.axes.row.size] = compiled.axes.row.ravel()
    head = _HEAD.pack(b"PSIGIK01", layout_key(), *sizes, arm, *bounds.ravel(), len(compiled.axes.row), *axes)
    content = head + names + b"".join(segments)
    return content + struct.pack("=I", zlib.crc32(content))


def _segments(packed: np.ndarray) -> list[bytes]:
    """The words that are not zero, in runs, each with the index of its first byte and its number of bytes."""
    words = packed.view(np.uint64).ravel()
    used = np.flatnonzero(words)
    runs = np.split(used, np.flatnonzero(np.diff(used) > _GAP) + 1)
    spans = ((int(run[0]), int(run[-1]) + 1) for run in runs if len(run))
    return [
        struct.pack("=2Q", first * _WORD, (last - first) * _WORD) + words[first:last].tobytes()
        for first, last in spans
    ]
