"""Sessions: follow a camera that moves, photograph by photograph."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import Any

from fastapi import APIRouter, Request, Response, status

from lalaloc_core.errors import InvalidHintError, InvalidMotionError, InvalidPoseError
from lalaloc_core.render.sampling import grid_size
from service.errors import (
    BytesInFlightError,
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    MalformedRequestError,
    PhotographOutOfOrderError,
    SessionBusyError,
    SessionOutdatedError,
    SpoolFullError,
    StorageQuotaError,
    StoreFullError,
    StoreUnavailableError,
    TooManySessionsError,
    UnknownFloorPlanError,
    UnknownSessionError,
    UnknownVenueError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
    VenueNotReadyError,
    VenueUnsearchableError,
)
from service.http import IdempotentRequest
from service.http.fields import parse_document
from service.http.problems import problem_responses
from service.http.uploads import JSON, MULTIPART, Parts, UploadLimits, media_type, read_body
from service.query import MAX_POSES, TrackQuery
from service.routes.dependencies import IDEMPOTENCY_KEY, Client, Running, Tenant, is_id, plan_for_query, venue_for_query
from service.routes.query_request import PHOTO, QUERY_ERRORS, body_schema, photographs_of, read_query
from service.runtime import Runtime
from service.schemas import PhotographForm, SessionAnswer, SessionDocument, StoredPose
from service.storage.records import PlanRecord, VenueRecord
from service.storage.sessions import SessionRecord
from service.telemetry import add_log_fields

router = APIRouter(prefix="/sessions", tags=["sessions"])
# Lists, objects and items of a session document.
_VALUES = 1000
_PHOTOGRAPH: dict[str, Any] = {
    "type": "string",
    "format": "binary",
    "description": "Photograph, as for `POST /localise`.",
}
_READ_ERRORS = (UnknownSessionError, InvalidRequestError, StoreUnavailableError)


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Begin a session",
    response_model=SessionAnswer,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {JSON: {"schema": {"$ref": "#/components/schemas/SessionDocument"}}},
        },
        "parameters": [IDEMPOTENCY_KEY],
    },
    responses=problem_responses(
        InvalidHintError,
        InvalidPoseError,
        InvalidRequestError,
        MalformedRequestError,
        UnsupportedMediaError,
        UploadTooLargeError,
        UploadTimeoutError,
        BytesInFlightError,
        SpoolFullError,
        StoreUnavailableError,
        StoreFullError,
        StorageQuotaError,
        UnknownFloorPlanError,
        UnknownVenueError,
        VenueUnsearchableError,
        TooManySessionsError,
        IdempotencyKeyReusedError,
        IdempotencyInProgressError,
    ),
)
async def create_session(request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Begin to follow a camera in a floor plan or venue; send its photographs to `/sessions/{session_id}/photographs`.

    `near`, `rooms` and `level` are hints about the first photograph. A session expires `session_ttl_s` after its last
    photograph, and ends if its plan or venue is changed or deleted.
    """
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /sessions")
    media_type(request, (JSON,))
    content = await read_body(request, UploadLimits.of(runtime.settings, "max_venue_bytes"))
    document = await runtime.uploads.run(client, parse_document, SessionDocument, content.read(), _VALUES)
    document = _limited(document, runtime)
    place = await _place(tenant, document, runtime)
    if isinstance(place, PlanRecord):
        _check_size(place, runtime)
    await runtime.localiser.check(place, document)

    def store(token: str) -> Response:
        session = runtime.store.sessions.add(
            tenant,
            token,
            place,
            document.model_dump_json(exclude_unset=True),
            ttl_s=runtime.settings.storage.session_ttl_s,
            limit=runtime.settings.storage.max_sessions,
        )
        path = str(request.app.url_path_for("get_session", session_id=session.id))
        return Response(_answer(session), status.HTTP_201_CREATED, {"Location": path}, JSON)

    return await runtime.uploads.run(client, idempotent.run, Parts({}, {"body": content}), store)


@router.get(
    "/{session_id}", summary="Get a session", response_model=SessionAnswer, responses=problem_responses(*_READ_ERRORS)
)
def get_session(session_id: str, runtime: Running, tenant: Tenant) -> Response:
    """Return a session with the pose of its last photograph and its path so far."""
    return Response(_answer(runtime.store.sessions.get(tenant, _id(session_id))), media_type=JSON)


@router.delete(
    "/{session_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="End a session",
    responses=problem_responses(*_READ_ERRORS),
)
def delete_session(session_id: str, runtime: Running, tenant: Tenant) -> None:
    """Delete a session before it expires."""
    if not runtime.store.sessions.delete(tenant, _id(session_id)):
        raise UnknownSessionError(session_id)


@router.post(
    "/{session_id}/photographs",
    summary="Send the next photograph of a session",
    response_model=SessionAnswer,
    openapi_extra=body_schema(PhotographForm, _PHOTOGRAPH),
    responses=problem_responses(
        InvalidHintError,
        InvalidMotionError,
        UnknownSessionError,
        SessionBusyError,
        SessionOutdatedError,
        PhotographOutOfOrderError,
        StorageQuotaError,
        StoreFullError,
        VenueUnsearchableError,
        VenueNotReadyError,
        *(
            error
            for error in QUERY_ERRORS
            if error not in (IdempotencyInProgressError, IdempotencyKeyReusedError, UnknownFloorPlanError)
        ),
    ),
)
async def add_photograph(
    session_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client
) -> Response:
    """Follow the camera to its next photograph.

    One photograph of a session is computed at a time: another one gets 409 meanwhile. With `number`, a photograph that
    is sent twice, as after a lost answer, gets 409 instead of moving the camera twice; `GET /sessions/{session_id}`
    then has the answer.
    """
    media_type(request, (MULTIPART,))
    await runtime.reads.run(tenant, runtime.store.sessions.get, tenant, _id(session_id))
    form, parts, context = await read_query(
        request, runtime.settings, client, PhotographForm, "max_photograph_bytes", files={PHOTO}
    )
    # Checked before the session is claimed.
    _ = form.odometry
    (content,) = photographs_of(parts, form, runtime.bundle)
    session = await runtime.reads.run(tenant, runtime.store.sessions.claim, tenant, session_id, form.number)
    try:
        document = SessionDocument.model_validate_json(session.options)
        place = await _current_place(session, document, runtime)
        add_log_fields(request, plan=session.plan_id, venue=session.venue_id, revision=session.revision_id)
        query = TrackQuery(session.id, document, session.state, form, content, context)
        outcome = await runtime.localiser.track(place, query)
        stored = outcome.stored.after(_stored_pose(session)).model_dump_json()
        finish = partial(runtime.store.sessions.finish, ttl_s=runtime.settings.storage.session_ttl_s)
        after = await runtime.reads.run(tenant, finish, session, outcome.state, stored)
    except BaseException:
        # Also if the client leaves; the claim would expire by itself.
        with suppress(StoreUnavailableError):
            await runtime.reads.run(tenant, runtime.store.sessions.release, session)
        raise
    return Response(_answer(after), media_type=JSON)


async def _place(tenant: str, document: SessionDocument, runtime: Runtime) -> PlanRecord | VenueRecord:
    """Return the plan or venue of a request.

    Raises:
        UnknownFloorPlanError, UnknownVenueError: no such plan or venue.
    """
    if document.venue_id is not None:
        return await venue_for_query(tenant, document.venue_id, runtime)
    assert document.floorplan_id is not None
    return await plan_for_query(tenant, document.floorplan_id, runtime)


def _check_size(record: PlanRecord, runtime: Runtime) -> None:
    """Check that the belief over a plan can be computed for every photograph.

    Raises:
        InvalidRequestError: the plan has too many poses.
    """
    poses = grid_size(record.plan, runtime.settings.grids.grid_step_m)
    if poses > MAX_POSES:
        raise InvalidRequestError(
            [("floorplan_id", f"the plan has about {poses} grid poses; the limit of sessions is {MAX_POSES}")]
        )


async def _current_place(
    session: SessionRecord, document: SessionDocument, runtime: Runtime
) -> PlanRecord | VenueRecord:
    """Return the plan or venue of a session.

    Raises:
        SessionOutdatedError: it was changed.
    """
    place = await _place(session.tenant, document, runtime)
    if place.revision_id != session.revision_id:
        changed = (
            f"venue '{place.id}' was changed" if session.plan_id is None else f"floor plan '{place.id}' was replaced"
        )
        raise SessionOutdatedError(session.id, changed)
    return place


def _stored_pose(session: SessionRecord) -> StoredPose | None:
    return None if session.pose is None else StoredPose.model_validate_json(session.pose)


def _limited(document: SessionDocument, runtime: Runtime) -> SessionDocument:
    """Return the request with at most as many candidates as the settings allow.

    Raises:
        InvalidRequestError: it states more.
    """
    limit = runtime.settings.photographs.max_top_k
    if document.top_k > limit and "top_k" in document.model_fields_set:
        raise InvalidRequestError([("top_k", f"is {document.top_k}; the limit is {limit} (max_top_k)")])
    return document.model_copy(update={"top_k": min(document.top_k, limit)})


def _id(session_id: str) -> str:
    if not is_id(session_id):
        raise UnknownSessionError(session_id)
    return session_id


def _answer(session: SessionRecord) -> str:
    """Return the answer about a session as JSON."""
    stored, in_venue = _stored_pose(session), session.venue_id is not None
    return SessionAnswer(
        id=session.id,
        floorplan_id=session.plan_id,
        floorplan_revision=None if in_venue else session.revision_id,
        venue_id=session.venue_id,
        venue_revision=session.revision_id if in_venue else None,
        expires_at=session.expires_at,
        photographs=session.photographs,
        mode="searching" if stored is None else stored.mode,
        pose=None if stored is None else stored.pose,
        path=[] if stored is None else stored.path,
    ).model_dump_json()
