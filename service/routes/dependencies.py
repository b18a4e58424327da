"""Dependencies of routes: the request with the running service and its caller, and the page of a list."""

from __future__ import annotations

import base64
import math
import re
import struct
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, ParamSpec, TypeVar

from fastapi import Depends, Query, Request, Response, status

from service.errors import InvalidRequestError, UnknownFloorPlanError, UnknownRevisionError, UnknownVenueError
from service.http import IdempotentRequest
from service.http.fields import Model, parse_document
from service.http.idempotent_request import HEADER
from service.http.middleware.admission import read_permit
from service.http.representations import expected_revision, not_modified, revision_etag, tagged_answer
from service.http.uploads import JSON, Parts, UploadLimits, media_type, read_body
from service.plan_documents import Rendition, RenditionKind
from service.runtime import Runtime, get_runtime
from service.schemas.albums import AlbumAnswer, AlbumPhotographAnswer
from service.schemas.venues import VenueAnswer
from service.security import caller_of
from service.settings import Settings
from service.storage import Store
from service.storage.album_rows import AlbumRecord
from service.storage.records import Cursor, PlanRecord, PlanSummary, VenuePlace, VenueRecord
from service.telemetry import add_log_fields
from service.uploaded_file import UploadedFile

# Microseconds since 1970 or a level, then the 16 bytes of an id: 24 bytes are 32 characters without padding.
_MOMENT, _LEVEL = struct.Struct(">Q16s"), struct.Struct(">d16s")
_TEXT = re.compile(r"[A-Za-z0-9_-]{32}")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)
_LAST = (datetime.max.replace(tzinfo=UTC) - _EPOCH) // _MICROSECOND


def cursor_text(place: Cursor | VenuePlace) -> str:
    """Return the cursor of a position in a list, or in the plans of a venue."""
    if isinstance(place, VenuePlace):
        packed = _LEVEL.pack(place.level, bytes.fromhex(place.plan_id))
    else:
        packed = _MOMENT.pack((place.created_at - _EPOCH) // _MICROSECOND, bytes.fromhex(place.id))
    return base64.urlsafe_b64encode(packed).decode("ascii")


def parse_cursor(text: str) -> Cursor:
    """Return the position of a cursor in a list."""
    moment, own_id = _unpack(_MOMENT, text)
    if moment > _LAST:
        raise _no_cursor(text)
    return Cursor(_EPOCH + moment * _MICROSECOND, own_id.hex())


def parse_venue_cursor(text: str) -> VenuePlace:
    """Return the position of a cursor in the plans of a venue; raises as `parse_cursor` does."""
    level, plan_id = _unpack(_LEVEL, text)
    if not math.isfinite(level):
        raise _no_cursor(text)
    return VenuePlace(level, plan_id.hex())


def _unpack(layout: struct.Struct, text: str) -> tuple[Any, ...]:
    if not _TEXT.fullmatch(text):
        raise _no_cursor(text)
    return layout.unpack(base64.urlsafe_b64decode(text))


def _no_cursor(text: str) -> InvalidRequestError:
    return InvalidRequestError([("cursor", f"is '{text[:100]}'; give the next_cursor of a list")])


P = ParamSpec("P")
T = TypeVar("T")

_ID = re.compile(r"[0-9a-f]{32}")
_MAX_LISTED = 500

Running = Annotated[Runtime, Depends(get_runtime)]
Name = Annotated[
    str | None, Query(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$", description="Part of the name; case is ignored.")
]
Revision = Annotated[str | None, Query(description="Id of an older revision.")]
Limit = Annotated[int, Query(ge=1, le=_MAX_LISTED, description="Maximum number of items.")]
After = Annotated[str | None, Query(description="`next_cursor` of the previous page.")]


@dataclass(frozen=True)
class ApiCall:
    """Request with the running service and its caller.

    Attributes:
        client: tenant or client address that the request's share of slots counts for; see
            `service.capacity.fair_share`.
    """

    request: Request
    runtime: Runtime
    tenant: str
    client: str

    @property
    def settings(self) -> Settings:
        """Settings of the service."""
        return self.runtime.settings

    @property
    def store(self) -> Store:
        """Stored data."""
        return self.runtime.store

    def log(self, **fields: Any) -> None:
        """Set fields of the request's log line; see `add_log_fields`."""
        add_log_fields(self.request, **fields)

    def idempotent(self, media: str = JSON) -> IdempotentRequest:
        """Return the request with its idempotency key, if it has one."""
        if media != JSON and HEADER in self.request.headers:
            raise InvalidRequestError([(HEADER, "works for answers in application/json only")])
        return IdempotentRequest(self.store.idempotency_keys, self.request, self.tenant)

    async def read_json(self) -> UploadedFile:
        """Read a body in JSON."""
        media_type(self.request, (JSON,))
        return await read_body(self.request, UploadLimits.of(self.settings, "max_venue_bytes"))

    async def read_document(self, model: type[Model], max_values: int) -> tuple[Model, Parts]:
        """Read a body in JSON as a document; return it with the part that identifies the request."""
        content = await self.read_json()
        document = await self.upload(parse_document, model, content.read(), max_values)
        return document, Parts({}, {"body": content})

    async def upload(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run work on what was uploaded, on a thread; see `Threads.run`."""
        return await self.runtime.uploads.run(self.client, work, *args, **kwargs)

    async def read(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Read the store on a thread with a timeout; see `BoundedReads.run`."""
        return await self.runtime.reads.run(self.tenant, work, *args, **kwargs)

    async def process(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run work on what was read, on the same threads, after which the client rests; see `BoundedReads.process`."""

        def charged() -> T:
            with self.runtime.telemetry.cpu_accounts.charged(self.client, rests=True):
                return work(*args, **kwargs)

        return await self.runtime.reads.process(self.tenant, charged)

    def reading(self) -> AbstractAsyncContextManager[None]:
        """Return a block that holds a permit to read, for answers that are read part by part."""
        return read_permit(self.request.scope).for_a_part()

    def plan(self, floorplan_id: str) -> PlanSummary:
        """Return a stored plan without its rooms, so that damaged plans can be replaced or deleted. Blocks."""
        summary = self.store.plans.summary(self.tenant, floorplan_id) if is_id(floorplan_id) else None
        if summary is None:
            raise UnknownFloorPlanError(floorplan_id)
        self.log(plan=summary.id, revision=summary.revision_id)
        return summary

    def plan_at_revision(self, floorplan_id: str, revision_id: str | None) -> tuple[PlanSummary, bool]:
        """Return a stored plan at one of its revisions, and True for an old one; None names the current one. Blocks."""
        current = self.plan(floorplan_id)
        if revision_id is None or revision_id == current.revision_id:
            return current, False
        found = self.store.plans.summary(self.tenant, current.id, revision_id) if is_id(revision_id) else None
        if found is None:
            raise UnknownRevisionError(current.id, revision_id)
        self.log(revision=found.revision_id)
        return found, True

    async def rendition(self, plan: PlanSummary | PlanRecord, kind: RenditionKind) -> Rendition:
        """Return a file made from a stored plan; see `RenditionCache.get`."""
        async with read_permit(self.request.scope).away():
            return await self.runtime.renditions.get(plan.id, plan.revision_id, kind, self.client)

    def venue(self, venue_id: str) -> VenueRecord:
        """Return a stored venue. Blocks."""
        record = self.store.venues.get(self.tenant, venue_id) if is_id(venue_id) else None
        if record is None:
            raise UnknownVenueError(venue_id)
        return record

    def expected_revision(self, stored: PlanSummary | VenueRecord | AlbumRecord) -> str | None:
        """Return the revision that a change needs, by the request's preconditions; see `expected_revision`."""
        what = {VenueRecord: "venue", AlbumRecord: "album"}.get(type(stored), "floor plan")
        return expected_revision(self.request, stored.id, stored.revision_id, what=what)

    async def place(self, floorplan_id: str | None, venue_id: str | None) -> PlanRecord | VenueRecord:
        """Return the plan or venue of a query; a plan from memory while the database is away."""
        if venue_id is not None and not is_id(venue_id):
            raise UnknownVenueError(venue_id)
        if venue_id is None and floorplan_id is not None and not is_id(floorplan_id):
            raise UnknownFloorPlanError(floorplan_id)
        place = await self.runtime.plan_lookup.place(self.tenant, floorplan_id, venue_id, self.runtime.reads)
        if isinstance(place, VenueRecord):
            self.log(venue=place.id)
        else:
            self.log(plan=place.id, revision=place.revision_id)
        return place

    def path_of(self, route: str, **ids: str) -> str:
        """Return the path of a route, by the name of its function."""
        return str(self.request.app.url_path_for(route, **ids))

    def representation(self, content: bytes, etag: str) -> Response:
        """Return something stored as JSON, or 304 if the client has it."""
        return not_modified(self.request, etag) or tagged_answer([content], JSON, etag)

    def change_answer(self, content: bytes, etag: str, path: str, *, created: bool) -> Response:
        """Return the representation of a plan or venue that was created or changed; `etag` is also that of a GET."""
        headers = {"Content-Location": path, "ETag": etag} | ({"Location": path} if created else {})
        return Response(content, status.HTTP_201_CREATED if created else status.HTTP_200_OK, headers, JSON)


async def _call_of(request: Request, runtime: Running) -> ApiCall:
    caller = caller_of(request.scope)
    return ApiCall(request, runtime, caller.tenant, caller.client)


Call = Annotated[ApiCall, Depends(_call_of)]


class _Page:
    """Page of a list that a request asks for."""

    def __init__(self, limit: Limit = 100, cursor: After = None) -> None:
        self._limit, self._cursor = limit, cursor

    def read(
        self,
        find: Callable[..., list[T]],
        position_of: Callable[[Any], Any] = lambda row: Cursor(row.created_at, row.id),
        parse: Callable[[str], Any] = parse_cursor,
    ) -> tuple[list[T], str | None]:
        """Return the items of the page, and the cursor of the next one; None on the last page."""
        after = None if self._cursor is None else parse(self._cursor)
        # One extra item shows that there is another page.
        found = find(limit=self._limit + 1, after=after)
        page = found[: self._limit]
        return page, cursor_text(position_of(page[-1])) if len(found) > self._limit else None


Page = Annotated[_Page, Depends()]


def is_id(text: str) -> bool:
    """Return True for 32 hexadecimal digits; other texts are never looked up in the database."""
    return _ID.fullmatch(text) is not None


def json_with_etag(answer: VenueAnswer | AlbumAnswer | AlbumPhotographAnswer) -> tuple[bytes, str]:
    """Return an answer as JSON, and its entity tag."""
    content = answer.model_dump_json().encode()
    return content, revision_etag(answer.revision, content)
