"""Files that a page received, under unique names in a folder that only this user can enter."""

import itertools
import re
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

from pisigma.files.errors import MeasurementError, make_printable

_MAX_FILES = 20
"""Largest number of stored files; the oldest file is removed first."""
_MAX_NAME = 60
"""Longest name [characters]; file systems accept 255 bytes, and a character has up to four."""


class Uploads:
    """Uploaded files until the server ends."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pisigma-")  # the folder has mode 0700
        self._files: dict[str, Path] = {}
        self._lock = threading.Lock()
        self._numbers = map(str, itertools.count(1))  # several files may arrive at once

    def add(self, name: str, content: bytes) -> str:
        """Store an uploaded file; return the number by which it is requested.

        Args:
            name: name that the browser states; its folders are removed.
            content: content of the file.
        """
        shown = make_printable(name.replace("\\", "/").rpartition("/")[2].replace("\0", ""))[
            -_MAX_NAME:
        ].strip(". ")
        number = next(self._numbers)
        folder = Path(self._folder.name) / number
        folder.mkdir()
        path = folder / (shown or "upload.csv")
        path.write_bytes(content)
        with self._lock:
            self._files[number] = path
            removed = [self._files.pop(one) for one in [*self._files][:-_MAX_FILES]]
        for one in removed:
            one.unlink()
        return number

    def paths(self, numbers: Sequence[str]) -> list[Path]:
        """Return the files with some numbers.

        Raises:
            MeasurementError: the file does not exist.
        """
        for number in numbers:
            if number not in self._files:
                raise MeasurementError("the file no longer exists", value=number, remedy="upload it again")
        return [self._files[number] for number in numbers]

    def without_folder(self, text: str) -> str:
        """Return a message without the folder of uploaded files."""
        return re.sub(rf"{re.escape(self._folder.name)}/\d+/", "", text)

    def close(self) -> None:
        """Remove all files."""
        self._folder.cleanup()
