"""Lines of JSON about many photographs of one request, as many at a time as there are cores that compute."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from typing import Any

from pydantic import BaseModel

from lalaloc_core.errors import InvalidHintError
from service import errors
from service.http.problems import problem_in_line
from service.query import Content, QueryContext
from service.routes.dependencies import ApiCall
from service.uploaded_file import UploadedFile

# Errors that every further photograph of the request would meet.
_COMMON_ERRORS = (
    InvalidHintError,
    errors.AlbumOutdatedError,
    errors.PlanFailedError,
    errors.PlanNotReadyError,
    errors.StoppingError,
    errors.TooManyPhotographsError,
    errors.UnknownAlbumError,
    errors.VenueNotReadyError,
    errors.VenueUnsearchableError,
)
# Pause (s) before a photograph asks again for a slot, while the tenant's other queries have them.
_BUSY_PAUSE_S = 0.25
_MAX_NAME = 255

Photographs = Sequence[tuple[UploadedFile, Content]]
# Returns the fields of a line that only answers have, the status among them.
AnswerOf = Callable[[int, UploadedFile, Content, QueryContext], Awaitable[dict[str, Any]]]


class BatchLines:
    """Answers to the photographs of one request, as lines of a model in their order.

    `answer` is called again while the tenant's other queries have all slots, and `on_end` with the number of a
    photograph after its answer or problem.
    """

    def __init__(
        self,
        call: ApiCall,
        line: type[BaseModel],
        answer: AnswerOf,
        on_end: Callable[[int], object] = lambda _index: None,
    ) -> None:
        self._call, self._line_model, self._answer_one, self._on_end = call, line, answer, on_end
        self._common_error: Exception | None = None

    async def lines(self, photographs: Photographs) -> AsyncGenerator[str]:
        """Yield the line of every photograph, in order. While a line is not taken, no further photograph begins."""
        cores = self._call.settings.cores
        at_a_time = max(cores.workers + cores.compute_threads, 1)
        begun = deque[asyncio.Task[str]]()
        try:
            for index, (file, photograph) in enumerate(photographs):
                begun.append(asyncio.create_task(self._charged_line(index, file, photograph)))
                if len(begun) >= at_a_time:
                    yield await begun[0]
                    begun.popleft()
            while begun:
                yield await begun[0]
                begun.popleft()
        finally:
            for task in begun:
                task.cancel()
            await asyncio.gather(*begun, return_exceptions=True)

    async def _charged_line(self, index: int, file: UploadedFile, photograph: Content) -> str:
        # A task is not part of the request's own steps.
        line = self._line(index, file, photograph)
        return await self._call.runtime.admission.cpu_accounts.charged_steps(self._call.client, line)

    async def _line(self, index: int, file: UploadedFile, photograph: Content) -> str:
        problem = retry_after_s = None
        try:
            fields = await self._answer(index, file, photograph)
        except Exception as error:
            if isinstance(error, _COMMON_ERRORS):
                self._common_error = error
            problem, retry_after_s = problem_in_line(self._call.request, error)
            fields = {"status": problem.status}
        finally:
            file.close()
        self._on_end(index)
        name = None if file.name is None else file.name[:_MAX_NAME]
        line = self._line_model(index=index, name=name, problem=problem, retry_after_s=retry_after_s, **fields)
        # In ASCII: names and details quote the request, which is not always encodable as UTF-8.
        return json.dumps(line.model_dump(mode="json", exclude_none=problem is not None))

    async def _answer(self, index: int, file: UploadedFile, photograph: Content) -> dict[str, Any]:
        """Answer one photograph; wait for a slot while the tenant's other queries have them all."""
        settings = self._call.settings
        limit = settings.photographs.max_photograph_bytes
        if len(file) > limit:
            raise errors.UploadTooLargeError("max_photograph_bytes", limit, len(file))
        context = QueryContext.starting(self._call.client, settings.requests.request_deadline_s)
        while True:
            if self._call.runtime.admission.stopping:
                raise errors.StoppingError()
            if self._common_error is not None:
                raise self._common_error
            try:
                return await self._answer_one(index, file, photograph, context)
            except errors.OverloadedError:
                if context.left_s < _BUSY_PAUSE_S:
                    raise
            await asyncio.sleep(_BUSY_PAUSE_S)
