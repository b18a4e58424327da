"""Sessions: follow a camera that moves, photograph by photograph."""

from __future__ import annotations

import json
from contextlib import suppress
from functools import partial

from fastapi import APIRouter, Response, status

from lalaloc_core.errors import InvalidHintError, InvalidMotionError
from lalaloc_core.render.sampling import grid_size
from service import errors
from service.capacity.admission_control import QUERY, admitted_as
from service.http.problems import problem_responses
from service.http.representations import preferred
from service.http.uploads import GEOPOSE, JSON, MULTIPART, media_type
from service.query import MAX_POSES, TrackQuery
from service.query.geopose import geopose_document
from service.routes.dependencies import ApiCall, Call, is_id
from service.routes.descriptions import (
    BEGIN_ERRORS,
    BINARY,
    IDEMPOTENCY_ERRORS,
    QUERY_ERRORS,
    READ_ERRORS,
    json_body,
    on_earth,
    stores,
)
from service.routes.query_request import PHOTO, VARY, body_schema, check_anchor, photographs_of, read_query
from service.schemas import PhotographForm, SessionDocument, StoredPose
from service.schemas.sessions import SessionAnswer
from service.storage.records import PlanRecord
from service.storage.sessions import SessionRecord

router = APIRouter(prefix="/sessions", tags=["sessions"])
# Lists, objects and items of a session document.
_VALUES = 1000
_PHOTOGRAPH = BINARY | {"description": "Photograph, as for `POST /localise`."}
_READ_RESPONSES = problem_responses(errors.UnknownSessionError, *READ_ERRORS)


@router.post(
    "",
    summary="Begin a session",
    **stores(SessionAnswer, json_body(SessionDocument), InvalidHintError, *BEGIN_ERRORS, errors.TooManySessionsError),
)
async def create_session(call: Call) -> Response:
    """Begin to follow a camera in a floor plan or venue; send its photographs to `/sessions/{session_id}/photographs`.

    `near`, `rooms` and `level` are hints about the first photograph. A session expires `session_ttl_s` after its last
    photograph, and ends if its plan or venue is changed or deleted.
    """
    idempotent, storage = call.idempotent(), call.settings.storage
    stated, parts = await call.read_document(SessionDocument, _VALUES)
    document = _limit_candidates(stated, call)
    place = await call.place(document.floorplan_id, document.venue_id)
    if isinstance(place, PlanRecord):
        _check_size(place, call)
    await call.runtime.localiser.check(place, document)

    def store(token: str) -> Response:
        options = document.model_dump_json(exclude_unset=True)
        ttl_s, limit = storage.session_ttl_s, storage.max_sessions
        session = call.store.sessions.add(call.tenant, token, place, options, ttl_s=ttl_s, limit=limit)
        path = call.path_of("get_session", session_id=session.id)
        return Response(_answer(session), status.HTTP_201_CREATED, {"Location": path}, JSON)

    return await call.upload(idempotent.run, parts, store)


@router.get("/{session_id}", summary="Get a session", response_model=SessionAnswer, responses=_READ_RESPONSES)
def get_session(session_id: str, call: Call) -> Response:
    """Return a session with the pose of its last photograph and its path so far."""
    return Response(_answer(call.store.sessions.get(call.tenant, _id(session_id))), media_type=JSON)


@router.delete(
    "/{session_id}", status_code=status.HTTP_204_NO_CONTENT, summary="End a session", responses=_READ_RESPONSES
)
def delete_session(session_id: str, call: Call) -> None:
    """Delete a session before it expires."""
    if not call.store.sessions.delete(call.tenant, _id(session_id)):
        raise errors.UnknownSessionError(session_id)


@router.post(
    "/{session_id}/photographs",
    summary="Send the next photograph of a session",
    response_model=SessionAnswer,
    openapi_extra=body_schema(PhotographForm, _PHOTOGRAPH),
    responses={200: {"content": on_earth(geopose="A Basic-Quaternion of OGC GeoPose 1.0.")}}
    | problem_responses(
        InvalidHintError,
        InvalidMotionError,
        errors.UnanchoredPlanError,
        errors.UnknownSessionError,
        errors.SessionBusyError,
        errors.SessionOutdatedError,
        errors.PhotographOutOfOrderError,
        errors.StorageQuotaError,
        errors.StoreFullError,
        errors.VenueUnsearchableError,
        errors.VenueNotReadyError,
        *QUERY_ERRORS,
        *IDEMPOTENCY_ERRORS,
    ),
)
@admitted_as(QUERY)
async def add_photograph(session_id: str, call: Call) -> Response:
    """Follow the camera to its next photograph.

    One photograph of a session is computed at a time: another one gets 409 meanwhile. With `number`, a photograph that
    is sent twice, as after a lost answer, gets 409 instead of moving the camera twice; `GET /sessions/{session_id}`
    then has the answer. With an idempotency key, it gets the same answer again. With `Accept:
    application/geopose+json` the answer is the pose alone, as a GeoPose (Basic-Quaternion) on Earth.
    """
    media = preferred(call.request, (JSON, GEOPOSE))
    idempotent = call.idempotent(media)
    media_type(call.request, (MULTIPART,))
    sessions = call.store.sessions
    await call.read(sessions.get, call.tenant, _id(session_id))
    form, parts, context = await read_query(call, PhotographForm, "max_photograph_bytes", files={PHOTO})
    # Checked before the session is claimed.
    _ = form.odometry
    (content,) = photographs_of(parts, form, call)

    async def follow(token: str) -> Response:
        session = await call.read(sessions.claim, call.tenant, session_id, form.number, token)
        if session.claim == token:
            # An earlier attempt moved the camera, but its answer was not kept.
            return _response(session, media)
        try:
            document = SessionDocument.model_validate_json(session.options)
            place = await call.place(document.floorplan_id, document.venue_id)
            # Before the camera moves.
            check_anchor(place, media)
            if place.revision_id != session.revision_id:
                changed = f"floor plan '{place.id}' was replaced"
                if session.plan_id is None:
                    changed = f"venue '{place.id}' was changed"
                raise errors.SessionOutdatedError(session.id, changed)
            call.log(plan=session.plan_id, venue=session.venue_id, revision=session.revision_id)
            query = TrackQuery(session.id, document, session.state, form, content, context)
            outcome = await call.runtime.localiser.answer(place, query)
            stored = outcome.stored.after(_stored_pose(session)).model_dump_json()
            finish = partial(sessions.finish, ttl_s=call.settings.storage.session_ttl_s)
            after = await call.read(finish, session, token, outcome.state, stored)
        except BaseException:
            # Also if the client leaves; the claim would expire by itself.
            with suppress(errors.StoreUnavailableError):
                await call.read(sessions.release, session)
            raise
        return _response(after, media)

    return await idempotent.run_async(parts, follow, call.runtime.reads)


def _check_size(record: PlanRecord, call: ApiCall) -> None:
    """Check that the belief over a plan can be computed for every photograph."""
    poses = grid_size(record.plan, call.settings.grids.grid_step_m)
    if poses > MAX_POSES:
        fault = f"the plan has about {poses} grid poses; the limit of sessions is {MAX_POSES}"
        raise errors.InvalidRequestError([("floorplan_id", fault)])


def _stored_pose(session: SessionRecord) -> StoredPose | None:
    return None if session.pose is None else StoredPose.model_validate_json(session.pose)


def _limit_candidates(document: SessionDocument, call: ApiCall) -> SessionDocument:
    """Return the request with at most as many candidates as the settings allow."""
    limit = call.settings.photographs.max_top_k
    if document.top_k > limit and "top_k" in document.model_fields_set:
        raise errors.InvalidRequestError([("top_k", f"is {document.top_k}; the limit is {limit} (max_top_k)")])
    return document.model_copy(update={"top_k": min(document.top_k, limit)})


def _id(session_id: str) -> str:
    if not is_id(session_id):
        raise errors.UnknownSessionError(session_id)
    return session_id


def _response(session: SessionRecord, media: str) -> Response:
    """Return the answer about a session, or its pose on Earth alone."""
    if media == JSON:
        return Response(_answer(session), headers=VARY, media_type=JSON)
    stored = _stored_pose(session)
    assert stored is not None, "a photograph was followed"
    document = geopose_document(stored.pose)
    if document is None:
        raise errors.UnanchoredPlanError(stored.pose.floorplan_id or str(session.plan_id), session.venue_id)
    return Response(json.dumps(document), headers=VARY, media_type=media)


def _answer(session: SessionRecord) -> str:
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
