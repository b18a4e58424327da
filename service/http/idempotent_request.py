"""`Idempotency-Key`: a request that is sent twice is carried out once, and answered alike both times.

What is kept for a day is the answer, be it a refusal for good; what may end otherwise next time is not, and then the
next one is carried out under the same token. While the first one is in work, the second is refused; if the process that
works on it dies, the next one takes over, under the same token, once its lease has run out.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import threading
import uuid
from collections.abc import Awaitable, Callable
from contextlib import suppress

from starlette.requests import Request
from starlette.responses import Response

from lalaloc_core.errors import InvalidFloorPlanError, InvalidHintError, InvalidPanoramaError, InvalidPoseError
from service.errors import (
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    PlanTooLargeError,
    StoreUnavailableError,
    UnknownFloorPlanError,
    UnknownVenueError,
)
from service.http.problems import problem_answer
from service.http.uploads import Parts
from service.pools import JobLostError
from service.storage.idempotency_keys import IdempotencyKeys
from service.storage.records import Claimed, Conflict, InProgress, StoredAnswer
from service.telemetry import LOGGER_NAME
from service.threads import BoundedReads

HEADER, REPLAYED = "Idempotency-Key", "Idempotency-Replayed"
MAX_KEY_CHARACTERS = 255
_KEY = re.compile(rf"[\x21-\x7e]{{1,{MAX_KEY_CHARACTERS}}}")
# What the request itself is to blame for, and will be tomorrow. Others are not kept, whatever their status.
_PERMANENT_ERRORS = (
    InvalidFloorPlanError,
    InvalidHintError,
    InvalidPanoramaError,
    InvalidPoseError,
    InvalidRequestError,
    PlanTooLargeError,
    UnknownFloorPlanError,
    UnknownVenueError,
)


class IdempotentRequest:
    """One request, with a key or without."""

    def __init__(self, claims: IdempotencyKeys, request: Request, tenant: str, route: str) -> None:
        """Args:
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

    async def run_async(self, parts: Parts, work: Callable[[], Awaitable[Response]], reads: BoundedReads) -> Response:
        """As `run`, for work that is dropped when its caller goes, and leaves nothing behind.

        Args:
            reads: where the database is asked, and not waited for when it is silent.
        """
        if self._key is None:
            # Without a key there is nothing to ask the database.
            return await work()
        waiting = _Waiting()
        try:
            token = await reads.run(self._begin_for, waiting, parts)
        except BaseException:
            if (left := waiting.leave()) is not None:
                with suppress(StoreUnavailableError):
                    await reads.run(self._abandon, left)
            raise
        if isinstance(token, Response):
            return token
        try:
            answer = await work()
        except BaseException as error:
            refusal = None
            with suppress(StoreUnavailableError):
                refusal = await reads.run(self._fail, token, error)
            if refusal is None:
                raise
            return refusal
        with suppress(StoreUnavailableError):
            await reads.run(self._keep, token, answer)
        return answer

    def _begin(self, parts: Parts) -> Response | str:
        if self._key is None:
            return uuid.uuid4().hex
        claim = self._claims.begin(*self._place, self._key, parts_sha256(parts))
        match claim:
            case Claimed():
                return claim.token
            case StoredAnswer():
                return Response(claim.body, claim.status, {**claim.headers, REPLAYED: "true"})
            case Conflict():
                raise IdempotencyKeyReusedError(self._key)
            case InProgress():
                raise IdempotencyInProgressError(self._key)

    def _begin_for(self, waiting: _Waiting, parts: Parts) -> Response | str:
        begun = self._begin(parts)
        if isinstance(begun, str) and not waiting.give(begun):
            self._abandon(begun)
        return begun

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
        # A picture that decoders were lost over may have had bad luck.
        if isinstance(error, _PERMANENT_ERRORS) and not isinstance(error.__cause__, JobLostError):
            return self._keep(token, problem_answer(self._request, error))
        self._abandon(token)
        return None

    def _abandon(self, token: str) -> None:
        if self._key is None:
            return
        try:
            self._claims.abandon(*self._place, self._key, token)
        except StoreUnavailableError:
            logging.getLogger(LOGGER_NAME).warning("an idempotent request that failed stays in work for its lease")


class _Waiting:
    """Who waits for a claim; when they leave before they have it, it must not stay for its lease."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._left = False
        self._token: str | None = None

    def give(self, token: str) -> bool:
        """Hand the claim over; False when nobody waits any more."""
        with self._lock:
            self._token = token
            return not self._left

    def leave(self) -> str | None:
        """Wait no longer; the claim if it has been handed over already."""
        with self._lock:
            self._left = True
            return self._token


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
        fault = f"is '{', '.join(values)[:100]}', not one key of 1 to {MAX_KEY_CHARACTERS} visible ASCII characters"
        raise InvalidRequestError([(HEADER, fault)])
    return values[0]
