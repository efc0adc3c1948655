"""Detect conflicts between an output and an input of the same call or a model folder."""

import os
from collections.abc import Iterable
from pathlib import Path

from pisigma.files.errors import OutputError, Place
from pisigma.files.model_files import is_model

Input = str | os.PathLike[str] | None
"""A file or folder that a call reads; None and missing paths are skipped."""


def check_conflicts(output: str | os.PathLike[str], inputs: Iterable[Input], option: str = "--out") -> None:
    """Check that an output is not, does not contain and is not inside an input or a model folder; resolve links.

    Args:
        output: file or folder to write.
        inputs: files and folders that the same call reads.
        option: option that names the output, for the message.

    Raises:
        OutputError: the output is in conflict; `file` is the output and `value` the input or model folder.
        OSError: a path cannot be accessed.
    """
    remedy = f"choose another {option}"
    target = Path(os.path.realpath(output))
    for source in inputs:
        if source is None or not os.path.exists(source):
            continue
        for path in (Path(os.path.realpath(source)), Path(os.path.abspath(source))):
            if target == path or (target.exists() and os.path.samefile(target, path)):
                problem, what = "the output is an input of this command", "a path that is not an input"
            elif path in target.parents:
                problem, what = (
                    f"the output is inside {source}, an input of this command",
                    "a path outside the inputs",
                )
            elif target in path.parents:
                problem, what = (
                    f"the output contains {source}, an input of this command",
                    "a folder without inputs",
                )
            else:
                continue
            value = os.fspath(source)
            raise OutputError(problem, expected=what, value=value, at=Place(output), remedy=remedy)
    for folder in target.parents:
        if is_model(folder):
            problem, what = f"the output is inside the model folder {folder}", "a path outside model folders"
            raise OutputError(problem, expected=what, value=str(folder), at=Place(output), remedy=remedy)
