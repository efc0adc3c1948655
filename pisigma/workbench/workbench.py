"""The server of a cell's page: answers requests with tabs, starts steps, and shows their results."""

import asyncio
import functools
import json
import math
import os
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web
from aiohttp.typedefs import Handler

from pisigma.files.errors import (
    PisigmaError,
    system_fault,
)
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.status import CellStatus
from pisigma.robot.urdf_file import read_urdf
from pisigma.workbench import steps
from pisigma.workbench.cell_scene import CellScene
from pisigma.workbench.job import BusyError, Jobs, Outcome
from pisigma.workbench.server.front_server import FrontServer
from pisigma.workbench.server.viser_server import ViserBackend
from pisigma.workbench.tabs import TABS, Tabs, download_of
from pisigma.workbench.uploads import Uploads
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.exports import NONE, set_controller

Form = Mapping[str, str]
STATUS_AGE = 5.0
"""Age after which the status is read again [s], because commands may change the cell as well."""
STATIC = {
    "workbench.js": ("text/javascript", "pisigma.workbench", "static"),
    "workbench.css": ("text/css", "pisigma.workbench", "static"),
    "copies.js": ("text/javascript", "pisigma.reporting", "page"),
}
"""Type, package and folder of the files of the page."""
NO_CELL = {"state": "no_cell", "reason": "the folder has no cell yet", "command": "pisigma new"}
"""Next step of a folder without a cell."""
MAX_PERSON, MAX_COMMAND = 60, 2000
"""Longest name of a person, and longest command line that is shown."""


def answers(function: Callable[["Workbench", web.Request], Awaitable[web.StreamResponse]]) -> Any:
    """Answer a refused input with its message, and a request during a step with the person who started it."""

    @functools.wraps(function)
    async def answer(self: "Workbench", request: web.Request) -> web.StreamResponse:
        try:
            return await function(self, request)
        except PisigmaError as problem:
            fields = {
                "error": self._uploads.without_folder(str(problem)),
                "field": problem.option or str(problem.column or ""),
            }
            return web.json_response(fields, status=422)
        except (OSError, MemoryError) as problem:
            if not (fault := system_fault(problem)):
                raise
            return web.json_response({"error": self._uploads.without_folder(fault), "field": ""}, status=422)
        except BusyError:
            job = self.jobs.running
            who = "somebody" if job is None else f"{job.person}: {job.step}"
            return web.json_response(
                {"error": f"another step is running ({who}); wait for its end."}, status=409
            )

    return answer


class Workbench:
    """Page of a cell until it is closed: `with Workbench(folder) as bench: print(bench.url)`.

    Attributes:
        folder: folder of the cell.
        jobs: the step that runs, and the last outcomes.
        url: link to the page, with its token.
    """

    def __init__(self, folder: Path, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start serving.

        Args:
            folder: folder of the cell; if it does not exist or is empty, the page creates the cell.
            host: address to listen on; at 127.0.0.1 only this machine can open the page.
            port: port to listen on; if it is taken, the next free one.

        Raises:
            ImportError: viser or aiohttp is not installed.
            OutputError: the host is not an address of this machine.
            PlanningError: the folder is not a cell, and not empty.
        """
        self.folder, self._has_cell = folder, False
        cell = self._cell()
        self._status = None if cell is None else cell.status(), time.monotonic()
        self._reading, self._texts = threading.Lock(), dict[str, str]()
        self.jobs, self._uploads = Jobs(), Uploads()
        self._tabs = Tabs(self.jobs)
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
        """Stop the running step, wait for its end, and stop serving."""
        self.jobs.close()
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
            ("POST", "/step/{name}"): self._step,
            ("POST", "/stop"): self._stop,
            ("POST", "/drag"): self._drag,
            **self._behind.pages("/scene"),
        }

    def status(self) -> CellStatus | None:
        """Return the status of the cell, which is read again after some seconds and after every step.

        It is None until there is a cell.
        """
        with self._reading:
            found, when = self._status
            if time.monotonic() - when > STATUS_AGE:
                cell, before = self._cell(), found
                found = None if cell is None else cell.status()
                self._status = found, time.monotonic()
                self.jobs.version += found != before
            return found

    @answers
    async def _page(self, request: web.Request) -> web.StreamResponse:
        text = await asyncio.to_thread(lambda: self._tabs.page(self.folder, self._cell()))
        return web.Response(text=text, content_type="text/html")

    @answers
    async def _tab(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]

        def tab() -> str:
            if (cell := self._cell()) is None or (status := self.status()) is None:
                return self._tabs.new_cell(self.folder)
            return self._tabs.tab(name, cell, status, self._texts)

        if name not in TABS:
            raise web.HTTPNotFound
        text = await asyncio.to_thread(tab)
        return web.Response(text=text, content_type="text/html")

    @answers
    async def _state(self, request: web.Request) -> web.StreamResponse:
        status, job = await asyncio.to_thread(self.status), self.jobs.running
        running = job and {
            "step": job.step,
            "person": job.person,
            "what": job.what,
            "started": job.started,
            "stopped_by": job.stopped_by,
        }
        said = {
            "version": self.jobs.version,
            "ended": self.jobs.ended,
            "running": running,
            "next": NO_CELL if status is None else status.step.to_json(),
            "dragged": self._scene.dragged(),
        }
        return web.json_response(said)

    async def _static(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in STATIC:
            raise web.HTTPNotFound
        kind, package, folder = STATIC[name]
        text = resources.files(package).joinpath(folder, name).read_text(encoding="utf-8")
        return web.Response(text=text, content_type=kind)

    @answers
    async def _download(self, request: web.Request) -> web.StreamResponse:
        kind, names = request.match_info["kind"], tuple(request.match_info["tail"].split("/"))
        path = await asyncio.to_thread(lambda: download_of(Cell.open(self.folder), kind, names))
        shown = "inline" if path.suffix in (".png", ".svg") else "attachment"
        response = web.FileResponse(path)
        response.headers["Content-Disposition"] = f"{shown}; filename*=UTF-8''{_quoted(path.name)}"
        return response

    @answers
    async def _upload(self, request: web.Request) -> web.StreamResponse:
        content = await request.read()
        number = await asyncio.to_thread(self._uploads.add, request.query.get("name", ""), content)
        (path,) = self._uploads.paths([number])
        is_urdf = "links" in request.query and path.suffix.lower() in (".urdf", ".xacro")
        links = await asyncio.to_thread(lambda: [*read_urdf(path)[0].link_map]) if is_urdf else []
        return web.json_response({"file": number, "links": links})

    @answers
    async def _drag(self, request: web.Request) -> web.StreamResponse:
        is_on = "on" in await _form(request)
        turn = await asyncio.to_thread(lambda: self._scene.show_cell(Cell.open(self.folder), is_on))
        return web.json_response({"turn": turn})

    @answers
    async def _propose(self, request: web.Request) -> web.StreamResponse:
        form = await _form(request)

        def propose() -> str:
            cell, files = Cell.open(self.folder), self._uploads.paths(form.get("files", "").split(","))
            proposal = steps.propose_columns(files, cell, form)
            return self._tabs.proposal(proposal, files, form.get("files", ""))

        return web.Response(text=await asyncio.to_thread(propose), content_type="text/html")

    @answers
    async def _stop(self, request: web.Request) -> web.StreamResponse:
        self.jobs.stop(_person(request), (await _form(request)).get("ended", ""))
        return web.json_response({})

    @answers
    async def _step(self, request: web.Request) -> web.StreamResponse:
        name, form = request.match_info["name"], await _form(request)
        if name not in (*STEPS, "new"):
            raise web.HTTPNotFound

        def run(progress: Progress) -> Outcome:
            try:
                if name == "new":
                    return self._create(form)
                return STEPS[name](self, Cell.open(self.folder), form, progress)
            except PisigmaError as problem:
                field = problem.option or str(problem.column or "")
                return Outcome(refusal=self._uploads.without_folder(str(problem)), field=field)
            finally:
                with self._reading:  # a reading that began before the end of the step is out of date
                    self._status = self._status[0], -math.inf

        self.jobs.start(name, _person(request), form.pop("command", "")[:MAX_COMMAND], run)
        return web.json_response({"started": name})

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
        return steps.import_session(self._uploads.paths(form.get("files", "").split(",")), cell, form)

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

    def export(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Export the model in use."""
        progress("exporting")
        files = {
            key: self._uploads.paths([form[key]])[0]
            for key in ("poses", "program", "frames")
            if form.get(key)
        }
        return steps.export(cell, form, files)

    def try_pose(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Compute the joint values of a pose, and show the arm there."""
        progress("computing joint values")
        found, solution = steps.try_pose(cell, form)
        if not found.refusal:
            self._scene.show_pose(np.asarray(solution.q[0]))
        return found

    def write_cell(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Write `cell.yaml`, and show the cell."""
        steps.write_cell(cell, form, self._texts)
        self._scene.show_cell(Cell.open(cell.folder))
        return Outcome()

    def record(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Record an event."""
        cell.history.record(
            form.get("kind", ""), form.get("date", ""), form.get("note", ""), form.get("person", "")
        )
        return Outcome()

    def set_controller(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Record which export is active on the controller."""
        name = form.get("export", "")
        file = str(download_of(cell, "export", (name,))) if name else NONE
        set_controller(cell, file, form.get("date", ""), form.get("note", ""))
        return Outcome()

    def use(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Put a model into use."""
        warnings = cell.use(form.get("model") or None, form.get("reason", ""))
        return Outcome(refusal=" ".join(warnings))

    def set_aside(self, cell: Cell, form: Form, progress: Progress) -> Outcome:
        """Set a session aside."""
        cell.sessions.set_aside(form.get("session", ""), form.get("set_aside", ""))
        return Outcome()


STEPS: dict[str, Callable[[Workbench, Cell, Form, Progress], Outcome]] = {
    "plan": Workbench.plan,
    "import": Workbench.import_rows,
    "measure": Workbench.measure,
    "calibrate": lambda _, *given: steps.calibrate(*given),
    "verify": lambda _, *given: steps.verify(*given),
    "monitor": lambda _, *given: steps.monitor(*given),
    "recalibrate": lambda _, *given: steps.recalibrate(*given),
    "export": Workbench.export,
    "ik": Workbench.try_pose,
    "cell": Workbench.write_cell,
    "event": Workbench.record,
    "controller": Workbench.set_controller,
    "use": Workbench.use,
    "session": Workbench.set_aside,
}
"""Steps by the names of their commands."""


async def _form(request: web.Request) -> dict[str, str]:
    """Return the fields of a form.

    Raises:
        HTTPBadRequest: the body is not a JSON object of texts.
    """
    try:
        values = await request.json()
        json.dumps(values, ensure_ascii=False).encode()  # lone surrogates cannot be encoded
    except ValueError:
        raise web.HTTPBadRequest from None
    if not isinstance(values, dict) or not all(isinstance(one, str) for one in values.values()):
        raise web.HTTPBadRequest
    return values


def _person(request: web.Request) -> str:
    """Return the name that a person entered, or the address of the browser."""
    return request.query.get("person", "").strip()[:MAX_PERSON] or f"somebody at {request.remote}"


def _quoted(name: str) -> str:
    from urllib.parse import quote

    return quote(name)
