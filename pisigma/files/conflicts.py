"""What an output must not be: an input of the same call, or a part of a model folder."""

import os
from collections.abc import Iterable
from pathlib import Path

from pisigma.files.errors import OutputError
from pisigma.files.model_files import is_model

Input = str | os.PathLike[str] | None
"""A file or folder that a call reads; None and what is not there are passed over."""


def check_apart(output: str | os.PathLike[str], inputs: Iterable[Input], option: str = "--out") -> None:
    """Refuse an output that is, holds or lies in an input, by whatever links, or that lies in a model folder.

    Args:
        output: file or folder to write.
        inputs: files and folders that are read.
        option: which names the output, for complaints.

    Raises:
        OutputError: it does; the message names the two.
        OSError: a path cannot be looked at.
    """
    target = Path(os.path.realpath(output))
    for source in inputs:
        if source is None or not os.path.exists(source):
            continue
        for path in (Path(os.path.realpath(source)), Path(os.path.abspath(source))):
            if target == path or (target.exists() and os.path.samefile(target, path)):
                raise OutputError(f"{output}: is an input of this command; choose another {option}.")
            if path in target.parents:
                raise OutputError(
                    f"{output}: lies in {source}, an input of this command; choose another {option}."
                )
            if target in path.parents:
                raise OutputError(
                    f"{output}: holds {source}, an input of this command; choose another {option}."
                )
    for folder in target.parents:
        if is_model(folder):
            raise OutputError(f"{output}: lies in the model folder {folder}; choose another {option}.")
