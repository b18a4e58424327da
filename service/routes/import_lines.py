"""Lines of JSON about an import: its steps as they begin, then the answer or the problem."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import suppress
from functools import partial
from typing import Any

from fastapi import Response

from lalaloc_core.errors import LaLaLocError
from lalaloc_core.importers import ImportStep
from service import errors
from service.http.idempotent_request import REPLAYED, IdempotentRequest
from service.http.problems import problem_document
from service.http.representations import NDJSON, LinesResponse, preferred
from service.http.uploads import JSON
from service.routes.dependencies import ApiCall
from service.routes.plan_uploads import PlanUpload
from service.telemetry import LOGGER_NAME

# A step that goes on is sent again after this time (s): proxies and clients end connections that stand still.
_REPEAT_S = 10.0
_WAITING = ImportStep("waiting for a worker")

# Stores an import under a token, with a function that is told its steps (`on_step`), and returns the answer.
Store = Callable[..., Response]


async def answer_import(call: ApiCall, idempotent: IdempotentRequest, uploaded: PlanUpload, store: Store) -> Response:
    """Answer an import in JSON, or in lines with its steps if the request prefers them.

    Refusals are the last line then: the answer has begun, with status 200.
    """

    # On a thread as one call from claim to answer, so that a disconnect does not interrupt it.
    async def run(work: Callable[[str], Response]) -> Response:
        return await uploaded.on_thread(call, idempotent.run, uploaded.parts, work)

    if preferred(call.request, (JSON, NDJSON)) == JSON:
        return await run(partial(store, on_step=None))
    return LinesResponse(_lines(call, run, store), call.settings.requests.request_deadline_s)


async def _lines(
    call: ApiCall, run: Callable[[Callable[[str], Response]], Coroutine[Any, Any, Response]], store: Store
) -> AsyncGenerator[str]:
    latest = _LatestStep(asyncio.get_running_loop())
    answer = run(partial(store, on_step=latest.put))
    # A task is not part of the request's own steps.
    task = asyncio.ensure_future(call.runtime.admission.cpu_accounts.charged_steps(call.client, answer))
    task.add_done_callback(lambda _task: latest.wake())
    step = _WAITING
    try:
        while not task.done():
            yield _line({"step": step.step, "done": step.done, "total": step.total})
            step = await latest.next(_REPEAT_S)
        try:
            yield _answer_line(task.result())
        except Exception as error:
            yield _problem_line(call, error)
    finally:
        # A call that has begun is finished on its thread, as for an answer in JSON.
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


class _LatestStep:
    """Latest step of an import; a client that reads slowly misses some, so they take no memory."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._step = _WAITING
        self._changed = asyncio.Event()

    def put(self, step: ImportStep) -> None:
        """Set the step; called on any thread."""
        self._step = step
        # The loop can be closed already.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self.wake)

    def wake(self) -> None:
        """End the wait of `next`."""
        self._changed.set()

    async def next(self, limit_s: float) -> ImportStep:
        """Wait for a change, at most `limit_s`; return the latest step."""
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                await self._changed.wait()
        self._changed.clear()
        return self._step


def _answer_line(response: Response) -> str:
    """Return the line of an answer, also of a kept one; its content is JSON."""
    is_problem = response.status_code >= 400
    values: dict[str, Any] = {"status": response.status_code}
    if not is_problem:
        values["etag"] = response.headers.get("ETag")
    if REPLAYED in response.headers:
        values["replayed"] = True
    # Not parsed: plans can have megabytes. A text of JSON has no line breaks, only the space between its values.
    content = bytes(response.body).decode().replace("\n", " ")
    return f'{_line(values)[:-1]}, "{"problem" if is_problem else "answer"}": {content}}}'


def _problem_line(call: ApiCall, error: Exception) -> str:
    if not isinstance(error, LaLaLocError):
        logging.getLogger(LOGGER_NAME).exception("unexpected error")
    problem = problem_document(call.request, error)
    values: dict[str, Any] = {"status": problem.status, "problem": problem.model_dump(mode="json", exclude_none=True)}
    if isinstance(error, errors.ServiceError) and error.retry_after_s is not None:
        values["retry_after_s"] = error.retry_after_s
    return _line(values)


def _line(values: dict[str, Any]) -> str:
    # In ASCII: steps and details quote the file, which is not always encodable as UTF-8.
    return json.dumps({name: value for name, value in values.items() if value is not None})
