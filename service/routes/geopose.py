"""Queries of AR clients: GeoPose protocol of the Open Spatial Computing Platform (OSCP), version 2."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.localise.search.pipeline import StageClock
from service.errors import (
    FeaturesRequiredError,
    InvalidRequestError,
    NoPlanNearbyError,
    UnanchoredPlanError,
    UnknownVenueError,
    UploadTooLargeError,
    VenueNotReadyError,
    VenueUnsearchableError,
)
from service.http import IdempotentRequest
from service.http.fields import parse_document
from service.http.problems import problem_responses
from service.http.request_end import on_request_end
from service.http.uploads import JSON, Parts, UploadLimits, media_type, read_body
from service.query import Nearby, PhotographQuery, QueryContext
from service.query.oscp import (
    camera_fields,
    compose_oscp_answer,
    decode_picture,
    distance_to_plan_m,
    reading_place,
    unused_warnings,
    without_picture,
)
from service.routes.dependencies import IDEMPOTENCY_KEY, Client, Running, Tenant, plan_for_query, venue_for_query
from service.routes.query_request import QUERY_ERRORS
from service.runtime import Runtime
from service.schemas import LocaliseAnswer, LocaliseForm
from service.schemas.oscp import OscpAnswer, OscpRequest
from service.telemetry import add_log_fields
from service.uploaded_file import UploadedFile

router = APIRouter(tags=["localisation"])
# Size of a request without its picture.
_ENVELOPE_BYTES = 64 * 1024
# Lists, objects and further items of a request: thousands of sensor readings.
_MAX_VALUES = 100_000


@router.post(
    "/geopose",
    summary="Localise a photograph by the OSCP GeoPose protocol",
    response_model=OscpAnswer,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {JSON: {"schema": {"$ref": f"#/components/schemas/{OscpRequest.__name__}"}}},
        },
        "parameters": [IDEMPOTENCY_KEY],
    },
    responses=problem_responses(
        InvalidHintError,
        NoPlanNearbyError,
        UnanchoredPlanError,
        UnknownVenueError,
        VenueUnsearchableError,
        VenueNotReadyError,
        *QUERY_ERRORS,
    ),
)
async def geopose(
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    floorplan_id: Annotated[str | None, Query(description="Id of the floor plan to search.")] = None,
    venue_id: Annotated[str | None, Query(description="Id of the venue to search.")] = None,
) -> Response:
    """Localise a device on Earth, for AR clients of the GeoPose protocol, version 2 (`GeoPoseReq`, `GeoPoseResp`).

    The single camera reading is a photograph. Without `floorplan_id` and `venue_id`, all floor plans with an `anchor`
    within the accuracy of the geolocation reading (100 m if it has none) are searched. With one of them, the reading is
    a hint. The plan, or its venue, needs an `anchor`.
    """
    settings = runtime.settings
    if floorplan_id is not None and venue_id is not None:
        raise InvalidRequestError([("venue_id", "floorplan_id is given as well; give at most one of the two")])
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /geopose")
    media_type(request, (JSON,))
    if settings.photographs.require_features:
        raise FeaturesRequiredError
    clock, max_bytes = StageClock(), settings.photographs.max_photograph_bytes
    add_log_fields(request, clock=clock)
    with clock.stage("upload"):
        limits = UploadLimits.of(settings, "max_photograph_bytes")
        body = await read_body(request, replace(limits, max_bytes=4 * -(-max_bytes // 3) + _ENVELOPE_BYTES))
    context = QueryContext.starting(client, settings.requests.request_deadline_s, clock)

    def read() -> tuple[OscpRequest, UploadedFile]:
        parsed = parse_document(OscpRequest, body.read(), _MAX_VALUES)
        content = UploadedFile.of(decode_picture(parsed), limits.memory_bytes)
        on_request_end(request.scope, content.close)
        if len(content) > max_bytes:
            raise UploadTooLargeError(limits.name, max_bytes, len(content))
        return without_picture(parsed), content

    async def respond() -> Response:
        parsed, content = await runtime.uploads.run(client, read)
        query = _Query(runtime, tenant, parsed, content, context)
        found, warnings = await query.localise(floorplan_id, venue_id)
        add_log_fields(request, plan=found.floorplan_id, revision=found.floorplan_revision, stage=found.stage)
        answer = compose_oscp_answer(parsed, found, [*unused_warnings(parsed), *warnings])
        return Response(answer.model_dump_json(), media_type=JSON)

    named = {name: value for name, value in (("floorplan_id", floorplan_id), ("venue_id", venue_id)) if value}
    return await idempotent.run_async(Parts(named, {"body": body}), respond, runtime.reads)


class _Query:
    """Query of one request."""

    def __init__(
        self, runtime: Runtime, tenant: str, parsed: OscpRequest, content: UploadedFile, context: QueryContext
    ) -> None:
        self._runtime = runtime
        self._tenant = tenant
        self._content = content
        self._context = context
        reading = parsed.geolocation
        self._camera = camera_fields(parsed)
        self._place = None if reading is None else reading_place(reading)

    async def localise(self, floorplan_id: str | None, venue_id: str | None) -> tuple[LocaliseAnswer, list[str]]:
        """Return the answer, and warnings about the geolocation reading."""
        if floorplan_id is not None:
            return await self._in_plan(floorplan_id)
        if venue_id is not None:
            return await self._in_venue(venue_id)
        if self._place is None:
            fault = "is missing; without floorplan_id and venue_id it selects the floor plans"
            raise InvalidRequestError([("sensorReadings.geolocationReadings", fault)])
        place, radius_m = self._place
        # Plans near a place are searched like a venue.
        form = self._form(venue_id="near").model_copy(update={"near": place, "radius_m": radius_m})
        found = await self._runtime.localiser.localise(Nearby(self._tenant, place, radius_m), self._about(form))
        return found, []

    async def _in_plan(self, floorplan_id: str) -> tuple[LocaliseAnswer, list[str]]:
        record = await plan_for_query(self._tenant, floorplan_id, self._runtime)
        if record.plan.anchor is None:
            raise UnanchoredPlanError(record.id)
        form, warnings = self._form(floorplan_id=record.id), list[str]()
        if self._place is not None:
            place, radius_m = self._place
            if (off_m := distance_to_plan_m(place, record.plan)) <= radius_m:
                form = form.model_copy(update={"near": place, "radius_m": radius_m})
            else:
                warnings = [_contradicted(f"is {off_m:.3g} m from the floor plan, its accuracy is {radius_m:g} m")]
        return await self._runtime.localiser.localise(record, self._about(form)), warnings

    async def _in_venue(self, venue_id: str) -> tuple[LocaliseAnswer, list[str]]:
        venue, localiser = await venue_for_query(self._tenant, venue_id, self._runtime), self._runtime.localiser
        form, warnings = self._form(venue_id=venue.id), list[str]()
        if self._place is not None:
            place, radius_m = self._place
            near = form.model_copy(update={"near": place, "radius_m": radius_m})
            try:
                await localiser.check(venue, near)
                form = near
            except InvalidHintError as error:
                warnings = [_contradicted(f"has no say: {error.reason}")]
        return await localiser.localise(venue, self._about(form)), warnings

    def _about(self, form: LocaliseForm) -> PhotographQuery:
        return PhotographQuery(form, self._content, self._context)

    def _form(self, **about: str) -> LocaliseForm:
        form = LocaliseForm.model_validate(about | self._camera)
        return form.model_copy(update={"top_k": min(form.top_k, self._runtime.settings.photographs.max_top_k)})


def _contradicted(reason: str) -> str:
    return f"the geolocation reading {reason}: it was not used"
