"""Photographs of an album: add, list as JSON, GeoJSON, CSV or SVG, correct, delete."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from lalaloc_core.draw.plan import HEAT_PLACE
from lalaloc_core.errors import InvalidCorrectionError, InvalidFeaturesError
from lalaloc_core.localise.encode.features import MAX_BYTES, read_features
from service import errors
from service.albums.album_documents import correction_document, pins_csv, pins_geojson, pins_svg, stored_correction
from service.capacity.admission_control import QUERY_IN_PARTS, admitted_as
from service.http.problems import problem_responses
from service.http.representations import NDJSON, LinesResponse, expected_revision, preferred
from service.http.uploads import GEOJSON, JSON, MULTIPART, Repeats
from service.query import AlbumPhotographQuery, Content, QueryContext
from service.routes.albums import album_of
from service.routes.batch_lines import BatchLines
from service.routes.dependencies import After, ApiCall, Call, cursor_text, is_id, json_with_etag, parse_venue_cursor
from service.routes.descriptions import (
    BODY_ERRORS,
    PHOTOGRAPH_LINES,
    QUERY_ERRORS,
    READ_ERRORS,
    STORE_ERRORS,
    changes,
    deletes,
    json_body,
    on_earth,
    photographs_schema,
    reads,
)
from service.routes.query_request import FEATURES, PHOTO, VARY, read_query
from service.schemas.albums import (
    AlbumDocument,
    AlbumLine,
    AlbumPhotographAnswer,
    AlbumPhotographForm,
    AlbumPhotographList,
    PhotographChangeDocument,
    PhotographFacts,
    PinAnswer,
)
from service.security import caller_of
from service.storage.album_rows import AlbumRecord, NewPhotograph, PhotographRecord
from service.storage.records import PlanRecord, VenuePlace
from service.uploaded_file import UploadedFile

router = APIRouter(prefix="/albums/{album_id}/photographs", tags=["albums"])
_CSV, _SVG = "text/csv", "image/svg+xml"
_MEDIA = (JSON, GEOJSON, _CSV, _SVG)
_INERT = {"Content-Security-Policy": "default-src 'none'; img-src data:"}
_HEAT = HEAT_PLACE.encode()
_VALUES = 100
_MOST, _PAGE = 500, 100
_MAX_NAME = 255
_MISSING = (errors.UnknownAlbumError, errors.UnknownAlbumPhotographError)
_PHOTOS_SCHEMA = photographs_schema("Photographs", "max_batch_photographs")
_FEATURES_SCHEMA = _PHOTOS_SCHEMA | {
    "description": "Instead of `photo`: their features, computed on the device (docs/reference/features.md)."
}
_BODY = {
    "required": True,
    "content": {
        MULTIPART: {"schema": {"type": "object", "properties": {PHOTO: _PHOTOS_SCHEMA, FEATURES: _FEATURES_SCHEMA}}}
    },
}


@router.post(
    "",
    summary="Add photographs to an album",
    status_code=200,
    response_class=LinesResponse,
    response_model=AlbumLine,
    openapi_extra={"requestBody": _BODY},
    responses=PHOTOGRAPH_LINES
    | problem_responses(
        *(error for error in QUERY_ERRORS if error not in (errors.PlanFailedError, errors.PlanNotReadyError)),
        errors.RateLimitedError,
        errors.UnknownAlbumError,
        errors.UnknownFloorPlanError,
        errors.UnknownVenueError,
        errors.AlbumOutdatedError,
        errors.TooManyPhotographsError,
        errors.StorageQuotaError,
        errors.StoreFullError,
    ),
)
@admitted_as(QUERY_IN_PARTS)
async def add_album_photographs(album_id: str, call: Call) -> Response:
    """Add photographs, whose pins are then found with all others of the album.

    The answer is a stream of lines of JSON, one per photograph in the order of the request, each sent when the
    photograph is stored. One that cannot be read gets a line with its problem; the others continue. The same picture
    is stored once: sent again, as after a lost answer, its line has status 200 instead of 201. Limits are those of
    `POST /localise/batch`; an album has at most `max_album_photographs`.
    """
    call.idempotent(NDJSON)
    album = await call.read(album_of, call, album_id)
    album.check_model(call.runtime.bundle.sha256)
    repeated = {PHOTO: Repeats(1, call.settings.photographs.max_batch_photographs, "max_batch_photographs")}
    _, parts, _ = await read_query(call, AlbumPhotographForm, "max_sequence_bytes", repeated=repeated)
    files = parts.named(PHOTO) or parts.named(FEATURES)
    await call.runtime.access_control.count_photographs(caller_of(call.request.scope), len(files))
    document = AlbumDocument.model_validate_json(album.options)
    read = partial(_read, call=call, are_features=bool(parts.named(FEATURES)))
    # Photographs are read side by side, and stored in the order of the request.
    done = [asyncio.Event() for _ in files]

    async def add(index: int, file: UploadedFile, _: Content, context: QueryContext) -> dict[str, Any]:
        content, sha256 = await call.upload(read, file)
        same = await call.read(call.store.albums.same_picture, album.id, sha256)
        if same is not None:
            return {"status": 200, "photograph": photograph_answer(same)}
        place = await call.place(document.floorplan_id, document.venue_id)
        query = AlbumPhotographQuery(document=document, content=content, sha256=sha256, context=context)
        entry = await call.runtime.localiser.answer(place, query)
        new = NewPhotograph(sha256=sha256, name=clean_name(file.name), facts=entry.facts, entry=entry.entry)
        if index:
            await done[index - 1].wait()
        storage = call.settings.storage
        ttl_s, limit = storage.album_ttl_s, storage.max_album_photographs
        record, is_new = await call.upload(
            lambda: call.store.albums.add_photograph(call.tenant, album.id, new, ttl_s=ttl_s, limit=limit)
        )
        call.runtime.albums.wake()
        return {"status": 201 if is_new else 200, "photograph": photograph_answer(record)}

    lines = BatchLines(call, AlbumLine, add, lambda index: done[index].set()).lines([(file, file) for file in files])
    return LinesResponse(lines, call.settings.requests.request_deadline_s)


def _read(file: UploadedFile, call: ApiCall, *, are_features: bool) -> tuple[Content, str]:
    """Return a photograph, and the digest of its file."""
    if not are_features:
        return file, file.sha256()
    if len(file) > MAX_BYTES:
        raise InvalidFeaturesError(f"{FEATURES} has {len(file)} bytes; the limit is {MAX_BYTES}")
    return read_features(file.read(), call.runtime.bundle), file.sha256()


@router.get(
    "",
    summary="List the photographs of an album",
    response_model=AlbumPhotographList,
    responses={
        200: {
            # As for `POST /localise`, files are not listed under `content`.
            "description": f"The photographs with their pins; with `Accept: {_CSV}` a table, with `Accept: {_SVG}` a "
            "drawing of a plan with its pins.",
            "content": on_earth(geojson="A FeatureCollection of RFC 7946."),
        }
    }
    | problem_responses(errors.UnknownAlbumError, errors.UnanchoredPlanError, *READ_ERRORS),
)
async def list_album_photographs(
    album_id: str,
    call: Call,
    limit: Annotated[
        int | None,
        Query(ge=1, le=_MOST, description=f"Maximum number of photographs. Default: {_PAGE}; {_MOST} in other forms."),
    ] = None,
    cursor: After = None,
    floorplan_id: Annotated[
        str | None, Query(description="Plan of a venue whose pins are wanted; a drawing needs it.")
    ] = None,
) -> Response:
    """List the photographs of an album with their pins, in the order of uploads.

    With `Accept: text/csv` a table, with `Accept: application/geo+json` a FeatureCollection for plans with an
    `anchor`, with `Accept: image/svg+xml` a drawing of the plan with a numbered pin and an arrow for each. A page
    follows at the address of the `Link` header with `rel="next"`.
    """
    media = preferred(call.request, _MEDIA)
    album = await call.read(album_of, call, album_id)
    after = 0 if cursor is None else int(parse_venue_cursor(cursor).level)
    count = limit or (_PAGE if media == JSON else _MOST)
    found = await call.read(lambda: call.store.albums.photographs(album.id, limit=count + 1, after=after))
    page, more = found[:count], None
    if len(found) > count:
        more = cursor_text(VenuePlace(float(page[-1].number), page[-1].id))
    headers = VARY | ({} if more is None else {"Link": f'<?cursor={more}>; rel="next"'})
    # On threads, as the pins of 500 photographs are megabytes.
    if media == _SVG:
        drawing = await _drawing(call, album, await call.process(_answers, page, floorplan_id), floorplan_id)
        return Response(drawing, headers=headers | _INERT, media_type=_SVG)
    if media == _CSV:
        headers |= {"Content-Disposition": 'attachment; filename="album.csv"'}
    content = await call.process(_content, media, album, page, floorplan_id, more)
    return Response(content, headers=headers, media_type=media)


def _answers(records: Sequence[PhotographRecord], floorplan_id: str | None) -> list[AlbumPhotographAnswer]:
    """Return photographs with their pins; those of one plan, if it is named."""
    photographs = [photograph_answer(record) for record in records]
    if floorplan_id is None:
        return photographs
    return [row for row in photographs if row.pin and row.pin.place and _plan_of(row) == floorplan_id]


def _content(
    media: str, album: AlbumRecord, page: Sequence[PhotographRecord], floorplan_id: str | None, more: str | None
) -> bytes:
    """Return photographs as JSON, CSV or GeoJSON; `more` is the cursor of the next page."""
    photographs = _answers(page, floorplan_id)
    if media == JSON:
        return AlbumPhotographList(photographs=photographs, next_cursor=more).model_dump_json().encode()
    if media == _CSV:
        return pins_csv(photographs)
    features = pins_geojson(photographs)
    if features is None:
        placed = next(row for row in photographs if row.pin and row.pin.place)
        raise errors.UnanchoredPlanError(_plan_of(placed), album.venue_id)
    return json.dumps(features).encode()


async def _drawing(
    call: ApiCall, album: AlbumRecord, photographs: Sequence[AlbumPhotographAnswer], floorplan_id: str | None
) -> bytes:
    plan_id = album.plan_id or floorplan_id
    if plan_id is None:
        raise errors.InvalidRequestError([("floorplan_id", "is missing; a drawing shows one plan of the venue")])
    shown = [row.pin.place for row in photographs if row.pin is not None and row.pin.place is not None]
    # That of the pins, if it is still kept.
    revision = next((place.floorplan_revision for place in shown if place.floorplan_id == plan_id), None)
    try:
        plan, _ = await asyncio.to_thread(call.plan_at_revision, plan_id, revision)
    except errors.UnknownRevisionError:
        plan, _ = await asyncio.to_thread(call.plan_at_revision, plan_id, None)
    rooms = await call.rendition(plan, "preview")

    def draw() -> bytes:
        head, tail = pins_svg(f"{plan.name}: {album.name}", rooms.bounds_m, photographs)
        return head.encode() + rooms.content.replace(_HEAT, b"") + tail.encode()

    return await call.process(draw)


@router.get("/{photograph_id}", summary="Get a photograph of an album", **reads(AlbumPhotographAnswer, *_MISSING))
def get_album_photograph(album_id: str, photograph_id: str, call: Call) -> Response:
    """Return a photograph with its correction and its pin."""
    record = _photograph_of(call, album_of(call, album_id), photograph_id)
    return call.representation(*json_with_etag(photograph_answer(record)))


@router.patch(
    "/{photograph_id}",
    summary="Correct a photograph of an album",
    **changes(
        AlbumPhotographAnswer,
        json_body(PhotographChangeDocument),
        errors.InvalidRequestError,
        InvalidCorrectionError,
        *BODY_ERRORS,
        *STORE_ERRORS,
        *_MISSING,
        errors.AlbumOutdatedError,
    ),
)
async def correct_album_photograph(album_id: str, photograph_id: str, call: Call) -> Response:
    """State where a photograph was taken, confirm its pin, or undo that; the rest is then solved again.

    The answer has the correction at once; pins follow when the album is `solved` again.
    """
    document, _ = await call.read_document(PhotographChangeDocument, _VALUES)
    album = await call.read(album_of, call, album_id)
    album.check_model(call.runtime.bundle.sha256)
    current = await call.read(_photograph_of, call, album, photograph_id)
    expected = expected_revision(call.request, current.id, current.revision_id, what="photograph")
    correction = None
    if document.correction is not None:
        pin, plan = _pin_of(current), None
        pinned = None if pin is None or pin.place is None else pin.place.floorplan_id
        plan_id = document.correction.floorplan_id or album.plan_id or pinned
        if album.plan_id not in (None, plan_id):
            raise errors.InvalidRequestError([("correction.floorplan_id", "is not the floor plan of the album")])
        if plan_id is not None and (document.correction.room_id or document.correction.position):
            place = await call.place(plan_id, None)
            assert isinstance(place, PlanRecord)
            plan = place.plan
        correction = stored_correction(document.correction, plan_id, plan, pin)
    ttl_s = call.settings.storage.album_ttl_s

    def store() -> Response:
        correct = call.store.albums.correct
        record = correct(call.tenant, album.id, current.id, correction, ttl_s=ttl_s, expected=expected)
        path = call.path_of("get_album_photograph", album_id=album.id, photograph_id=record.id)
        return call.change_answer(*json_with_etag(photograph_answer(record)), path, created=False)

    answer = await call.upload(store)
    call.runtime.albums.wake(corrected=call.tenant)
    return answer


@router.delete("/{photograph_id}", summary="Delete a photograph of an album", **deletes(*_MISSING))
def delete_album_photograph(album_id: str, photograph_id: str, call: Call) -> None:
    """Delete a photograph with its features and its pin; the rest is solved again."""
    album = album_of(call, album_id)
    current = _photograph_of(call, album, photograph_id)
    expected = expected_revision(call.request, current.id, current.revision_id, what="photograph")
    ttl_s = call.settings.storage.album_ttl_s
    call.store.albums.delete_photograph(call.tenant, album.id, current.id, ttl_s=ttl_s, expected=expected)
    call.runtime.albums.wake()


def clean_name(name: str | None) -> str | None:
    """Return the name of a file without folders and what cannot be shown or stored; None for no name, and for `..`."""
    shown = "".join(filter(str.isprintable, (name or "").replace("\\", "/").rpartition("/")[2]))
    return shown[:_MAX_NAME] if shown.strip(". ") else None


def photograph_answer(record: PhotographRecord) -> AlbumPhotographAnswer:
    """Return a stored photograph with its correction and its pin."""
    correction = None if record.correction is None else correction_document(record.correction)
    return AlbumPhotographAnswer(
        id=record.id,
        number=record.number,
        revision=record.revision_id,
        name=record.name,
        sha256=record.sha256,
        added_at=record.created_at,
        view=PhotographFacts.model_validate_json(record.facts),
        correction=correction,
        pin=_pin_of(record),
    )


def _photograph_of(call: ApiCall, album: AlbumRecord, photograph_id: str) -> PhotographRecord:
    if not is_id(photograph_id):
        raise errors.UnknownAlbumPhotographError(album.id, photograph_id)
    return call.store.albums.photograph(album.id, photograph_id)


def _pin_of(record: PhotographRecord) -> PinAnswer | None:
    return None if record.pin is None else PinAnswer.model_validate_json(record.pin)


def _plan_of(photograph: AlbumPhotographAnswer) -> str:
    assert photograph.pin is not None
    assert photograph.pin.place is not None
    return photograph.pin.place.floorplan_id
