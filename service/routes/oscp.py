"""Queries of AR clients: GeoPose protocol of the Open Spatial Computing Platform (OSCP), version 2."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Query, Response

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.localise.search.pipeline import StageClock
from service.errors import (
    FeaturesRequiredError,
    InvalidRequestError,
    NoPlanNearbyError,
    UnanchoredPlanError,
    UploadTooLargeError,
)
from service.http.fields import parse_document
from service.http.multipart import Parts
from service.http.problems import problem_responses
from service.http.request_end import on_request_end
from service.http.uploads import JSON, UploadLimits, media_type, read_body
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
from service.routes.dependencies import ApiCall, Call
from service.routes.descriptions import IDEMPOTENCY_ERRORS, IDEMPOTENCY_KEY, PLACE_ERRORS, QUERY_ERRORS, json_body
from service.schemas import EarthPoint, LocaliseAnswer, LocaliseForm
from service.schemas.oscp import OscpAnswer, OscpRequest
from service.storage.records import PlanRecord, VenueRecord
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
    openapi_extra={"requestBody": json_body(OscpRequest), "parameters": [IDEMPOTENCY_KEY]},
    responses=problem_responses(
        InvalidHintError, NoPlanNearbyError, UnanchoredPlanError, *PLACE_ERRORS, *QUERY_ERRORS, *IDEMPOTENCY_ERRORS
    ),
)
async def geopose(
    call: Call,
    floorplan_id: Annotated[str | None, Query(description="Id of the floor plan to search.")] = None,
    venue_id: Annotated[str | None, Query(description="Id of the venue to search.")] = None,
) -> Response:
    """Localise a device on Earth, for AR clients of the GeoPose protocol, version 2 (`GeoPoseReq`, `GeoPoseResp`).

    The single camera reading is a photograph. Without `floorplan_id` and `venue_id`, all floor plans with an `anchor`
    within the accuracy of the geolocation reading (100 m if it has none) are searched. With one of them, the reading is
    a hint. The plan, or its venue, needs an `anchor`.
    """
    settings = call.settings
    if floorplan_id is not None and venue_id is not None:
        raise InvalidRequestError([("venue_id", "floorplan_id is given as well; give at most one of the two")])
    idempotent = call.idempotent()
    media_type(call.request, (JSON,))
    if settings.photographs.require_features:
        raise FeaturesRequiredError
    clock, max_bytes = StageClock(), settings.photographs.max_photograph_bytes
    call.log(clock=clock)
    with clock.stage("upload"):
        limits = UploadLimits.of(settings, "max_photograph_bytes")
        body = await read_body(call.request, replace(limits, max_bytes=4 * -(-max_bytes // 3) + _ENVELOPE_BYTES))
    context = QueryContext.starting(call.client, settings.requests.request_deadline_s, clock)

    def read() -> tuple[OscpRequest, UploadedFile]:
        parsed = parse_document(OscpRequest, body.read(), _MAX_VALUES)
        content = UploadedFile.of(decode_picture(parsed), limits.memory_bytes)
        on_request_end(call.request.scope, content.close)
        if len(content) > max_bytes:
            raise UploadTooLargeError(limits.name, max_bytes, len(content))
        return without_picture(parsed), content

    async def respond(_token: str) -> Response:
        parsed, content = await call.upload(read)
        found, warnings = await _Query(call, parsed, content, context).localise(floorplan_id, venue_id)
        call.log(plan=found.floorplan_id, revision=found.floorplan_revision, stage=found.stage)
        answer = compose_oscp_answer(parsed, found, [*unused_warnings(parsed), *warnings])
        return Response(answer.model_dump_json(), media_type=JSON)

    named = {name: value for name, value in (("floorplan_id", floorplan_id), ("venue_id", venue_id)) if value}
    return await idempotent.run_async(Parts(named, {"body": body}), respond, call.runtime.reads)


class _Query:
    """Query of one request."""

    def __init__(self, call: ApiCall, parsed: OscpRequest, content: UploadedFile, context: QueryContext) -> None:
        self._call = call
        self._content = content
        self._context = context
        reading = parsed.geolocation
        self._camera = camera_fields(parsed)
        self._place = None if reading is None else reading_place(reading)

    async def localise(self, floorplan_id: str | None, venue_id: str | None) -> tuple[LocaliseAnswer, list[str]]:
        """Return the answer, and warnings about the geolocation reading."""
        if floorplan_id is not None or venue_id is not None:
            place = await self._call.place(floorplan_id, venue_id)
            form, warnings = await self._form_in(place)
            return await self._call.runtime.localiser.localise(place, self._about(form)), warnings
        if self._place is None:
            fault = "is missing; without floorplan_id and venue_id it selects the floor plans"
            raise InvalidRequestError([("sensorReadings.geolocationReadings", fault)])
        # Plans near a place are searched like a venue.
        query = self._about(self._near(self._form(venue_id="near"), *self._place))
        return await self._call.runtime.localiser.localise(Nearby(self._call.tenant, *self._place), query), []

    async def _form_in(self, place: PlanRecord | VenueRecord) -> tuple[LocaliseForm, list[str]]:
        """Return the form of the query, with the reading as a hint unless it contradicts the plan or venue."""
        if isinstance(place, PlanRecord) and place.plan.anchor is None:
            raise UnanchoredPlanError(place.id)
        form = self._form(**{"floorplan_id" if isinstance(place, PlanRecord) else "venue_id": place.id})
        if self._place is None:
            return form, []
        near, radius_m = self._near(form, *self._place), self._place[1]
        if isinstance(place, PlanRecord):
            if (off_m := distance_to_plan_m(self._place[0], place.plan)) <= radius_m:
                return near, []
            reason = f"is {off_m:.3g} m from the floor plan, its accuracy is {radius_m:g} m"
        else:
            try:
                await self._call.runtime.localiser.check(place, near)
                return near, []
            except InvalidHintError as error:
                reason = f"has no say: {error.reason}"
        return form, [f"the geolocation reading {reason}: it was not used"]

    def _about(self, form: LocaliseForm) -> PhotographQuery:
        return PhotographQuery(form, self._content, self._context)

    def _form(self, **about: str) -> LocaliseForm:
        form = LocaliseForm.model_validate(about | self._camera)
        return form.model_copy(update={"top_k": min(form.top_k, self._call.settings.photographs.max_top_k)})

    def _near(self, form: LocaliseForm, place: EarthPoint, radius_m: float) -> LocaliseForm:
        return form.model_copy(update={"near": place, "radius_m": radius_m})
