"""Requests for uploaded rows: settings for reading, findings of the check, and rows that the scene marks."""

import asyncio
import contextlib
from collections.abc import Mapping
from pathlib import Path

from aiohttp import web

from pisigma.files.errors import PisigmaError
from pisigma.planning.session.state import RowsSoFar
from pisigma.robot.urdf_file import read_urdf
from pisigma.workbench import steps
from pisigma.workbench.cell_scene import CellScene
from pisigma.workbench.server.answers import form_of, with_error_answers
from pisigma.workbench.tabs import Tabs, line_numbers_in
from pisigma.workbench.uploads import Uploads
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.incoming_rows import IncomingRows

_GROWING = "growing"
"""Name of the growing file in a form, instead of the number of an upload."""


class UploadedRowsHandler:
    """Answers to the requests of a page about uploaded rows.

    Attributes:
        folder: folder of the cell.
        growing_file: file to which an instrument writes rows; None for none.
    """

    folder: Path
    growing_file: Path | None
    _uploads: Uploads
    _tabs: Tabs
    _scene: CellScene

    @with_error_answers
    async def _upload(self, request: web.Request) -> web.StreamResponse:
        content = await request.read()
        number = await asyncio.to_thread(self._uploads.add, request.query.get("name", ""), content)
        (path,) = self._uploads.paths([number])
        is_urdf = "links" in request.query and path.suffix.lower() in (".urdf", ".xacro")
        links = await asyncio.to_thread(lambda: [*read_urdf(path)[0].link_map]) if is_urdf else []
        return web.json_response({"file": number, "links": links})

    @with_error_answers
    async def _propose(self, request: web.Request) -> web.StreamResponse:
        form = await form_of(request)

        def propose() -> str:
            incoming = self._incoming(Cell.open(self.folder), form)
            text = self._tabs.render_proposal(incoming, form.get("files", ""))
            with contextlib.suppress(PisigmaError):  # the check reports what is wrong
                rows = incoming.unchecked_rows
                self._scene.show_rows(RowsSoFar.unjudged(rows.line, rows.q.numpy()))
            return text

        return web.Response(text=await asyncio.to_thread(propose), content_type="text/html")

    @with_error_answers
    async def _check(self, request: web.Request) -> web.StreamResponse:
        form = await form_of(request)

        def check() -> str:
            incoming = self._incoming(Cell.open(self.folder), form)
            try:
                found = incoming.check(form.get("date", "").strip())
            except PisigmaError as problem:
                return self._uploads.without_folder(self._tabs.render_findings(incoming, (), str(problem)))
            self._scene.mark_rows_of_lines(
                line_numbers_in(" ".join(row for one in found for row in one.row_places))
            )
            return self._uploads.without_folder(self._tabs.render_findings(incoming, found))

        return web.Response(text=await asyncio.to_thread(check), content_type="text/html")

    @with_error_answers
    async def _show(self, request: web.Request) -> web.StreamResponse:
        """Mark the rows that a sentence names in the scene: rows of a named session, otherwise the displayed rows."""
        text = (await form_of(request)).get("text", "")

        def show() -> None:
            cell = Cell.open(self.folder)
            for session in cell.history.sessions():
                if f"{session.name}.csv" in text:
                    rows = cell.sessions.rows_of_file(session)
                    self._scene.show_rows(RowsSoFar.unjudged(rows.line, rows.q.numpy()))
                    break
            self._scene.mark_rows_of_lines(line_numbers_in(text))

        await asyncio.to_thread(show)
        return web.json_response({})

    def _incoming(self, cell: Cell, form: Mapping[str, str]) -> IncomingRows:
        """Return the uploaded files of a form, or the growing file."""
        numbers = form.get("files", "").split(",")
        one = self.growing_file
        files = [one] if numbers == [_GROWING] and one else self._uploads.paths(numbers)
        return steps.incoming_rows(files, cell, form)
