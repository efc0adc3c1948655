"""The compiled inverse kinematics as a shared library with a header, and a model for it."""

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.library.model_file import layout_key, model_file
from pisigma.files.errors import OutputError
from pisigma.model.compiled_model import describe
from pisigma.robot.kernels.layout import DESCRIPTION, MEMORY
from pisigma.robot.kernels.machine_code import library_object

HEADER, SOURCE, MODEL = "pisigma_ik.h", "pisigma_ik.c", "model.psik"
LIBRARY = "libpisigma_ik.dylib" if sys.platform == "darwin" else "libpisigma_ik.so"

_COMPILERS = ("cc", "gcc", "clang")
_OPTIONS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-fvisibility=default")


def _compiler() -> str:
    """The compiler for C: that of the variable CC, or the first that there is.

    Raises:
        OutputError: there is none.
    """
    names = (os.environ["CC"],) if os.environ.get("CC") else _COMPILERS
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None or os.name == "nt":
        raise OutputError(
            f"the library is linked by a C compiler, but there is none ({', '.join(names)}); install gcc, or name "
            "another compiler in the environment variable CC."
        )
    return path


def _link(code: bytes, compiler: str) -> bytes:
    """The library of the kernels' object code.

    Raises:
        OutputError: the compiler fails; the message says why.
    """
    sources = Path(__file__).parent
    sizes = {
        "LAYOUT": f"{layout_key()}ULL",
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
            raise OutputError(f"{compiler} cannot link the library: {done.stderr.strip()[-500:]}")
        return library.read_bytes()


def _write(request: ExportRequest) -> Exported:
    compiler, model = _compiler(), request.load()
    content = {
        HEADER: Path(__file__).with_name(HEADER).read_bytes(),
        MODEL: model_file(model),
        LIBRARY: _link(library_object(describe(model)[0].forms), compiler),
    }
    remarks = (
        f"The library is for {sys.platform} on {platform.machine()}; export it again for other machines.",
    )
    return Exported(content, {**model_facts(model), "files": sorted(content)}, remarks)


FORMAT = ExportFormat("library", "a C library", (), _write, frozenset(("payload_kg", "temperature_c")))
