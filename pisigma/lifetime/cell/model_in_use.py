"""Follow the model in use of a cell with a background thread that looks for changes of the history."""

import os
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pisigma.files.errors import PisigmaError
from pisigma.lifetime.cell.controller import Findings, findings
from pisigma.lifetime.cell.history import HISTORY, History
from pisigma.lifetime.cell.layout import model_folder

INTERVAL = 0.1
"""Time between two checks of the history [s], each of which is one `os.stat`."""
SETTLED = 0.05
"""Age above which the time of a file's last change is unambiguous [s], because file systems round it."""


class ModelInUse:
    """The model in use of a cell.

    Changes are found with `os.stat`, because opening the file a second time would end SQLite's locks of this process.

    Attributes:
        cell: folder of the cell.
        folder: folder of the model loaded last.
        problem: reason why the model in use is not loaded; empty if it is loaded.
        findings: consequences of the exports that are active on the controller; after a refusal, no model must be used.
    """

    def __init__(self, cell: Path, command: str, load: Callable[[Path], None]) -> None:
        """Load the model in use.

        Args:
            cell: folder of the cell.
            command: command that uses the model, a key of `controller.RULES`.
            load: function that loads a model folder and replaces the model that answers. If it raises an error, the
                previous model continues to answer.

        Raises:
            ModelError: no model is in use, the model cannot be loaded, or it must not be used with an export that is
                active on the controller.
        """
        self.cell, self._command, self._load, self.problem = cell, command, load, ""
        self._lock, self._is_followed = threading.Lock(), False
        self._seen: tuple[int, int, int] | None = None  # the first check reads the history again
        self.folder = model_folder(cell)
        self.findings = self._find()
        self.findings.checked_warnings(cell)
        load(self.folder)

    def load_if_changed(self, retry_failed: bool = False) -> None:
        """Load the model in use if it has changed.

        Args:
            retry_failed: whether to also retry a model that could not be loaded before, and reload the same model if it
                was changed.
        """
        with self._lock:
            state = self._state()
            if state is not None and state == self._seen and not retry_failed:
                return
            is_settled = state is None or time.time_ns() - state[1] > SETTLED * 1e9
            try:
                self.findings = self._find()
                self._seen = state if is_settled else None  # without findings, the next check tries again
                folder = model_folder(self.cell)
                if retry_failed or folder != self.folder:
                    self._load(folder)
                self.folder, self.problem = folder, ""
            except (PisigmaError, OSError) as problem:
                self.problem = str(problem)

    def follow(self, report: Callable[[str], None] = lambda sentence: None) -> None:
        """Look for changes in a background thread until `stop` is called or this object is no longer used.

        Args:
            report: function that is called with every new sentence of `warnings`.
        """
        self._is_followed, followed = True, weakref.ref(self)
        _start_following(followed, report)
        if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
            os.register_at_fork(after_in_child=lambda: _start_following(followed, report))

    def stop(self) -> None:
        """Stop looking for changes."""
        self._is_followed = False

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings for the user: a refusal of the model, the reason why it is not loaded, and warnings."""
        return tuple(filter(None, (self.findings.refusal, self.problem, *self.findings.warnings)))

    def _find(self) -> Findings:
        """Return the findings for the model in use with the exports that are active on the controller."""
        history = History(self.cell / HISTORY)
        return findings(history, self._command, history.in_use)

    def _state(self) -> tuple[int, int, int] | None:
        """Return values that change with every change of the history; None if there is no history."""
        try:
            found = os.stat(self.cell / HISTORY)
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_size


def _start_following(followed: "weakref.ref[ModelInUse]", report: Callable[[str], None]) -> None:
    """Start the thread, also in a forked process, which has no thread and possibly a lock that is never released."""
    if (model := followed()) is not None and model._is_followed:
        model._lock = threading.Lock()
        threading.Thread(target=_follow, args=(followed, report), daemon=True).start()


def _follow(followed: "weakref.ref[ModelInUse]", report: Callable[[str], None]) -> None:
    """Check for changes until the object is stopped or deleted."""
    reported: tuple[str, ...] = ()
    while True:
        time.sleep(INTERVAL)
        model = followed()
        if model is None or not model._is_followed:
            return
        model.load_if_changed()
        for sentence in model.warnings:
            if sentence not in reported:
                with suppress(OSError, ValueError):  # the reports are no longer read
                    report(sentence)
        reported = model.warnings
        del model
