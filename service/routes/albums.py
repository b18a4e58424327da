"""Albums: create, list, read, follow, delete."""

from __future__ import annotations

import asyncio
from functools import partial

from fastapi import APIRouter, Response

from lalaloc_core.localise.encode.features import gives_features
from service import errors
from service.capacity.admission_control import STREAM, admitted_as
from service.http.problems import problem_responses
from service.routes.dependencies import ApiCall, Call, Name, Page, is_id, json_with_etag
from service.routes.descriptions import BEGIN_ERRORS, READ_ERRORS, deletes, event_stream, json_body, reads, stores
from service.schemas.albums import AlbumAnswer, AlbumDocument, AlbumList, AlbumSolution, AlbumSummary
from service.storage.album_rows import AlbumRecord, NewAlbum

router = APIRouter(prefix="/albums", tags=["albums"])
# Lists, objects and items of an album document.
_VALUES = 100


@router.post(
    "",
    summary="Create an album",
    **stores(
        AlbumAnswer, json_body(AlbumDocument), *BEGIN_ERRORS, errors.FeaturelessModelError, errors.TooManyAlbumsError
    ),
)
async def create_album(call: Call) -> Response:
    """Create an album of photographs that are pinned together to a floor plan, or to the plans of a venue.

    Add photographs at `/albums/{album_id}/photographs`. They are solved in the background, all at once, after each
    change: shared cameras, ways from place to place, and corrections count for all of them. Photographs themselves are
    not stored, only their features. An album expires `album_ttl_s` after its last change, and is deleted with its plan
    or venue. After a new revision of the plan it is solved again.
    """
    idempotent, storage = call.idempotent(), call.settings.storage
    document, parts = await call.read_document(AlbumDocument, _VALUES)
    # Checked before anything is stored.
    _ = document.stated_camera
    if not gives_features(manifest := call.runtime.bundle.manifest):
        raise errors.FeaturelessModelError(manifest.name)
    await call.runtime.localiser.check(await call.place(document.floorplan_id, document.venue_id), document)
    new = NewAlbum(
        name=document.name,
        plan_id=document.floorplan_id,
        venue_id=document.venue_id,
        options=document.model_dump_json(exclude_unset=True),
        model_sha256=call.runtime.bundle.sha256,
    )

    def store(token: str) -> Response:
        add = call.store.albums.add
        record = add(call.tenant, token, new, ttl_s=storage.album_ttl_s, limit=storage.max_albums)
        path = call.path_of("get_album", album_id=record.id)
        return call.change_answer(*json_with_etag(_answer(record, call)), path, created=True)

    return await call.upload(idempotent.run, parts, store)


@router.get("", summary="List albums", responses=problem_responses(*READ_ERRORS))
def list_albums(call: Call, page: Page, name: Name = None) -> AlbumList:
    """List albums, newest first."""
    found, more = page.read(partial(call.store.albums.list_albums, call.tenant, name=name))
    return AlbumList(albums=[_summary(record, call) for record in found], next_cursor=more)


@router.get("/{album_id}", summary="Get an album", **reads(AlbumAnswer, errors.UnknownAlbumError))
def get_album(album_id: str, call: Call) -> Response:
    """Return an album with its state and what its photographs have in common."""
    return call.representation(*json_with_etag(_answer(album_of(call, album_id), call)))


@router.get(
    "/{album_id}/events",
    summary="Follow an album",
    **event_stream("an AlbumEvent", problem_responses(errors.UnknownAlbumError, *READ_ERRORS)),
)
@admitted_as(STREAM)
async def follow_album(album_id: str, call: Call) -> Response:
    """Stream server-sent events about the solution of an album.

    `progress` comes at once and after each change, up to four times a second; `solved`, `failed`, `outdated` or
    `deleted` is the last event. Comments and the end of the stream are as for floor plans.
    """
    record = await asyncio.to_thread(album_of, call, album_id)
    return call.runtime.album_events.event_stream(
        record.id, partial(call.runtime.access_control.still_authorised, call.request)
    )


@router.delete("/{album_id}", summary="Delete an album", **deletes(errors.UnknownAlbumError))
def delete_album(album_id: str, call: Call) -> None:
    """Delete an album with its photographs."""
    current = album_of(call, album_id)
    call.store.albums.delete(call.tenant, current.id, expected=call.expected_revision(current))


def album_of(call: ApiCall, album_id: str) -> AlbumRecord:
    """Return a stored album. Blocks."""
    if not is_id(album_id):
        raise errors.UnknownAlbumError(album_id)
    record = call.store.albums.get(call.tenant, album_id)
    call.log(plan=record.plan_id, venue=record.venue_id, revision=record.revision_id)
    return record


def _summary(record: AlbumRecord, call: ApiCall) -> AlbumSummary:
    return AlbumSummary(
        id=record.id,
        revision=record.revision_id,
        revision_number=record.number,
        name=record.name,
        floorplan_id=record.plan_id,
        venue_id=record.venue_id,
        state=record.state(call.runtime.bundle.sha256),
        progress=record.progress,
        reason=record.failure,
        photographs=record.photographs,
        solved_revision_number=record.solved_number,
        created_at=record.created_at,
        updated_at=record.updated_at,
        expires_at=record.expires_at,
    )


def _answer(record: AlbumRecord, call: ApiCall) -> AlbumAnswer:
    return AlbumAnswer(
        **_summary(record, call).model_dump(),
        place_revision=record.place_revision_id,
        model_sha256=record.model_sha256,
        solution=None if record.solution is None else AlbumSolution.model_validate_json(record.solution),
    )
