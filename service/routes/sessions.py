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
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http import IdempotentRequest
from service.http.fields import parse_document
from service.http.problems import problem_responses
from service.http.uploads import JSON, MULTIPART, Parts, UploadLimits, media_type, read_body
from service.query import TrackQuery
from service.routes.dependencies import IDEMPOTENCY_KEY, Client, Running, Tenant, is_id, plan_for_query
from service.routes.query_request import PHOTO, QUERY_ERRORS, body_schema, photographs_of, read_query
from service.runtime import Runtime
from service.schemas import PhotographForm, SessionAnswer, SessionDocument, StoredPose
from service.storage.records import PlanRecord
from service.storage.sessions import SessionRecord
from service.telemetry import add_log_fields

router = APIRouter(prefix="/sessions", tags=["sessions"])
# Poses of a plan whose belief is computed for every photograph; a belief has a weight for each pose and heading.
MAX_POSES = 65_536
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
        TooManySessionsError,
        IdempotencyKeyReusedError,
        IdempotencyInProgressError,
    ),
)
async def create_session(request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Begin to follow a camera in a stored floor plan; send its photographs to `/sessions/{session_id}/photographs`.

    `near` and `rooms` are hints about the first photograph. A session expires `session_ttl_s` after its last
    photograph, and ends if its plan is replaced or deleted.
    """
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /sessions")
    media_type(request, (JSON,))
    content = await read_body(request, UploadLimits.of(runtime.settings, "max_venue_bytes"))
    document = await runtime.uploads.run(client, parse_document, SessionDocument, content.read(), _VALUES)
    document = _limited(document, runtime)
    record = await plan_for_query(tenant, document.floorplan_id, runtime)
    poses = grid_size(record.plan, runtime.settings.grids.grid_step_m)
    if poses > MAX_POSES:
        raise InvalidRequestError(
            [("floorplan_id", f"the plan has about {poses} grid poses; the limit of sessions is {MAX_POSES}")]
        )
    await runtime.tracker.check(record, document)

    def store(token: str) -> Response:
        session = runtime.store.sessions.add(
            tenant,
            token,
            record.id,
            record.revision_id,
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
        request, runtime.settings, client, PhotographForm, "max_panorama_bytes", files={PHOTO}
    )
    # Checked before the session is claimed.
    _ = form.odometry
    (content,) = photographs_of(parts, form, runtime.bundle)
    session = await runtime.reads.run(tenant, runtime.store.sessions.claim, tenant, session_id, form.number)
    try:
        record = await _plan_of(session, runtime)
        add_log_fields(request, plan=record.id, revision=record.revision_id)
        document = SessionDocument.model_validate_json(session.options)
        query = TrackQuery(session.id, document, session.state, form, content, context)
        outcome = await runtime.tracker.track(record, query)
        finish = partial(runtime.store.sessions.finish, ttl_s=runtime.settings.storage.session_ttl_s)
        after = await runtime.reads.run(tenant, finish, session, outcome.state, outcome.stored.model_dump_json())
    except BaseException:
        # Also if the client leaves; the claim would expire by itself.
        with suppress(StoreUnavailableError):
            await runtime.reads.run(tenant, runtime.store.sessions.release, session)
        raise
    return Response(_answer(after), media_type=JSON)


async def _plan_of(session: SessionRecord, runtime: Runtime) -> PlanRecord:
    """Return the plan of a session.

    Raises:
        SessionOutdatedError: the plan was replaced.
    """
    record = await plan_for_query(session.tenant, session.plan_id, runtime)
    if record.revision_id != session.revision_id:
        raise SessionOutdatedError(session.id, f"floor plan '{session.plan_id}' was replaced")
    return record


def _limited(document: SessionDocument, runtime: Runtime) -> SessionDocument:
    """Return the request with at most as many candidates as the settings allow.

    Raises:
        InvalidRequestError: it states more.
    """
    limit = runtime.settings.panoramas.max_top_k
    if document.top_k > limit and "top_k" in document.model_fields_set:
        raise InvalidRequestError([("top_k", f"is {document.top_k}; the limit is {limit} (max_top_k)")])
    return document.model_copy(update={"top_k": min(document.top_k, limit)})


def _id(session_id: str) -> str:
    if not is_id(session_id):
        raise UnknownSessionError(session_id)
    return session_id


def _answer(session: SessionRecord) -> str:
    """Return the answer about a session as JSON."""
    stored = None if session.pose is None else StoredPose.model_validate_json(session.pose)
    return SessionAnswer(
        id=session.id,
        floorplan_id=session.plan_id,
        floorplan_revision=session.revision_id,
        expires_at=session.expires_at,
        photographs=session.photographs,
        mode="searching" if stored is None else stored.mode,
        pose=None if stored is None else stored.pose,
        path=[] if stored is None else stored.path,
    ).model_dump_json()
