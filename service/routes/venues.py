"""Venues: groups of floor plans that are searched together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Response

from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers import OnStep, building_name
from service import errors
from service.http.fields import Model, parse_document
from service.http.problems import problem_responses
from service.http.uploads import JSON, MULTIPART, Parts, media_type
from service.routes.dependencies import ApiCall, Call, Name, Page, is_id, json_with_etag, parse_venue_cursor
from service.routes.descriptions import (
    BODY_ERRORS,
    READ_ERRORS,
    STORE_ERRORS,
    UPLOAD_ERRORS,
    changes,
    deletes,
    import_lines,
    json_body,
    reads,
    stores,
)
from service.routes.plan_uploads import LEVELS_FORM, PlanUpload, answer_import, prepare_levels, read_upload
from service.schemas import venues as schemas
from service.schemas.plan_import import LevelsForm
from service.storage.records import NewPlan, PlanRecord, VenueMember, VenuePlace, VenueRecord
from service.uploaded_file import UploadedFile

router = APIRouter(prefix="/venues", tags=["venues"])

DocumentT = TypeVar("DocumentT", schemas.VenueDocument, schemas.VenueChangeDocument)
# Name of a venue of levels, if neither its file nor the request has one.
_DEFAULT_NAME = "venue"
# Lists, objects and further items of a venue document, besides those of its plans.
_FURTHER_VALUES = 1000


@router.post(
    "",
    summary="Create a venue",
    **stores(
        schemas.VenueAnswer,
        json_body(schemas.VenueDocument, **{MULTIPART: LEVELS_FORM}),
        *UPLOAD_ERRORS,
        errors.TooManyFloorPlansError,
        errors.TooManyVenuesError,
        lines=import_lines(schemas.VenueAnswer),
    ),
)
async def create_venue(call: Call) -> Response:
    """Group floor plans, each on a level, so that one query searches all of them.

    A JSON body lists stored plans. A form has a plan file of any format: every level with rooms becomes a plan, and all
    of them a venue, or nothing is stored; lines tell the steps of the import. A plan can belong to several venues.
    Deleting a plan removes it from its venues.
    """
    idempotent, limits = call.idempotent(), call.settings.plans
    if media_type(call.request, (JSON, MULTIPART)) == MULTIPART:
        uploaded = await read_upload(call, LevelsForm)
        return await answer_import(call, idempotent, uploaded, partial(_create_of_levels, call, uploaded))
    content = await call.read_json()

    def store(token: str) -> Response:
        document = _document(schemas.VenueDocument, content.read(), call)
        members, anchor = _members(document.plans, call), _anchor(document.anchor)
        add = call.store.venues.add
        record = add(call.tenant, token, document.name, anchor, members, limit=limits.max_venues)
        return _change_answer(call, record, created=True)

    return await call.upload(idempotent.run, Parts({}, {"body": content}), store)


def _create_of_levels(call: ApiCall, uploaded: PlanUpload, token: str, on_step: OnStep | None) -> Response:
    limits = call.settings.plans
    name = uploaded.options.name or building_name(uploaded.file.name) or _DEFAULT_NAME
    plans = prepare_levels(uploaded, call, name, on_step)
    record, stored = call.store.venue_imports.add(
        call.tenant, token, name, plans, max_plans=limits.max_floorplans, max_venues=limits.max_venues
    )
    _announce(plans, stored, call)
    return _change_answer(call, record, created=True)


@router.get("", summary="List venues", responses=problem_responses(*READ_ERRORS))
def list_venues(call: Call, page: Page, name: Name = None) -> schemas.VenueList:
    """List stored venues, newest first."""
    found, more = page.read(partial(call.store.venues.list_venues, call.tenant, name=name))
    return schemas.VenueList(venues=[_summary(record) for record in found], next_cursor=more)


@router.get("/{venue_id}", summary="Get a venue", **reads(schemas.VenueAnswer, errors.UnknownVenueError))
def get_venue(venue_id: str, call: Call) -> Response:
    """Return a stored venue with the number of plans that are ready."""
    return call.representation(*json_with_etag(_answer(call.venue(venue_id), call)))


@router.get(
    "/{venue_id}/plans",
    summary="List the plans of a venue",
    responses=problem_responses(errors.UnknownVenueError, *READ_ERRORS),
)
def list_venue_plans(
    venue_id: str,
    call: Call,
    page: Page,
    level: Annotated[
        float | None, Query(ge=-1000, le=1000, allow_inf_nan=False, description="Level of the plans.")
    ] = None,
) -> schemas.VenuePlanList:
    """List the plans of a venue from the lowest level up, with the state of their pose grids.

    Paging returns every plan that stays in the venue on the same level exactly once.
    """
    find = partial(call.store.venues.plans, call.venue(venue_id).id, level=level)
    found, more = page.read(find, lambda member: VenuePlace(member.level, member.plan_id), parse_venue_cursor)
    return schemas.VenuePlanList(plans=_plan_entries(found, call), next_cursor=more)


@router.put(
    "/{venue_id}",
    summary="Replace a venue",
    **changes(
        schemas.VenueAnswer,
        json_body(schemas.VenueDocument),
        errors.InvalidRequestError,
        *BODY_ERRORS,
        *STORE_ERRORS,
        errors.UnknownVenueError,
    ),
)
async def replace_venue(venue_id: str, call: Call) -> Response:
    """Replace the name, anchor and plans of a venue; fields that are left out are reset."""

    def values(document: schemas.VenueDocument) -> dict[str, Any]:
        return {"name": document.name, "drop_anchor": document.anchor is None, "replace_members": True}

    return await call.upload(_change, venue_id, call, await call.read_json(), schemas.VenueDocument, values)


@router.patch(
    "/{venue_id}",
    summary="Change a venue",
    **changes(
        schemas.VenueAnswer,
        json_body(schemas.VenueChangeDocument, **{MULTIPART: LEVELS_FORM}),
        *UPLOAD_ERRORS,
        errors.UnknownVenueError,
        errors.TooManyFloorPlansError,
        idempotent=True,
    ),
)
async def change_venue(venue_id: str, call: Call) -> Response:
    """Change the name, the anchor or some plans of a venue.

    A form has a plan file as for `POST /venues`: every level with rooms becomes a plan of the venue, or nothing is
    stored. With an idempotency key, a repeated request does not add the plans again.
    """
    if media_type(call.request, (JSON, MULTIPART)) == MULTIPART:
        return await _add_levels(venue_id, call)

    def values(document: schemas.VenueChangeDocument) -> dict[str, Any]:
        given = document.model_fields_set
        if not given:
            raise errors.InvalidRequestError([("body", "changes nothing; give name, anchor, plans or remove")])
        return {
            "name": document.name if "name" in given else None,
            "drop_anchor": "anchor" in given and document.anchor is None,
            "removed": _removed(document),
        }

    return await call.upload(_change, venue_id, call, await call.read_json(), schemas.VenueChangeDocument, values)


def _change(
    venue_id: str,
    call: ApiCall,
    content: UploadedFile,
    model: type[DocumentT],
    values_of: Callable[[DocumentT], dict[str, Any]],
) -> Response:
    """Change a venue as a document of the model states; `values_of` returns what differs between the models."""
    current = call.venue(venue_id)
    expected = call.expected_revision(current)
    document = _document(model, content.read(), call)
    record = call.store.venues.change(
        call.tenant,
        current.id,
        anchor=_anchor(document.anchor),
        members=_members(document.plans, call),
        max_plans=call.settings.plans.max_venue_plans,
        expected=expected,
        **values_of(document),
    )
    return _change_answer(call, record, created=False)


@router.delete("/{venue_id}", summary="Delete a venue", **deletes(errors.UnknownVenueError))
def delete_venue(venue_id: str, call: Call) -> None:
    """Delete a venue; its floor plans are kept."""
    current = call.venue(venue_id)
    if not call.store.venues.delete(call.tenant, current.id, expected=call.expected_revision(current)):
        raise errors.UnknownVenueError(venue_id)


async def _add_levels(venue_id: str, call: ApiCall) -> Response:
    idempotent, limits = call.idempotent(), call.settings.plans
    uploaded = await read_upload(call, LevelsForm)

    def store(token: str) -> Response:
        current = call.venue(venue_id)
        expected = call.expected_revision(current)
        plans = prepare_levels(uploaded, call, uploaded.options.name or current.name or _DEFAULT_NAME)
        record, stored = call.store.venue_imports.extend(
            call.tenant,
            current.id,
            token,
            plans,
            max_plans=limits.max_floorplans,
            max_venue_plans=limits.max_venue_plans,
            expected=expected,
        )
        _announce(plans, stored, call)
        return _change_answer(call, record, created=False)

    return await uploaded.on_thread(call, idempotent.run, uploaded.parts, store)


def _announce(plans: list[NewPlan], records: list[PlanRecord], call: ApiCall) -> None:
    """Tell the provider of grids about stored plans; there are no records if an earlier attempt stored them."""
    # The grids that an earlier attempt left are computed later.
    for record, new in zip(records, plans, strict=False):
        call.runtime.grids.on_plan_stored(record, new.grid)


def _document(model: type[Model], content: bytes, call: ApiCall) -> Model:
    # A plan has four values, and one more to remove it.
    return parse_document(model, content, 5 * call.settings.plans.max_venue_plans + _FURTHER_VALUES)


def _anchor(document: schemas.VenueAnchorDocument | None) -> Anchor | None:
    return None if document is None else Anchor(**document.model_dump())


def _members(documents: list[schemas.VenuePlanDocument], call: ApiCall) -> list[VenueMember]:
    limit = call.settings.plans.max_venue_plans
    if len(documents) > limit:
        fault = f"has {len(documents)} floor plans; the limit is {limit} (LALALOC_MAX_VENUE_PLANS)"
        raise errors.InvalidRequestError([("plans", fault)])
    counted = Counter(document.floorplan_id for document in documents)
    twice = [plan_id for plan_id, count in counted.items() if count > 1]
    if twice:
        fault = f"has floor plan '{twice[0]}' {counted[twice[0]]} times; give it once"
        raise errors.InvalidRequestError([("plans", fault)])
    if wrong := [plan_id for plan_id in counted if not is_id(plan_id)]:
        raise errors.InvalidRequestError([("plans", f"floor plan '{wrong[0]}' does not exist")])
    return [VenueMember(document.floorplan_id, document.level, document.name) for document in documents]


def _removed(document: schemas.VenueChangeDocument) -> set[str]:
    removed = set(document.remove)
    if both := removed & {plan.floorplan_id for plan in document.plans}:
        fault = f"has floor plan '{min(both)[:64]}', which is also in plans; give it in one of them"
        raise errors.InvalidRequestError([("remove", fault)])
    return removed


def _change_answer(call: ApiCall, record: VenueRecord, *, created: bool) -> Response:
    call.log(venue=record.id, revision=record.revision_id)
    path = call.path_of("get_venue", venue_id=record.id)
    return call.change_answer(*json_with_etag(_answer(record, call)), path, created=created)


def _summary(record: VenueRecord) -> schemas.VenueSummary:
    return schemas.VenueSummary(
        id=record.id,
        revision=record.revision_id,
        name=record.name,
        anchor=None if record.anchor is None else schemas.VenueAnchorAnswer(**asdict(record.anchor)),
        plans=record.plans,
        created_at=record.created_at,
        updated_at=record.updated_at,
    )


def _answer(record: VenueRecord, call: ApiCall) -> schemas.VenueAnswer:
    counts = call.runtime.venue_plans.counts(record.tenant, record.id)
    return schemas.VenueAnswer(
        **_summary(record).model_dump(),
        revision_number=record.revision,
        plans_ready=counts.ready,
        plans_failed=counts.failed,
    )


def _plan_entries(members: list[VenueMember], call: ApiCall) -> list[schemas.VenuePlanAnswer]:
    """Return the plans of a venue; a plan that was just deleted is left out."""
    summaries = call.store.plans.summaries([member.plan_id for member in members])
    states = dict(zip([summary.id for summary in summaries], call.runtime.grids.states(summaries), strict=True))
    by_id = {summary.id: summary for summary in summaries}
    return [
        schemas.VenuePlanAnswer(
            floorplan_id=member.plan_id,
            revision=by_id[member.plan_id].revision_id,
            level=member.level,
            name=member.name or by_id[member.plan_id].name,
            status=states[member.plan_id].status,
            progress=states[member.plan_id].progress,
            rooms=by_id[member.plan_id].room_count,
            area_m2=by_id[member.plan_id].area_m2,
        )
        for member in members
        if member.plan_id in by_id
    ]
