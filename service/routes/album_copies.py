"""Copies of an album's photographs with their place, and the report: the photographs are sent once more."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable
from functools import partial
from itertools import chain
from pathlib import PurePosixPath
from tempfile import SpooledTemporaryFile
from typing import Any
from zipfile import ZipFile, ZipInfo

from fastapi import APIRouter, Response
from starlette.responses import StreamingResponse

from lalaloc_core.draw.pins import ReportRow, report_notes, report_pages
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.answers.pinned import stated_place
from lalaloc_core.photograph.placed_copy import PlacedHead, sidecar_name
from service import errors
from service.albums.album_documents import report_entry
from service.capacity.admission_control import QUERY, admitted_as
from service.http.problems import problem_responses
from service.http.uploads import MULTIPART, Repeats, on_request_end
from service.query import QueryContext
from service.routes.album_photographs import clean_name, photograph_answer
from service.routes.albums import album_of
from service.routes.dependencies import ApiCall, Call
from service.routes.descriptions import BINARY, BODY_ERRORS, READ_ERRORS, photographs_schema
from service.routes.query_request import FEATURES, PHOTO, read_query
from service.schemas.albums import AlbumPhotographForm, PinPlace
from service.security import caller_of
from service.storage.album_rows import AlbumRecord
from service.storage.records import VenueRecord
from service.uploaded_file import UploadedFile

router = APIRouter(prefix="/albums/{album_id}/copies", tags=["albums"])
_ZIP = "application/zip"
_PHOTOS_SCHEMA = photographs_schema("Photographs of the album", "max_batch_photographs", minItems=1)
_FORM = {"type": "object", "properties": {PHOTO: _PHOTOS_SCHEMA}, "required": [PHOTO]}
_ERRORS = errors.UnknownAlbumError, errors.UnknownFloorPlanError, errors.UnknownVenueError, errors.DecoderNotReadyError
# Photographs by number, with their entries for the report and their places; members of the archive by folded name.
Known = dict[int, tuple[UploadedFile, dict[str, Any], PinPlace | None]]
Members = dict[str, tuple[str, Iterable[bytes]]]


@router.post(
    "",
    summary="Copy photographs of an album with their place",
    response_class=Response,
    openapi_extra={"requestBody": {"required": True, "content": {MULTIPART: {"schema": _FORM}}}},
    responses={200: {"description": "The archive.", "content": {_ZIP: {"schema": BINARY}}}}
    | problem_responses(*_ERRORS, errors.FeaturesRequiredError, *READ_ERRORS, *BODY_ERRORS),
)
@admitted_as(QUERY)
async def copy_album_photographs(album_id: str, call: Call) -> Response:
    """Return copies of photographs with their place, and a report, as a zip archive.

    The service keeps no photographs, so send them once more; it knows their files by the digests. `photographs/` has a
    copy of each that has a pin: keywords name room and level, and EXIF and XMP state position and direction for a plan
    with an `anchor`. WebP and HEIC files get an `.xmp` file beside the copy. `report.pdf` has the plans with numbered
    pins, and a page per room. `notes.txt`, if there is anything to say, names the files that are not of the album, that
    are sent twice, or that cannot be copied. Limits are those of `POST /localise/batch`.
    """
    call.idempotent(_ZIP)
    album = await call.read(album_of, call, album_id)
    limits = call.settings.photographs
    repeated = {PHOTO: Repeats(1, limits.max_batch_photographs, "max_batch_photographs")}
    _, parts, context = await read_query(call, AlbumPhotographForm, "max_sequence_bytes", repeated=repeated)
    if parts.named(FEATURES):
        raise errors.InvalidRequestError([(FEATURES, f"have no picture to copy; send {PHOTO}")])
    files = parts.named(PHOTO)
    await call.runtime.access_control.count_photographs(caller_of(call.request.scope), len(files))
    # The report is drawn where films are read.
    context = context.for_photographs(len(files)).with_time(limits.film_deadline_s)
    async with context.bounded(), call.runtime.admission.queries.wait_and_hold(call.client, context.deadline):
        archive = await _archive(call, album, files, context)
    on_request_end(call.request.scope, archive.close)
    headers = {"Content-Length": str(len(archive)), "Content-Disposition": 'attachment; filename="copies.zip"'}
    return StreamingResponse(archive.chunks(), headers=headers, media_type=_ZIP)


async def _archive(call: ApiCall, album: AlbumRecord, files: list[UploadedFile], context: QueryContext) -> UploadedFile:
    known, notes = await _known(call, album, files)
    venue = None if album.venue_id is None else await call.place(None, album.venue_id)
    plans, members, rows = dict[str, FloorPlan](), Members(), list[ReportRow]()
    for number in sorted(known):
        (file, entry, place), picture = known[number], b""
        if place is not None:
            plan = plans[place.floorplan_id] = plans.get(place.floorplan_id) or await _plan(call, place)
            anchor = plan.anchor_within(venue.anchor if isinstance(venue, VenueRecord) else None)
            stated = await call.process(stated_place, entry, plan, anchor)
            try:
                copy, picture = await call.runtime.decoder.copy(file, stated, context)
                _add_copy(members, entry["photograph"], number, copy, file)
            except InvalidPhotographError as error:
                notes.append(f"'{entry['photograph']}' cannot be copied: {error}")
        rows.append(ReportRow(entry, partial(bytes, picture)))
    if rows:
        states, solution = Counter(row.entry["state"] for row in rows), json.loads(album.solution or "{}")
        lines = report_notes(states, solution.get("camera_height_m"), solution.get("warnings", ()))
        pages = partial(report_pages, album.name, plans, rows, lines)
        members["report.pdf"] = "report.pdf", [await call.runtime.decoder.report(pages, context)]
    if notes:
        members["notes.txt"] = "notes.txt", ["".join(f"{note}\n" for note in notes).encode()]
    return await call.upload(_write, members, call.settings.uploads.memory_bytes)


async def _known(call: ApiCall, album: AlbumRecord, files: list[UploadedFile]) -> tuple[Known, list[str]]:
    """Return the photographs that are pinned or set aside, and notes on the others."""
    known, notes = Known(), list[str]()
    for file in files:
        name = clean_name(file.name) or "photograph"
        record = await call.read(call.store.albums.same_picture, album.id, await call.upload(file.sha256))
        photograph = None if record is None else photograph_answer(record)
        if photograph is None:
            notes.append(f"'{name}' is not in the album, or was added by its features: left out")
        elif photograph.number in known:
            notes.append(f"'{name}' is sent twice: copied once")
        elif photograph.pin is None:
            notes.append(f"'{name}' has no pin yet: left out; send it when the album is solved")
        else:
            known[photograph.number] = file, report_entry(photograph, name), photograph.pin.place
    return known, notes


async def _plan(call: ApiCall, place: PinPlace) -> FloorPlan:
    """Return the plan of a pin, at the revision of the pin while that is kept."""
    get, own = call.store.plans.get, (call.tenant, place.floorplan_id)
    record = await call.read(get, *own, place.floorplan_revision) or await call.read(get, *own)
    if record is None:
        raise errors.UnknownFloorPlanError(place.floorplan_id)
    return record.plan


def _add_copy(members: Members, name: str, number: int, copy: PlacedHead, file: UploadedFile) -> None:
    """Add a copy, and the file beside it; a name that another photograph has gets the number."""
    name = f"photographs/{name}"
    while name.casefold() in members:
        path = PurePosixPath(name)
        name = f"photographs/{path.stem} ({number}){path.suffix}"
    members[name.casefold()] = name, chain([copy.head], file.chunks(copy.rest))
    if copy.sidecar is not None:
        beside = sidecar_name(name, members)
        members[beside.casefold()] = beside, [copy.sidecar]


def _write(members: Members, memory_bytes: int) -> UploadedFile:
    """Write files as they are into a zip archive, which is in memory while it is small. Blocks."""
    spool = SpooledTemporaryFile(memory_bytes)  # noqa: SIM115
    try:
        with ZipFile(spool, "w") as archive:
            for name, parts in members.values():
                with archive.open(ZipInfo(name, time.localtime()[:6]), "w") as target:
                    target.writelines(parts)
    except OSError as error:
        raise errors.SpoolFullError(memory_bytes) from error
    return UploadedFile(spool)
