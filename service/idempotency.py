"""`Idempotency-Key`: a request that is sent twice is carried out once, and answered alike both times.

What is kept for a day is the answer, be it a refusal for good; what may end otherwise next time (408, 429 and 5xx) is
not. While the first one is in work, the second is refused; if the process that works on it dies, the next one takes
over under the same token once its lease has run out.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import re
import uuid
from collections.abc import Awaitable, Callable

from starlette.requests import Request
from starlette.responses import Response

from lalaloc_core.errors import LaLaLocError
from service.errors import (
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    StoreUnavailableError,
    problem_kind,
)
from service.problems import problem_answer
from service.storage.idempotency import Idempotency
from service.storage.records import Conflict, Fresh, InProgress, StoredAnswer
from service.telemetry import LOGGER_NAME
from service.uploads import Parts

HEADER, REPLAYED = "Idempotency-Key", "Idempotency-Replayed"
MOST_CHARACTERS = 255
_KEY = re.compile(rf"[\x21-\x7e]{{1,{MOST_CHARACTERS}}}")
_NOT_FOR_GOOD = frozenset({408, 429})


class Once:
    """One request, with a key or without."""

    def __init__(self, claims: Idempotency, request: Request, tenant: str, route: str) -> None:
        """
        Args:
            tenant: whose key it is; the same key of another tenant, or for another route, is another key.

        Raises:
            InvalidRequestError: a key that is none.
        """
        self._claims = claims
        self._request = request
        self._place = (tenant, route)
        self._key = _key_of(request)

    def run(self, parts: Parts, work: Callable[[str], Response]) -> Response:
        """Carry the request out, unless that has happened; runs to its end whether or not its caller waits.

        Args:
            parts: what was sent.
            work: gives the answer; takes a token of 32 hexadecimal digits, the same for every attempt at the request.

        Raises:
            IdempotencyKeyReusedError: something else was sent with this key before.
            IdempotencyInProgressError: it is being carried out at this moment.
            StoreUnavailableError: the database is away.
            LaLaLocError: what `work` raised.
        """
        token = self._begin(parts)
        if isinstance(token, Response):
            return token
        try:
            return self._keep(token, work(token))
        except BaseException as error:
            if (refusal := self._fail(token, error)) is None:
                raise
            return refusal

    async def run_async(self, parts: Parts, work: Callable[[], Awaitable[Response]]) -> Response:
        """As `run`, for work that is dropped when its caller goes, and leaves nothing behind."""
        token = await asyncio.to_thread(self._begin, parts)
        if isinstance(token, Response):
            return token
        try:
            answer = await work()
        except BaseException as error:
            if (refusal := await asyncio.to_thread(self._fail, token, error)) is None:
                raise
            return refusal
        return await asyncio.to_thread(self._keep, token, answer)

    def _begin(self, parts: Parts) -> Response | str:
        if self._key is None:
            return uuid.uuid4().hex
        claim = self._claims.begin(*self._place, self._key, parts_sha256(parts))
        match claim:
            case Fresh():
                return claim.token
            case StoredAnswer():
                return Response(claim.body, claim.status, {**claim.headers, REPLAYED: "true"})
            case Conflict():
                raise IdempotencyKeyReusedError(self._key)
            case InProgress():
                raise IdempotencyInProgressError(self._key)

    def _keep(self, token: str, answer: Response) -> Response:
        if self._key is None:
            return answer
        headers = {name: value for name, value in answer.headers.items() if name != "content-length"}
        try:
            kept = StoredAnswer(answer.status_code, headers, bytes(answer.body))
            self._claims.finish(*self._place, self._key, token, kept)
        except StoreUnavailableError:
            # What was done is done; once the lease has run out, the next one finds it under the token.
            logging.getLogger(LOGGER_NAME).warning("the answer to an idempotent request was not kept")
        return answer

    def _fail(self, token: str, error: BaseException) -> Response | None:
        """The refusal, if it is one for good and kept; None when the error is to go its way."""
        if self._key is None:
            return None
        if isinstance(error, LaLaLocError):
            status = problem_kind(error).status
            if status < 500 and status not in _NOT_FOR_GOOD:
                return self._keep(token, problem_answer(self._request, error))
        try:
            self._claims.abandon(*self._place, self._key, token)
        except StoreUnavailableError:
            logging.getLogger(LOGGER_NAME).warning("an idempotent request that failed stays in work for its lease")
        return None


def parts_sha256(parts: Parts) -> str:
    """Digest of what was sent, whatever the boundaries of its parts and their order."""
    digest = hashlib.sha256()
    for kind, named in (("field", parts.fields), ("file", parts.files)):
        for name, value in sorted(named.items()):
            content = value.encode("utf-8", "surrogatepass") if isinstance(value, str) else value
            # With their lengths, so that no two lists of parts read the same.
            digest.update(json.dumps([kind, name, len(content)]).encode("ascii"))
            digest.update(content)
    return digest.hexdigest()


def _key_of(request: Request) -> str | None:
    values = request.headers.getlist(HEADER)
    if not values:
        return None
    if len(values) > 1 or not _KEY.fullmatch(values[0]):
        fault = f"is '{', '.join(values)[:100]}', not one key of 1 to {MOST_CHARACTERS} visible ASCII characters"
        raise InvalidRequestError([(HEADER, fault)])
    return values[0]
