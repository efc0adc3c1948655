"""Make the kernels' intermediate code with numba, with the features that are registered.

`python -m pisigma.joint_correction.registry` registers those of the package and writes what comes with it.

The code is that of no processor in particular, and without vectors: 64-bit machines lay out the kernels' structs alike,
and the machine that loads it says which processor it has and makes the vectors.
"""

import re
import sys
from importlib.metadata import version

from pisigma.kernels.features import FORMS
from pisigma.kernels.ready import FILE, write_ready

ENTRY = "pisigma_run"
"""Name of the one function in the code that is called from outside."""
ARGUMENTS = "ppiippipiiiipi"
"""Of `kernels.run`: p for a pointer, i for a number."""

_MACHINE = re.compile(r"^target (?:triple|datalayout) = .*\n", re.MULTILINE)
_NO_PROCESSOR = {"CPU_NAME": "generic", "CPU_FEATURES": "", "LOOP_VECTORIZE": 0, "SLP_VECTORIZE": 0}
"""Settings of numba."""
_NEWER = re.compile(r" captures\([^)]*\)| nocreateundeforpoison| memory\([^)]*(?:errnomem|target_mem)[^)]*\)")
"""Words that LLVM 20, the oldest that is to read the code, does not know; they only help to optimise."""
_LIFETIME = re.compile(r"^.*@llvm\.lifetime\..*\n", re.MULTILINE)
"""Hints on how long memory on the stack is needed, which LLVM 20 and 22 write differently."""
_MANGLED = re.compile(r"(?<=[@\"])_ZN[\w.$]+")
"""Names of functions that numba makes up from the types of all arguments."""


def intermediate_code() -> str:
    """What numba makes of the kernels with all features of `kernels.features.FORMS`.

    Returns:
        Text of LLVM with the entry `ENTRY`.

    Raises:
        ImportError: numba is not installed.
    """
    from numba import cfunc, config, from_dtype, types

    for name, value in _NO_PROCESSOR.items():
        setattr(config, name, value)

    for name, module in list(sys.modules.items()):
        if name.startswith("pisigma.kernels.") and hasattr(module, "njit"):
            del sys.modules[name]  # its kernels may have been made for other features
    from pisigma.kernels.kernels import run
    from pisigma.kernels.layout import DESCRIPTION, MEMORY

    structs = iter((from_dtype(DESCRIPTION), from_dtype(MEMORY)))
    arguments = []
    for kind in ARGUMENTS:
        pointed = next(structs, types.float64) if kind == "p" else None
        arguments.append(types.CPointer(pointed) if pointed else types.int64)  # type: ignore[no-untyped-call]
    text: str = cfunc(types.int64(*arguments))(run).inspect_llvm()
    match = re.search(r"@(cfunc\.)([\w.$]+)\(", text)
    assert match is not None
    text = text.replace(match[2], ENTRY)
    for pattern in (_MACHINE, _NEWER, _LIFETIME):
        text = pattern.sub("", text)
    names = {name: f"f{index}" for index, name in enumerate(dict.fromkeys(_MANGLED.findall(text)))}
    return _MANGLED.sub(lambda found: names[found[0]], text)


def build() -> None:
    """Write what comes with the package, and say how large it is."""
    code = intermediate_code()
    write_ready(code, tuple(FORMS), numba=version("numba"), llvmlite=version("llvmlite"))
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB ({len(code) / 1e6:.1f} MB of text)")
