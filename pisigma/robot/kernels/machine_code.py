"""Kernels as machine code for this processor, compiled by llvmlite from intermediate code and cached in a file.

numba is not needed if the package contains the intermediate code. The kernels call only mathematical functions of the C
library, so their object code can be loaded by llvmlite alone.
"""

import ctypes
import functools
import hashlib
import os
import stat
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite  # type: ignore[import-untyped]
import llvmlite.binding as llvm  # type: ignore[import-untyped]

from pisigma.files.errors import ModelError
from pisigma.robot.kernels.build import (
    ARGUMENTS,
    ENTRY,
    intermediate_code,
    read_intermediate_code,
    read_object,
    source_hash,
    stored_code_forms,
    write_object,
)
from pisigma.robot.kernels.forms import KernelForms

_ALLOWED = {"acos", "atan2", "ceil", "cos", "fabs", "floor", "hypot", "log", "pow", "sin", "sqrt"}
_ALLOWED |= {"memcpy", "memset"}
"""Mathematical functions of the C library that are available in every process."""
_OPTIONS = "speed 3, vectors up to 256 bits, internal linkage"
"""Options of `optimised_object` that affect the code; part of the cache key."""
_PROCESSOR = "x86-64-v3"
"""Processor of the machine code in the package, which every x86-64 processor with AVX2 can run."""
_FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave")
"""Features that x86-64-v3 adds to x86-64."""
_PATIENCE = 2.0
"""Delay of the notice on compilation [s]; cached kernels load much faster."""
_COMPILING = "pisigma: preparing the inverse kinematics for this processor (once, takes a few seconds) ...\n"
Said = ctypes.c_int64 * 1
"""Status that a call of the kernels writes."""
IGNORED = Said()
"""Address for the status of calls whose status is ignored."""
_lock = threading.Lock()
_kept: list[Any] = []


@functools.cache
def _ready_forms() -> KernelForms | None:
    return stored_code_forms()


_NOTHING = KernelForms()


def kernel_forms(wanted: KernelForms = _NOTHING) -> KernelForms:
    """Return the forms that the kernels of `load_kernels` evaluate.

    These are the forms of the code in the package if they include the wanted forms, otherwise all registered forms.
    """
    ready = _ready_forms()
    return ready if ready is not None and ready.cover(wanted) else KernelForms.registered()


def load_kernels(wanted: KernelForms = _NOTHING) -> Callable[..., int]:
    """Return the function `kernels.run` on addresses and numbers; bytes and ctypes arrays are passed by address.

    It has two more arguments before those of `run`: a `Said`, into which -1 or the result of `kernels.solve_poses` is
    written, and `IGNORED` for exceptions, which are never raised.

    On Linux and processors with AVX2, the package contains the machine code. Otherwise it is compiled in a few seconds
    at the first use on a machine, and read from a file afterwards; on a terminal a notice explains the delay.

    Args:
        wanted: forms that the kernels have to evaluate.

    Raises:
        ModelError: the package has no intermediate code of the current sources, and numba is not installed.
    """
    notice = threading.Timer(_PATIENCE, sys.stderr.write, (_COMPILING,))
    notice.daemon = True
    if sys.stderr.isatty():
        notice.start()
    try:
        with _lock:
            return _load(kernel_forms(wanted))
    finally:
        notice.cancel()


@functools.cache
def _load(forms: KernelForms) -> Callable[..., int]:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    stored = read_object() if forms == _ready_forms() and _runs_stored_code() else None
    code = stored or _code(forms, _native_machine(), "kernels")
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _native_machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _kept.append(engine)
    kinds = [ctypes.c_void_p if kind == "p" else ctypes.c_int64 for kind in ARGUMENTS]
    prototype = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *kinds)
    return prototype(engine.get_function_address(ENTRY))


def _runs_stored_code() -> bool:
    """Return whether this process can run the machine code in the package."""
    if not (sys.platform == "linux" and llvm.get_process_triple().startswith("x86_64")):
        return False
    features = llvm.get_host_cpu_features()
    return all(features.get(name) for name in _FEATURES)


def build_object() -> None:
    """Compile the intermediate code in the package to machine code, and write it into the package."""
    code = read_intermediate_code()
    assert code is not None, "the intermediate code is built first"
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = target_machine("x86_64-unknown-linux-gnu", _PROCESSOR)
    write_object(optimised_object(code, machine), llvmlite=llvmlite.__version__)


def _code(forms: KernelForms, machine: Any, use: str) -> bytes:
    """Return object code from the cache, or compile it."""
    name = f"{use}-{_key(forms)}.o"
    code = next((kept for folder in cache_folders() if (kept := read_code(folder / name)) is not None), None)
    if code is None:
        code = optimised_object(_intermediate_code(forms), machine)
        any(write_code(folder / name, code) for folder in cache_folders())
    return code


def library_object(wanted: KernelForms) -> bytes:
    """Return object code of the kernels for a shared library, for any processor of the same architecture.

    Args:
        wanted: forms that the kernels have to evaluate.

    Raises:
        ModelError: the kernels cannot be compiled, see `load_kernels`.
    """
    with _lock:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        triple = llvm.get_process_triple()
        machine = llvm.Target.from_triple(triple).create_target_machine(
            opt=3, reloc="pic", codemodel="default"
        )
        return _code(kernel_forms(wanted), machine, "library")


def _key(forms: KernelForms) -> str:
    """Return the cache key of the machine code: sources, options, compiler versions and processor."""
    digest = hashlib.sha256()
    for word in (
        source_hash(),
        *forms.fingerprints(_ready_forms() or _NOTHING),
        _OPTIONS,
        llvmlite.__version__,
        str(llvm.llvm_version_info),
        llvm.get_process_triple(),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
    ):
        digest.update(word.encode() + b"\0")
    return digest.hexdigest()[:16]


def _intermediate_code(forms: KernelForms) -> str:
    """Return the code of the package if it has the current sources and forms, otherwise compile it with numba."""
    ready = read_intermediate_code() if _ready_forms() == forms else None
    if ready is not None:
        return ready
    try:
        return intermediate_code()
    except ImportError:
        raise ModelError(
            "the package contains no inverse kinematics compiled from its present source code",
            value="pisigma[compile]",
            remedy="install pisigma[compile] to compile it; solving without it is about 1000 times slower",
        ) from None


def _native_machine() -> Any:
    """Return the processor of this process, without 512-bit registers.

    Sums over six joints do not fill them, and the processor needs time to switch them on after a millisecond without
    use: a pose of a UR10 hybrid took 15.3 us after such a pause and 12.3 us without pauses, compared with 12.5 and
    11.2 us without these registers.
    """
    features = (
        llvm.get_host_cpu_features().flatten().replace("+avx512", "-avx512").replace("+avx10", "-avx10")
    )
    return target_machine(llvm.get_process_triple(), llvm.get_host_cpu_name(), features)


def target_machine(triple: str, cpu: str = "", features: str = "") -> Any:
    """Return LLVM's target machine of a processor."""
    target = llvm.Target.from_triple(triple)
    return target.create_target_machine(
        opt=3, jit=True, cpu=cpu, features=features, reloc="default", codemodel="jitdefault"
    )


def optimised_object(code: str, machine: Any) -> bytes:
    """Compile intermediate code to object code: only reachable functions, optimised together and vectorised."""
    module = llvm.parse_assembly(code)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    for item in [*module.functions, *module.global_variables]:
        if not item.is_declaration and item.name != ENTRY:
            item.linkage = llvm.Linkage.internal
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.slp_vectorization = True
    options.loop_vectorization = True
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    called = {item.name for item in module.functions if item.is_declaration}
    foreign = {name for name in called if not name.startswith("llvm.") and name not in _ALLOWED}
    assert not foreign, f"the kernels call {sorted(foreign)}, which only numba knows"
    code_of_machine: bytes = machine.emit_object(module)
    return code_of_machine


def cache_folders() -> list[Path]:
    """Return the folders in which machine code is cached: next to the package, and in the user's cache folder.

    `XDG_CACHE_HOME` is used if it is an absolute path, as its specification requires; without a home folder the user
    has no cache.
    """
    folders = [Path(__file__).parent / "__pycache__"]
    stated = os.environ.get("XDG_CACHE_HOME", "")
    try:
        cache = Path(stated) if os.path.isabs(stated) else Path.home() / ".cache"
    except RuntimeError:
        return folders
    return [*folders, cache / "pisigma"] if cache.is_absolute() else folders


def read_code(path: Path) -> bytes | None:
    """Read code from a file; return None if it is missing or damaged, or other users could have written it."""
    try:
        if not _trusted(os.stat(path.parent)):
            return None
        # without O_BINARY, Windows would translate line ends, so that the hash would never fit
        flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        with open(os.open(path, flags), "rb") as stream:
            status = os.fstat(stream.fileno())
            content = stream.read() if stat.S_ISREG(status.st_mode) and _trusted(status) else b""
    except OSError:
        return None
    code = content[32:]
    return code if code and hashlib.sha256(code).digest() == content[:32] else None


def write_code(path: Path, code: bytes) -> bool:
    """Write a file completely or not at all, in a folder that only the user can access; return success."""
    try:
        _make_private(path.parent)
        if not _trusted(os.stat(path.parent)):
            return False
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as stream:
            stream.write(hashlib.sha256(code).digest() + code)
        os.chmod(stream.name, 0o644)
        os.replace(stream.name, path)
    except OSError:
        return False
    return True


def _make_private(folder: Path) -> None:
    """Create a folder and its missing parents, accessible by the user only."""
    if not folder.is_dir():
        if folder.parent != folder:
            _make_private(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)


def _trusted(status: os.stat_result) -> bool:
    """Return whether a file or folder belongs to the user or root, and nobody else can write to it."""
    if not hasattr(os, "geteuid"):  # Windows, where a user's folders are not accessible to others
        return True
    return status.st_uid in (0, os.geteuid()) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
