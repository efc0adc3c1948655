"""Answers to the requests of a page: forms, who sends them, and refusals."""

import functools
import json
from collections.abc import Awaitable, Callable
from typing import Any

from aiohttp import web

from pisigma.files.errors import PisigmaError, system_problem_text
from pisigma.workbench.job import BusyError

_MAX_PERSON = 60
"""Longest name of a person."""


def with_error_answers(function: Callable[[Any, web.Request], Awaitable[web.StreamResponse]]) -> Any:
    """Answer a refused input with the message, and a request during a step with the name of who started it."""

    @functools.wraps(function)
    async def answer(self: Any, request: web.Request) -> web.StreamResponse:
        try:
            return await function(self, request)
        except PisigmaError as problem:
            fields = {
                "error": self._uploads.without_folder(str(problem)),
                "field": problem.option or str(problem.column or ""),
            }
            return web.json_response(fields, status=422)
        except (OSError, MemoryError) as problem:
            if not (fault := system_problem_text(problem)):
                raise
            return web.json_response({"error": self._uploads.without_folder(fault), "field": ""}, status=422)
        except BusyError:
            job = self.jobs.running
            who = "somebody" if job is None else f"{job.started_by}: {job.step}"
            return web.json_response(
                {"error": f"another step is running ({who}); wait until it ends."}, status=409
            )

    return answer


async def form_of(request: web.Request) -> dict[str, str]:
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


def person_of(request: web.Request) -> str:
    """Return the name that a person entered, or the address of the browser."""
    return request.query.get("person", "").strip()[:_MAX_PERSON] or f"somebody at {request.remote}"
