"""The compiled inverse kinematics as a shared library with a header, and a model file for it."""

import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import pose_remarks
from pisigma.files.errors import OutputError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.compiled_model import describe_as_arrays
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.joint_input import PlausibleJoints
from pisigma.robot.kernels.arrays import CORRECTED, IDENTIFIED
from pisigma.robot.kernels.build import source_hash
from pisigma.robot.kernels.layout import DESCRIPTION, DOF, MEMORY, pack
from pisigma.robot.kernels.machine_code import kernel_forms, library_object

HEADER, SOURCE, MODEL = "pisigma_ik.h", "pisigma_ik.c", "model.psik"
LIBRARY = "libpisigma_ik.dylib" if sys.platform == "darwin" else "libpisigma_ik.so"

_COMPILERS = ("cc", "gcc", "clang")
_OPTIONS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-fvisibility=default")
_HEAD = struct.Struct(f"=8s7Qq{2 * DOF}dQ8d")
_WORD = 8
_GAP = 16
"""Largest number of successive zero words that are written instead of starting a new segment."""


def _compiler() -> str:
    """Return the C compiler of the environment variable CC, or the first available compiler.

    Raises:
        OutputError: there is no compiler.
    """
    names = (os.environ["CC"],) if os.environ.get("CC") else _COMPILERS
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None or os.name == "nt":
        raise OutputError(
            f"no C compiler was found to link the library ({', '.join(names)})",
            value=names[0],
            remedy="install gcc, or name another compiler in the environment variable CC",
        )
    return path


def _link(code: bytes, compiler: str) -> bytes:
    """Link the kernels' object code into a library.

    Raises:
        OutputError: the compiler fails; the message includes its output.
    """
    sources = Path(__file__).parent
    sizes = {
        "LAYOUT": f"{library_source_hash()}ULL",
        "DESCRIPTION_SIZE": DESCRIPTION.itemsize,
        "MEMORY_SIZE": MEMORY.itemsize,
    }
    with tempfile.TemporaryDirectory() as scratch:
        kernels, library = Path(scratch, "kernels.o"), Path(scratch, LIBRARY)
        kernels.write_bytes(code)
        command = [compiler, *_OPTIONS, *(f"-DPISIGMA_{name}={value}" for name, value in sizes.items())]
        command += [str(sources / SOURCE), str(kernels), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise OutputError(f"{compiler} failed to link the library: {done.stderr.strip()[-500:]}")
        return library.read_bytes()


def _write(request: ExportRequest) -> Exported:
    compiler, model = _compiler(), request.load()
    content = {
        HEADER: Path(__file__).with_name(HEADER).read_bytes(),
        MODEL: model_file(model),
        LIBRARY: _link(library_object(describe_as_arrays(model)[0].forms), compiler),
    }
    remarks = (
        f"The library is for {sys.platform} on {platform.machine()}; export it again for other platforms.",
        *pose_remarks(model),
    )
    return Exported(content, {**model_facts(model), "files": sorted(content)}, remarks)


FORMAT = ExportFormat(
    "library", "a C library", (), _write, frozenset(("payload_kg", "temperature_c")), contains="joint_values"
)


def library_source_hash() -> int:
    """Return the first 64 bits of the hash of the sources, by which a library recognises its model files."""
    return int(source_hash()[:16], 16)


def model_file(model: CalibratedModel) -> bytes:
    """Return the model file of the library, in the byte order of this machine.

    It consists of a header, the names of the branches, the nonzero parts of the struct, and a checksum (CRC-32) of all
    these; see `pisigma_ik.c`.

    Raises:
        ModelError: the correction of the model has no compiled form.
    """
    compiled = CompiledIK.from_model(model)
    description, branches = compiled.description, compiled.branches
    packed = pack(description, model.name, kernel_forms(description.forms))
    plausible_joints = PlausibleJoints(
        model.robot.limits, np.array(model.robot.revolute), [j.name for j in model.robot.joints]
    )
    bounds = np.zeros((2, DOF))
    for row, infinity in enumerate((-np.inf, np.inf)):
        bounds[row, : model.robot.dof] = plausible_joints.clip(np.full(model.robot.dof, infinity))
    names = b"".join(name.encode() + b"\0" for name in branches)
    arm = -1 if description.network.used else CORRECTED if description.arms.corrected else IDENTIFIED
    segments = _segments(packed)
    sizes = DESCRIPTION.itemsize, MEMORY.itemsize, model.robot.dof, len(branches), len(segments), len(names)
    axes = np.zeros(8)
    axes[: compiled.task_axes.row.size] = compiled.task_axes.row.ravel()
    head = _HEAD.pack(
        b"PSIGIK01", library_source_hash(), *sizes, arm, *bounds.ravel(), len(compiled.task_axes.row), *axes
    )
    content = head + names + b"".join(segments)
    return content + struct.pack("=I", zlib.crc32(content))


def _segments(packed: np.ndarray) -> list[bytes]:
    """Return the runs of nonzero words, each with the index of its first byte and its number of bytes."""
    words = packed.view(np.uint64).ravel()
    used = np.flatnonzero(words)
    runs = np.split(used, np.flatnonzero(np.diff(used) > _GAP) + 1)
    spans = ((int(run[0]), int(run[-1]) + 1) for run in runs if len(run))
    return [
        struct.pack("=2Q", first * _WORD, (last - first) * _WORD) + words[first:last].tobytes()
        for first, last in spans
    ]
