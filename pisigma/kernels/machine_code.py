"""The compiled kernels as machine code in a file, which a new process loads without numba.

numba takes a third of a second to import, and its own cache needs it. The kernels call nothing but the mathematical
functions of the C library, so their object code can be loaded by llvmlite alone.
"""

import ctypes
import functools
import hashlib
import os
import re
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite  # type: ignore[import-untyped]
import llvmlite.binding as llvm  # type: ignore[import-untyped]

_ENTRY = "pisigma_run"
_ARGUMENTS = "ppiippiiipi"
"""Of `kernels.run`: p for a pointer, i for a number."""
_ALLOWED = {
    "acos",
    "atan2",
    "ceil",
    "cos",
    "fabs",
    "floor",
    "hypot",
    "log",
    "memcpy",
    "memset",
    "pow",
    "sin",
    "sqrt",
}
"""Functions of the C library that every process has."""
_PYTHON = ("__init__.py", "description_file.py", "solution.py", "solver.py")
"""Files without kernels, and without anything that these know."""
_lock = threading.Lock()
_kept: list[Any] = []


def load_kernels() -> Callable[..., int]:
    """The function `kernels.run`, on addresses and numbers; -1, or what `kernels.solve_poses` says.

    It is compiled when it is first wanted on a machine, which takes about a minute, and read from a file afterwards.
    """
    with _lock:
        return _load()


@functools.cache
def _load() -> Callable[..., int]:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name = f"kernels-{_key()}.o"
    code = next((found for folder in _folders() if (found := _read(folder / name)) is not None), None)
    if code is None:
        code = _compile()
        for folder in _folders():
            if _write(folder / name, code):
                break
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _kept.append(engine)
    kinds = [ctypes.c_void_p if kind == "p" else ctypes.c_int64 for kind in _ARGUMENTS]
    prototype = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *kinds)
    native = prototype(engine.get_function_address(_ENTRY))
    return functools.partial(_call, native)


def _call(native: Any, *arguments: int) -> int:
    """Call the compiled function, which writes its result, and what was raised: nothing ever is."""
    result = (ctypes.c_int64 * 2)()
    address = ctypes.addressof(result)
    native(address, address + 8, *arguments)
    return result[0]


def _key() -> str:
    """What the code depends on: the files of this package but those of Python, the compiler and the processor."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(b"" if path.name in _PYTHON else path.read_bytes())
    features = llvm.get_host_cpu_features().flatten()
    for word in (llvmlite.__version__, llvm.get_process_triple(), llvm.get_host_cpu_name(), features):
        digest.update(word.encode() + b"\0")
    return digest.hexdigest()[:16]


def _folders() -> list[Path]:
    """Where machine code is kept: beside the package, or where that is not allowed with the user's other caches."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return [Path(__file__).parent / "__pycache__", Path(cache) / "pisigma"]


def _read(path: Path) -> bytes | None:
    """The code in a file, None where there is none or it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    code = content[32:]
    return code if hashlib.sha256(code).digest() == content[:32] else None


def _write(path: Path, code: bytes) -> bool:
    """Write a file whole or not at all; whether that succeeded."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as stream:
            stream.write(hashlib.sha256(code).digest() + code)
        os.chmod(stream.name, 0o644)
        os.replace(stream.name, path)
    except OSError:
        return False
    return True


def _target_machine() -> Any:
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        opt=3,
        jit=True,
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        reloc="default",
        codemodel="jitdefault",
    )


def _compile() -> bytes:
    """Have numba compile the kernels, and optimise what is called as one program, with vectors."""
    text, entry = _intermediate_code()
    module = llvm.parse_assembly(text.replace(entry, _ENTRY))
    for item in [*module.functions, *module.global_variables]:
        if not item.is_declaration and item.name != _ENTRY:
            item.linkage = llvm.Linkage.internal
    machine = _target_machine()
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.slp_vectorization = True
    options.loop_vectorization = True
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    called = {item.name for item in module.functions if item.is_declaration}
    foreign = {name for name in called if not name.startswith("llvm.") and name not in _ALLOWED}
    assert not foreign, f"the kernels call {sorted(foreign)}, which only numba knows"
    code: bytes = machine.emit_object(module)
    return code


def _intermediate_code() -> tuple[str, str]:
    """What numba makes of the kernels, and the name of the entry in it."""
    from numba import cfunc, from_dtype, types

    from pisigma.kernels.kernels import run
    from pisigma.kernels.layout import DESCRIPTION, MEMORY

    structs = iter((from_dtype(DESCRIPTION), from_dtype(MEMORY)))
    arguments = []
    for kind in _ARGUMENTS:
        pointed = next(structs, types.float64) if kind == "p" else None
        arguments.append(types.CPointer(pointed) if pointed else types.int64)  # type: ignore[no-untyped-call]
    text: str = cfunc(types.int64(*arguments))(run).inspect_llvm()
    match = re.search(r"@(cfunc\.)([\w.$]+)\(", text)
    assert match is not None
    return text, match[2]
