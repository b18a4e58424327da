"""`Idempotency-Key`: a request that is sent twice is executed once, and both attempts get the same answer.

Answers and permanent errors are kept for a day, an answer about something that was stored until that is deleted. After
an error that may be temporary, the next attempt executes the request again under the same token. While an attempt is
running, others are refused. If its process dies, the next attempt takes over under the same token once the lease has
expired.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import uuid
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from contextlib import suppress

from starlette.requests import Request
from starlette.responses import Response

from lalaloc_core.errors import InvalidFloorPlanError, InvalidHintError, InvalidPhotographError, InvalidPoseError
from service import errors
from service.capacity.threads import BoundedReads
from service.http.problems import problem_answer
from service.http.uploads import Parts
from service.pools import JobLostError
from service.security.access_control import routed_path
from service.storage.kept_answers import IdempotencyKeys
from service.storage.records import Claimed, Conflict, InProgress, StoredAnswer
from service.telemetry import LOGGER_NAME

HEADER, REPLAYED = "Idempotency-Key", "Idempotency-Replayed"
MAX_KEY_CHARACTERS = 255
# Characters of a method and path that keys belong to, enough for any id.
_MAX_ROUTE = 64
_KEY = re.compile(rf"[\x21-\x7e]{{1,{MAX_KEY_CHARACTERS}}}")
# Errors of the request itself, which are kept. Others are not kept, whatever their status.
_PERMANENT_ERRORS = (
    InvalidFloorPlanError,
    InvalidHintError,
    InvalidPhotographError,
    InvalidPoseError,
    errors.InvalidRequestError,
    errors.PlanTooLargeError,
    errors.UnknownFloorPlanError,
    errors.UnknownVenueError,
)


class IdempotentRequest:
    """Request with or without an idempotency key.

    Keys of different tenants and paths are independent.
    """

    def __init__(self, claims: IdempotencyKeys, request: Request, tenant: str) -> None:
        self._claims, self._request = claims, request
        self._place = (tenant, f"{request.method} {routed_path(request.scope)}"[:_MAX_ROUTE])
        self._key = _key_of(request)

    def run(self, parts: Parts, work: Callable[[str], Response]) -> Response:
        """Execute the request unless it was executed before; runs to the end even if the client leaves.

        `work` makes the answer from a token of 32 hexadecimal digits, the same for every attempt.
        """
        if not self._key:
            return work(uuid.uuid4().hex)
        token = self._begin(parts)
        if isinstance(token, Response):
            return token
        try:
            return self._keep(token, work(token))
        except BaseException as error:
            if (refusal := self._fail(token, error)) is None:
                raise
            return refusal

    async def run_async(
        self, parts: Parts, work: Callable[[str], Awaitable[Response]], reads: BoundedReads
    ) -> Response:
        """Execute the request as `run` does, for work that is cancelled if the client leaves."""
        if not self._key:
            return await work(uuid.uuid4().hex)
        tenant, waiting = self._place[0], Future[str]()
        try:
            token = await reads.run(tenant, self._begin_for, waiting, parts)
        except BaseException:
            if not waiting.cancel():
                with suppress(errors.StoreUnavailableError):
                    await reads.run(tenant, self._abandon, waiting.result())
            raise
        if isinstance(token, Response):
            return token
        try:
            answer = await work(token)
        except BaseException as error:
            refusal = None
            with suppress(errors.StoreUnavailableError):
                refusal = await reads.run(tenant, self._fail, token, error)
            if refusal is None:
                raise
            return refusal
        with suppress(errors.StoreUnavailableError):
            await reads.run(tenant, self._keep, token, answer)
        return answer

    def _begin(self, parts: Parts) -> Response | str:
        claim = self._claims.begin(*self._place, self._key, parts_sha256(parts))
        match claim:
            case Claimed():
                return claim.token
            case StoredAnswer():
                return Response(claim.body, claim.status, {**claim.headers, REPLAYED: "true"})
            case Conflict():
                raise errors.IdempotencyKeyReusedError(self._key)
            case InProgress():
                raise errors.IdempotencyInProgressError(self._key)

    def _begin_for(self, waiting: Future[str], parts: Parts) -> Response | str:
        """Claim the request, and hand the claim over unless the request has left, which must not keep it."""
        begun = self._begin(parts)
        if isinstance(begun, str):
            if waiting.set_running_or_notify_cancel():
                waiting.set_result(begun)
            else:
                self._abandon(begun)
        return begun

    def _keep(self, token: str, answer: Response) -> Response:
        headers = {name: value for name, value in answer.headers.items() if name != "content-length"}
        try:
            kept = StoredAnswer(answer.status_code, headers, bytes(answer.body))
            self._claims.finish(*self._place, self._key, token, kept)
        except errors.StorageQuotaError:
            # The next attempt executes the request again, under the same token.
            self._abandon(token)
        except errors.StoreUnavailableError:
            # The work is done; after the lease, the next attempt finds it under the token.
            logging.getLogger(LOGGER_NAME).warning("the answer to an idempotent request was not kept")
        return answer

    def _fail(self, token: str, error: BaseException) -> Response | None:
        """Return the answer to a permanent error, which is kept; None for other errors."""
        # A decoder can also die for reasons other than the picture.
        if isinstance(error, _PERMANENT_ERRORS) and not isinstance(error.__cause__, JobLostError):
            return self._keep(token, problem_answer(self._request, error))
        self._abandon(token)
        return None

    def _abandon(self, token: str) -> None:
        try:
            self._claims.abandon(*self._place, self._key, token)
        except errors.StoreUnavailableError:
            logging.getLogger(LOGGER_NAME).warning("an idempotent request that failed stays in progress for its lease")


def parts_sha256(parts: Parts) -> str:
    """Return the digest of the parts, independent of multipart boundaries and order."""
    digest = hashlib.sha256()
    for kind, named in (("field", parts.fields), ("file", parts.files)):
        for name, value in sorted(named.items()):
            chunks = [value.encode("utf-8", "surrogatepass")] if isinstance(value, str) else value.chunks()
            length = len(chunks[0]) if isinstance(chunks, list) else len(value)
            # Lengths make the encoding unambiguous.
            digest.update(json.dumps([kind, name, length]).encode("ascii"))
            for chunk in chunks:
                digest.update(chunk)
    return digest.hexdigest()


def _key_of(request: Request) -> str:
    """Return the key of a request; empty without one."""
    values = request.headers.getlist(HEADER)
    if not values:
        return ""
    if len(values) > 1 or not _KEY.fullmatch(values[0]):
        fault = f"is '{', '.join(values)[:100]}'; give one key of 1 to {MAX_KEY_CHARACTERS} visible ASCII characters"
        raise errors.InvalidRequestError([(HEADER, fault)])
    return values[0]
