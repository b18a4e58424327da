"""The query of several panoramas: where were they taken, on one visit?"""

from __future__ import annotations

import json
from functools import partial
from time import monotonic
from typing import Any

from fastapi import APIRouter, Request, Response

from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.localise.pipeline import StageClock
from service.errors import InvalidRequestError, UnanchoredPlanError, UploadTooLargeError
from service.http import IdempotentRequest
from service.http.accept import preferred
from service.http.idempotent_request import HEADER as IDEMPOTENCY_HEADER
from service.http.problems import problem_responses
from service.http.uploads import (
    GEOJSON,
    JSON,
    MULTIPART,
    Parts,
    UploadLimits,
    faults_of,
    media_type,
    read_parts,
    validate_fields,
)
from service.query.geopose import features_of
from service.routes.dependencies import IDEMPOTENCY_KEY, Client, Running, Tenant, plan_for_query
from service.routes.localise import QUERY_ERRORS
from service.schemas import SequenceAnswer, SequenceForm
from service.settings import Settings
from service.telemetry import note

router = APIRouter(tags=["localisation"])
_PANORAMA, _LEAST = "panorama", 2


def _body_schema() -> dict[str, Any]:
    schema = SequenceForm.model_json_schema(ref_template="#/components/schemas/{model}")
    # Told with the others, see `http.api_description`.
    schema.pop("$defs", None)
    schema["properties"][_PANORAMA] = {
        "type": "array",
        "items": {"type": "string", "format": "binary"},
        "minItems": _LEAST,
        "description": "The panoramas in the order in which they were taken, a part named `panorama` for each, as for "
        "`POST /localise`; at most `max_sequence_panoramas`, and `max_sequence_bytes` together.",
    }
    schema["required"] = [*schema["required"], _PANORAMA]
    body = {"required": True, "content": {MULTIPART: {"schema": schema}}}
    return {"requestBody": body, "parameters": [IDEMPOTENCY_KEY]}


@router.post(
    "/localise/sequence",
    summary="Localise several panoramas of one visit",
    response_model=SequenceAnswer,
    openapi_extra=_body_schema(),
    responses={
        200: {"content": {GEOJSON: {"schema": {"type": "object", "description": "A FeatureCollection of RFC 7946."}}}}
    }
    | problem_responses(InvalidMotionError, UnanchoredPlanError, *QUERY_ERRORS),
)
async def localise_sequence(request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Find where in a stored floor plan several panoramas of one visit were taken, all of them together.

    What was measured of the motions between them tells places apart that look alike. With `Accept:
    application/geo+json` the answer is a GeoJSON FeatureCollection, a Feature for each panorama, for plans with an
    `anchor`. A plan that is still preparing is waited for. When optimisation (`lpo`) cannot answer in time, the answer
    is the one before it, with `"stage": "retrieval"`.
    """
    settings = runtime.settings
    media = preferred(request, (JSON, GEOJSON))
    if media != JSON and IDEMPOTENCY_HEADER in request.headers:
        raise InvalidRequestError([(IDEMPOTENCY_HEADER, "is for answers in application/json, others are not kept")])
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /localise/sequence")
    media_type(request, (MULTIPART,))
    clock = StageClock()
    note(request, clock=clock)
    told = {"max_top_k": settings.max_top_k}
    with clock.stage("upload"):
        parts = await read_parts(
            request,
            UploadLimits.of(settings, "max_sequence_bytes"),
            files=set(),
            fields=set(SequenceForm.model_fields),
            check=partial(faults_of, SequenceForm, context=told),
            repeated={_PANORAMA: (_LEAST, settings.max_sequence_panoramas)},
        )
    begin = monotonic()
    form = validate_fields(SequenceForm, parts.fields, told)
    contents = _panoramas(parts, form, settings)
    if "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.max_top_k)})

    async def answer() -> Response:
        record = await plan_for_query(tenant, form.floorplan_id, runtime)
        note(request, plan=record.id, revision=record.revision_id)
        if media == GEOJSON and record.plan.anchor is None:
            raise UnanchoredPlanError(record.id)
        found = await runtime.localiser.answer_sequence(record, form, contents, begin, clock, client)
        note(request, stage=found.stage)
        content = found.model_dump_json() if media == JSON else json.dumps(features_of(found))
        return Response(content, headers={"Vary": "Accept"}, media_type=media)

    return await idempotent.run_async(parts, answer, runtime.reads)


def _panoramas(parts: Parts, form: SequenceForm, settings: Settings) -> list[bytes]:
    """The panoramas, in order.

    Raises:
        UploadTooLargeError: one of them has more bytes than a panorama may have.
        InvalidRequestError: fields that do not go with their number.
    """
    contents = parts.repeated(_PANORAMA)
    largest = max(len(content) for content in contents)
    if largest > settings.max_panorama_bytes:
        raise UploadTooLargeError("max_panorama_bytes", settings.max_panorama_bytes, largest)
    if faults := form.faults(len(contents)):
        raise InvalidRequestError(faults)
    return contents
