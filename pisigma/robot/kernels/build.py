"""The kernels' intermediate code, which comes with the package: made by numba, and tied to the sources by a hash.

`python -m pisigma.joint_correction.registry` makes it, with all features and closed forms. The code is that of no
processor in particular, and without vectors: 64-bit machines lay out the kernels' structs alike, and the machine that
loads it says which processor it has and makes the vectors.
"""

import dataclasses
import hashlib
import json
import re
import sys
import zlib
from pathlib import Path
from typing import Any

from pisigma.robot.kernels.forms import KernelForms

FILE = Path(__file__).parent / "kernels.ll.zlib"
"""A line of JSON and the code as compressed text; `python -m pisigma.joint_correction.registry` writes it."""

_PYTHON = frozenset(
    ("__init__.py", "array_kinematics.py", "build.py", "description_file.py", "machine_code.py")
)
"""Files of this folder without kernels, and without anything that these know."""
_SHARED = ("kinematics/status.py", "kinematics/tolerances.py")
"""Files of other folders that kernels take constants from."""
_NO_CODE = re.compile(rb'"""[\s\S]*?"""|#[^\n]*|^[ \t]*\n', re.MULTILINE)


_FORMS = re.compile(rb"^@no_type_check\ndef [\s\S]*?(?=^(?:@|class |def |[A-Z_a-z])|\Z)", re.MULTILINE)
"""Compiled forms among the files of features and closed forms."""


def source_files() -> list[Path]:
    """The files that the kernels are made from, without those of features and closed forms."""
    robot = Path(__file__).parent.parent
    kernels = sorted(path for path in (robot / "kernels").glob("*.py") if path.name not in _PYTHON)
    return [*kernels, *(robot / name for name in _SHARED)]


def source_hash() -> str:
    """SHA-256 of the sources without docstrings, comments and empty lines; of features and closed forms these only."""
    robot = Path(__file__).parent.parent
    features = (robot.parent / "joint_correction").glob("*.py")
    forms = sorted([*features, *robot.glob("kinematics/closed_form/*.py")])
    contents = [path.read_bytes() for path in source_files()]
    contents += [form for path in forms for form in _FORMS.findall(path.read_bytes())]
    digest = hashlib.sha256()
    for content in contents:
        lines = _NO_CODE.sub(b"", content).split(b"\n")
        digest.update(b"\n".join(stripped for line in lines if (stripped := line.rstrip())) + b"\0")
    return digest.hexdigest()


def write_ready(code: str, forms: KernelForms, **made_with: str) -> None:
    """Write the intermediate code of the present sources.

    Args:
        code: text of LLVM.
        forms: what it evaluates.
        made_with: versions of the compilers that made it.
    """
    stated = {"sources": source_hash(), "forms": dataclasses.asdict(forms), **made_with}
    header = json.dumps(stated, sort_keys=True)
    FILE.write_bytes(header.encode() + b"\n" + zlib.compress(code.encode(), 9))


def ready_forms() -> KernelForms | None:
    """What the code evaluates; None where `read_ready` gives None, but for damaged code."""
    header, _ = _content()
    return None if header is None else KernelForms(**{kind: tuple(n) for kind, n in header["forms"].items()})


def read_ready() -> str | None:
    """The intermediate code; None where there is none, it is damaged, or the sources have changed since."""
    header, code = _content()
    try:
        return None if header is None else zlib.decompress(code).decode()
    except (ValueError, zlib.error):
        return None


def _content() -> tuple[dict[str, Any] | None, bytes]:
    """The first line of the file, where it is of the present sources, and the compressed code."""
    try:
        stated, _, code = FILE.read_bytes().partition(b"\n")
        header = json.loads(stated)
        return (header, code) if header["sources"] == source_hash() else (None, b"")
    except (OSError, ValueError, KeyError, TypeError):
        return None, b""


ENTRY = "pisigma_run"
"""Name of the one function in the code that is called from outside."""
ARGUMENTS = "ppiippipipiiiipi"
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
    """What numba makes of the kernels with all registered features and closed forms.

    Returns:
        Text of LLVM with the entry `ENTRY`.

    Raises:
        ImportError: numba is not installed.
    """
    from numba import cfunc, config, from_dtype, types

    for name, value in _NO_PROCESSOR.items():
        setattr(config, name, value)

    for name, module in list(sys.modules.items()):
        if name.startswith("pisigma.robot.kernels.") and hasattr(module, "kernel"):
            del sys.modules[name]  # its kernels may have been made for other forms
    from pisigma.robot.kernels.kernels import run
    from pisigma.robot.kernels.layout import DESCRIPTION, MEMORY

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
    from importlib.metadata import version

    code = intermediate_code()
    write_ready(code, KernelForms.registered(), numba=version("numba"), llvmlite=version("llvmlite"))
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB ({len(code) / 1e6:.1f} MB of text)")
