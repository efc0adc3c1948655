"""Intermediate code of the kernels, which numba compiles, stored in the package with a hash of the sources.

`python -m pisigma.joint_correction.registry` builds it with all features and closed forms. The code is for a generic
processor and not vectorised: all 64-bit machines have the same layout of the kernels' structs, and the machine that
loads the code compiles and vectorises it for its processor.
"""

import dataclasses
import hashlib
import json
import lzma
import re
import sys
from pathlib import Path
from typing import Any

from pisigma.robot.kernels.forms import KernelForms

FILE = Path(__file__).parent / "kernels.ll.xz"
"""One line of JSON and the compressed code; `python -m pisigma.joint_correction.registry` writes it."""
OBJECT = Path(__file__).parent / "kernels.x86-64-v3.o.xz"
"""The code as machine code for Linux on x86-64-v3, in the same form and written by the same command."""

_PYTHON = frozenset(
    ("__init__.py", "array_kinematics.py", "build.py", "description_file.py", "machine_code.py")
)
"""Files of this folder that contain neither kernels nor constants of kernels."""
_SHARED = ("kinematics/status.py", "kinematics/tolerances.py")
"""Files of other folders that contain constants of kernels."""
_NO_CODE = re.compile(rb'"""[\s\S]*?"""|#[^\n]*|^[ \t]*\n', re.MULTILINE)


_FORMS = re.compile(rb"^@no_type_check\ndef [\s\S]*?(?=^(?:@|class |def |[A-Z_a-z])|\Z)", re.MULTILINE)
"""Pattern of the files of features and closed forms with compiled forms."""


def source_files() -> list[Path]:
    """Return the source files of the kernels, excluding the files of features and closed forms."""
    robot = Path(__file__).parent.parent
    kernels = sorted(path for path in (robot / "kernels").glob("*.py") if path.name not in _PYTHON)
    return [*kernels, *(robot / name for name in _SHARED)]


def source_hash() -> str:
    """Return the SHA-256 of kernels and compiled forms, without docstrings, comments and empty lines."""
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


def write_intermediate_code(code: str, forms: KernelForms, **made_with: str) -> None:
    """Write the intermediate code of the current sources.

    Args:
        code: LLVM text.
        forms: features and closed forms that the code evaluates.
        made_with: versions of the compilers.
    """
    _write(FILE, code.encode(), forms=dataclasses.asdict(forms), **made_with)


def write_object(code: bytes, **made_with: str) -> None:
    """Write the machine code of the current intermediate code.

    Args:
        code: object file.
        made_with: versions of the compilers.
    """
    _write(OBJECT, code, intermediate_sha256=hashlib.sha256(FILE.read_bytes()).hexdigest(), **made_with)


def _write(file: Path, code: bytes, **stated: Any) -> None:
    header = json.dumps({"sources": source_hash(), **stated}, sort_keys=True)
    file.write_bytes(header.encode() + b"\n" + lzma.compress(code, preset=9 | lzma.PRESET_EXTREME))


def stored_code_forms() -> KernelForms | None:
    """Return the forms that the stored code evaluates; None if it is missing or belongs to other sources."""
    header, _ = _content(FILE)
    return None if header is None else KernelForms(**{kind: tuple(n) for kind, n in header["forms"].items()})


def read_intermediate_code() -> str | None:
    """Return the stored intermediate code; None if it is missing or damaged, or if the sources have changed."""
    header, code = _content(FILE)
    try:
        return None if header is None else lzma.decompress(code).decode()
    except (ValueError, EOFError, lzma.LZMAError):
        return None


def read_object() -> bytes | None:
    """Return the stored machine code; None if it is missing, damaged or not that of the intermediate code."""
    header, code = _content(OBJECT)
    try:
        if header is None or header["intermediate_sha256"] != hashlib.sha256(FILE.read_bytes()).hexdigest():
            return None
        return lzma.decompress(code)
    except (KeyError, OSError, EOFError, lzma.LZMAError):
        return None


def _content(file: Path) -> tuple[dict[str, Any] | None, bytes]:
    """Return the parsed first line of a file, if it belongs to the current sources, and the compressed code."""
    try:
        stated, _, code = file.read_bytes().partition(b"\n")
        header = json.loads(stated)
        return (header, code) if header["sources"] == source_hash() else (None, b"")
    except (OSError, ValueError, KeyError, TypeError):
        return None, b""


ENTRY = "pisigma_run"
"""Name of the only exported function of the code."""
ARGUMENTS = "ppiippipipiiiipi"
"""Types of the arguments of `kernels.run`: p for a pointer, i for an integer."""

_MACHINE = re.compile(r"^target (?:triple|datalayout) = .*\n", re.MULTILINE)
_NO_PROCESSOR = {"CPU_NAME": "generic", "CPU_FEATURES": "", "LOOP_VECTORIZE": 0, "SLP_VECTORIZE": 0}
"""Settings of numba for a generic processor."""
_NEWER = re.compile(r" captures\([^)]*\)| nocreateundeforpoison| memory\([^)]*(?:errnomem|target_mem)[^)]*\)")
"""Attributes that LLVM 20, the oldest supported version, does not know; they only enable optimisations."""
_LIFETIME = re.compile(r"^.*@llvm\.lifetime\..*\n", re.MULTILINE)
"""Pattern of lifetime hints of stack memory, which LLVM 20 and 22 write differently."""
_MANGLED = re.compile(r"(?<=[@\"])_ZN[\w.$]+")
"""Pattern of function names that numba mangles with the types of all arguments."""
_COMMENT = re.compile(r" *;[^\n\"]*$", re.MULTILINE)
_FUNCTION = re.compile(r"^define[\s\S]*?^}$", re.MULTILINE)
_LOCAL = re.compile(r"(?<=%)(?:\"[^\"]+\"|[\w.$-]+)|^(?:\"[^\"]+\"|[\w.$-]+)(?=:)", re.MULTILINE)
"""Pattern of the names of values and blocks in a function."""


def intermediate_code() -> str:
    """Compile the kernels with all registered features and closed forms by numba.

    Returns:
        LLVM text with the entry `ENTRY`.

    Raises:
        ImportError: numba is not installed.
    """
    from numba import cfunc, config, from_dtype, types

    for name, value in _NO_PROCESSOR.items():
        setattr(config, name, value)

    for name, module in list(sys.modules.items()):
        if name.startswith("pisigma.robot.kernels.") and hasattr(module, "kernel"):
            del sys.modules[name]  # imported kernels may have been compiled for other forms
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
    return with_short_names(_MANGLED.sub(lambda found: names[found[0]], text))


def with_short_names(text: str) -> str:
    """Shorten the names of values and blocks, and leave comments out, which takes a fifth of the compressed bytes."""

    def shortened(function: re.Match[str]) -> str:
        names: dict[str, str] = {}
        return _LOCAL.sub(lambda one: names.setdefault(one[0].strip('"'), f"v{len(names):x}"), function[0])

    return _FUNCTION.sub(shortened, _COMMENT.sub("", text))


def build() -> None:
    """Compile the intermediate code, write it into the package, and print its size."""
    from importlib.metadata import version

    code = intermediate_code()
    write_intermediate_code(
        code, KernelForms.registered(), numba=version("numba"), llvmlite=version("llvmlite")
    )
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB ({len(code) / 1e6:.1f} MB of text)")
