"""The kernels' intermediate code that comes with the package, and the hash that ties it to their sources."""

import hashlib
import json
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FILE = Path(__file__).parent / "kernels.ll.zlib"
"""A line of JSON and the code as compressed text; `python -m pisigma.joint_correction.registry` writes it."""

_PYTHON = frozenset(
    ("__init__.py", "array_kinematics.py", "build.py", "description_file.py", "machine_code.py", "ready.py")
)
"""Files of this folder without kernels, and without anything that these know."""
_SHARED = ("kinematics/status.py", "kinematics/tolerances.py")
"""Files of other folders that kernels take constants from."""
_NO_CODE = re.compile(rb'"""[\s\S]*?"""|#[^\n]*|^[ \t]*\n', re.MULTILINE)


_FORMS = re.compile(rb"^@no_type_check\ndef [\s\S]*?(?=^(?:@|class |def |[A-Z_a-z])|\Z)", re.MULTILINE)
"""Compiled forms among the files of features."""


def source_files() -> list[Path]:
    """The files that the kernels are made from, without those of features."""
    package = Path(__file__).parent.parent
    kernels = sorted(path for path in (package / "kernels").glob("*.py") if path.name not in _PYTHON)
    return [*kernels, *(package / name for name in _SHARED)]


def source_hash() -> str:
    """SHA-256 of the sources without docstrings, comments and empty lines; of features only the compiled forms."""
    features = sorted((Path(__file__).parent.parent / "joint_correction").glob("*.py"))
    contents = [path.read_bytes() for path in source_files()]
    contents += [form for path in features for form in _FORMS.findall(path.read_bytes())]
    digest = hashlib.sha256()
    for content in contents:
        lines = _NO_CODE.sub(b"", content).split(b"\n")
        digest.update(b"\n".join(stripped for line in lines if (stripped := line.rstrip())) + b"\0")
    return digest.hexdigest()


def write_ready(code: str, features: Sequence[str], **made_with: str) -> None:
    """Write the intermediate code of the present sources.

    Args:
        code: text of LLVM.
        features: names of those that it evaluates, in order.
        made_with: versions of the compilers that made it.
    """
    header = json.dumps({"sources": source_hash(), "features": list(features), **made_with}, sort_keys=True)
    FILE.write_bytes(header.encode() + b"\n" + zlib.compress(code.encode(), 9))


def ready_features() -> tuple[str, ...] | None:
    """Names of the features that the code evaluates; None where `read_ready` gives None, but for damaged code."""
    header, _ = _content()
    return None if header is None else tuple(header["features"])


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
