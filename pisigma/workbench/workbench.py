"""The server of a cell's page, which answers requests with tabs, starts steps, and shows their results."""

import asyncio
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from aiohttp import web
from aiohttp.typedefs import Handler

from pisigma.files.errors import PisigmaError, PlanningError
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.layout import CELL_FILE
from pisigma.lifetime.cell.status import CellStatus
from pisigma.measurement.dataset import Measurements
from pisigma.planning.session.state import SessionState
from pisigma.workbench import steps
from pisigma.workbench.cell_scene import CellScene
from pisigma.workbench.job import Jobs, Outcome
from pisigma.workbench.model_server import ModelServer
from pisigma.workbench.server.answers import form_of, person_of, with_error_answers
from pisigma.workbench.server.front_server import FrontServer
from pisigma.workbench.server.viser_server import ViserBackend
from pisigma.workbench.tabs import TABS, Tabs, download_of
from pisigma.workbench.uploaded_rows import UploadedRowsHandler
from pisigma.workbench.uploads import Uploads
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.cell_file import CellFile

Form = Mapping[str, str]
_STATUS_AGE = 5.0
"""Age after which the status is read again [s], because commands may change the cell, too."""
_STATIC = {
    "workbench.js": ("text/javascript", "pisigma.workbench", "static"),
    "workbench.css": ("text/css", "pisigma.workbench", "static"),
    "copies.js": ("text/javascript", "pisigma.reporting", "page"),
}
"""Type, package and folder of the files of the page."""
_MODEL_STEPS = ("calibrate", "verify", "recalibrate", "use")
"""Steps that add a model or put one into use."""
_NO_CELL = {"state": "no_cell", "reason": "the folder has no cell yet", "command": "pisigma new"}
"""Next step of a folder without a cell."""
_STATE_CHECKS = 30
"""Number of times that a waiting request for the state is checked."""
_BROKEN = "broken_cell"
"""State of a cell whose `cell.yaml` cannot be used."""
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; "
    "frame-ancestors 'self'"
)
"""Content security policy for reports, whose scripts cannot reach the page that shows them."""
_MAX_COMMAND = 2000
"""Longest command line that is shown."""


class Workbench(UploadedRowsHandler):
    """Page of a cell until it is closed: `with Workbench(folder) as bench: print(bench.url)`.

    Attributes:
        folder: folder of the cell.
        jobs: the running step, and the last outcomes.
        url: link to the page, with its token.
        growing_file: file to which an instrument writes rows; None for none.
    """

    def __init__(
        self, folder: Path, host: str = "127.0.0.1", port: int = 8080, growing: Path | None = None
    ) -> None:
        """Start serving.

        Args:
            folder: folder of the cell; if it does not exist or is empty, the page creates the cell.
            host: address to listen on; at 127.0.0.1 only this machine can open the page.
            port: port to listen on; if it is in use, the next free port.
            growing: file to which an instrument writes rows; None for none.

        Raises:
            ImportError: viser or aiohttp is not installed.
            OutputError: the host is not an address of this machine.
            PlanningError: the folder is not a cell, and not empty.
        """
        self.folder, self._has_cell, self.growing_file = folder, False, growing
        cell = self._cell() if self._fault() is None else None
        self._status: tuple[CellStatus | None, float] = None, -math.inf
        if cell is not None:
            self._status = cell.status(), time.monotonic()
        self._reading, self._texts = threading.Lock(), dict[str, str]()
        self.jobs, self._uploads = Jobs(), Uploads()
        self._tabs = Tabs(self.jobs, ModelServer(folder), growing)
        self._behind = ViserBackend("pisigma")
        try:
            self._scene = CellScene(self._behind.server)
            if cell is not None:
                self._scene.show_cell(cell)
            self._front = FrontServer(self._pages(), host, port, self._behind.close_sockets)
        except BaseException:
            self._behind.close()
            self._uploads.close()
            raise
        self.url = self._front.url

    def __enter__(self) -> "Workbench":
        """Return the workbench."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the running step, wait until it has ended, and stop serving."""
        self.jobs.close()
        self._tabs.serving.stop()
        self._behind.close()
        self._front.close()
        self._uploads.close()

    def _pages(self) -> dict[tuple[str, str], Handler]:
        return {
            ("GET", "/"): self._page,
            ("GET", "/tab/{name}"): self._tab,
            ("GET", "/state"): self._state,
            ("GET", "/static/{name}"): self._static,
            ("GET", "/download/{kind}/{tail:.+}"): self._download,
            ("POST", "/upload"): self._upload,
            ("POST", "/propose"): self._propose,
            ("POST", "/check"): self._check,
            ("POST", "/show"): self._show,
            ("POST", "/step/{name}"): self._step,
            ("POST", "/stop"): self._stop,
            ("POST", "/drag"): self._drag,
            **self._behind.pages("/scene"),
        }

    def status(self) -> CellStatus | None:
        """Return the status of the cell, which is read again after a few seconds and after every step.

        The status is None until there is a cell.
        """
        with self._reading:
            found, when = self._status
            if time.monotonic() - when > _STATUS_AGE:
                cell, before = self._cell(), found
                found = None if cell is None else cell.status()
                self._status = found, time.monotonic()
                self.jobs.version += found != before
            return found

    @with_error_answers
    async def _page(self, request: web.Request) -> web.StreamResponse:
        def page() -> str:
            fault = self._fault()
            return self._tabs.render_page(
                self.folder, self._cell() if fault is None else None, fault is not None
            )

        text = await asyncio.to_thread(page)
        return web.Response(text=text, content_type="text/html")

    @with_error_answers
    async def _tab(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]

        def tab() -> str:
            if (fault := self._fault()) is not None:
                return self._tabs.render_repair_form(self.folder, fault)
            if (cell := self._cell()) is None or (status := self.status()) is None:
                return self._tabs.render_new_cell_form(self.folder)
            return self._tabs.render_tab(name, cell, status, self._texts)

        if name not in TABS:
            raise web.HTTPNotFound
        text = await asyncio.to_thread(tab)
        return web.Response(text=self._uploads.without_folder(text), content_type="text/html")

    @with_error_answers
    async def _state(self, request: web.Request) -> web.StreamResponse:
        # while a step runs, changes are answered at once, and progress after 0.3 s
        for _ in range(_STATE_CHECKS):
            if self.jobs.running is None or request.query.get("version") != str(self.jobs.version):
                break
            await asyncio.sleep(0.3 / _STATE_CHECKS)
        following = await asyncio.to_thread(self._next)
        job, version, ended = self.jobs.state()
        running = job and {
            "step": job.step,
            "person": job.started_by,
            "what": job.activity,
            "started": job.start_time,
            "stopped_by": job.stopped_by,
        }
        said = {
            "version": version,
            "ended": ended,
            "running": running,
            "next": following,
            "dragged": self._scene.dragged_values(),
        }
        return web.json_response(said)

    async def _static(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in _STATIC:
            raise web.HTTPNotFound
        kind, package, folder = _STATIC[name]
        text = resources.files(package).joinpath(folder, name).read_text(encoding="utf-8")
        return web.Response(text=text, content_type=kind)

    @with_error_answers
    async def _download(self, request: web.Request) -> web.StreamResponse:
        kind, names = request.match_info["kind"], tuple(request.match_info["tail"].split("/"))
        path = await asyncio.to_thread(lambda: download_of(Cell.open(self.folder), kind, names))
        shown = "inline" if path.suffix in (".png", ".svg", ".html") else "attachment"
        response = web.FileResponse(path)
        if path.suffix == ".html":
            response.headers["Content-Security-Policy"] = _REPORT_POLICY
        response.headers["Content-Disposition"] = f"{shown}; filename*=UTF-8''{quote(path.name)}"
        return response

    @with_error_answers
    async def _drag(self, request: web.Request) -> web.StreamResponse:
        is_on = "on" in await form_of(request)
        turn = await asyncio.to_thread(lambda: self._scene.show_cell(Cell.open(self.folder), is_on))
        return web.json_response({"turn": turn})

    @with_error_answers
    async def _stop(self, request: web.Request) -> web.StreamResponse:
        self.jobs.stop(person_of(request), (await form_of(request)).get("ended", ""))
        return web.json_response({})

    @with_error_answers
    async def _step(self, request: web.Request) -> web.StreamResponse:
        name, form = request.match_info["name"], await form_of(request)
        if name not in (*STEPS, "new", "cell"):
            raise web.HTTPNotFound

        def run(progress: Progress) -> Outcome:
            try:
                if name == "new":
                    return self._create(form)
                if name == "cell":
                    return self._write_cell(form)
                found = STEPS[name](self, Cell.open(self.folder), form, progress)
                if name in _MODEL_STEPS:
                    self._scene.show_errors(Cell.open(self.folder))
                return found
            except PisigmaError as problem:
                field = problem.option or str(problem.column or "")
                return Outcome(refusal=self._uploads.without_folder(str(problem)), refused_field=field)
            finally:
                with self._reading:  # values that were read before the step ended are out of date
                    self._status = self._status[0], -math.inf

        self.jobs.start(name, person_of(request), form.pop("command", "")[:_MAX_COMMAND], run)
        return web.json_response({"started": name})

    def _next(self) -> dict[str, Any]:
        """Return what to do next as plain values."""
        if (fault := self._fault()) is not None:
            return {"state": _BROKEN, "reason": fault.rstrip("."), "command": ""}
        status = self.status()
        return _NO_CELL if status is None else status.step.to_json()

    def _fault(self) -> str | None:
        """Return why `cell.yaml` cannot be used; None if it can be used, or if there is no such file."""
        if (self.folder / CELL_FILE).is_file():
            try:
                CellFile.read(self.folder)
            except PisigmaError as problem:
                return str(problem)
        return None

    def _cell(self) -> Cell | None:
        """Return the cell; None if the folder does not exist or is empty, and had no cell so far."""
        is_free = not os.path.lexists(self.folder) or (
            self.folder.is_dir() and not any(self.folder.iterdir())
        )
        if is_free and not self._has_cell:
            return None
        self._has_cell = True
        return Cell.open(self.folder)

    def _create(self, form: Form) -> Outcome:
        """Create the cell, and show it."""
        files = self._uploads.paths([form["file"]] if "file" in form else [])
        self._scene.show_cell(steps.create(self.folder, form, files))
        return Outcome()

    # What steps need besides the cell: uploaded files, the scene, and files to download.

    def import_rows(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Add uploaded rows as a session."""
        progress("reading the rows")
        return steps.import_session(self._incoming(cell, form), form)

    def plan(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Plan poses, and show them."""
        found = steps.plan(cell, form, progress)
        self._scene.show_cell(cell)
        return found

    def measure(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Check the rows of a session against the plan, and show their errors."""
        found, state = steps.check_rows(cell, form, progress)
        self._scene.show_state(state)
        return found

    def follow(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Follow the growing file until a person stops it, and show every row."""

        def arrived(rows: Measurements) -> None:
            self._scene.add_rows(rows.q.numpy())
            assert self._tabs.live is not None  # the state at the start has already been shown
            count = self._tabs.live["rows"] + rows.rows
            self._tabs.live |= {"rows": count, "unchecked": rows.rows}
            self.jobs.version += 1

        def show(state: SessionState) -> None:
            self._scene.show_state(state)
            self._tabs.live = {**state.to_json(), "unchecked": 0}
            self.jobs.version += 1

        if self.growing_file is None:
            raise PlanningError("no file is followed", remedy="open the page with --rows FILE")
        try:
            return steps.follow_file(cell, self.growing_file, arrived, show, progress)
        finally:
            self._tabs.live = None

    def export(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Export the model in use."""
        progress("exporting")
        files = {
            key: self._uploads.paths([form[key]])[0]
            for key in ("poses", "program", "frames")
            if form.get(key)
        }
        return steps.export(cell, form, files)

    def serve(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Start or stop the server of the model in use."""
        if "off" in form:
            self._tabs.serving.stop()
        else:
            progress("starting the server")
            self._tabs.serving.start(cell.robot)
        return Outcome()

    def try_pose(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Compute the joint values of a pose, and show the arm in this configuration."""
        progress("computing joint values")
        found, solution = steps.try_pose(cell, form)
        if not found.refusal:
            self._scene.show_pose(np.asarray(solution.q[0]))
        return found

    def _write_cell(self, form: Form) -> Outcome:
        """Write `cell.yaml`, whose previous text may be invalid, and show the cell."""
        steps.write_cell(self.folder, form, self._texts)
        self._scene.show_cell(Cell.open(self.folder))
        return Outcome()


STEPS: dict[str, Callable[[Workbench, Cell, Form, Progress], Outcome]] = {
    "plan": Workbench.plan,
    "import": Workbench.import_rows,
    "measure": Workbench.measure,
    "follow": Workbench.follow,
    "calibrate": lambda _, *given: steps.calibrate(*given),
    "verify": lambda _, *given: steps.verify(*given),
    "monitor": lambda _, *given: steps.monitor(*given),
    "recalibrate": lambda _, *given: steps.recalibrate(*given),
    "export": Workbench.export,
    "ik": Workbench.try_pose,
    "serve": Workbench.serve,
    "report": lambda _, *given: steps.report_cell(*given),
    "event": lambda _, *given: steps.record_event(*given),
    "controller": lambda _, *given: steps.set_active_export(*given),
    "use": lambda _, *given: steps.use(*given),
    "session": lambda _, *given: steps.set_aside(*given),
    "restore_session": lambda _, *given: steps.restore_session(*given),
}
"""Functions of steps by the names of their commands."""
