"""The query: where was this panorama taken?"""

from __future__ import annotations

from functools import partial
from time import monotonic
from typing import Any

from fastapi import APIRouter, Request, Response

from lalaloc_core.errors import InvalidHintError, InvalidPanoramaError, InvalidPoseError
from lalaloc_core.localise.pipeline import StageClock
from service.errors import (
    DeadlineExceededError,
    DecoderNotReadyError,
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    MalformedRequestError,
    OverloadedError,
    PlanFailedError,
    PlanNotReadyError,
    StoppingError,
    StoreUnavailableError,
    UnknownFloorPlanError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http import IdempotentRequest
from service.http.problems import problem_responses
from service.http.uploads import JSON, MULTIPART, UploadLimits, faults_of, media_type, read_parts, validate_fields
from service.routes.dependencies import IDEMPOTENCY_KEY, Party, Running, Tenant, plan_for_query
from service.schemas import LocaliseAnswer, LocaliseForm
from service.telemetry import note

router = APIRouter(tags=["localisation"])


def _body_schema() -> dict[str, Any]:
    schema = LocaliseForm.model_json_schema()
    schema["properties"]["panorama"] = {
        "type": "string",
        "format": "binary",
        "description": "Equirectangular panorama as JPEG, PNG or WebP: the full 360°, twice as wide as high, or the "
        "part of it that its photo sphere metadata (GPano in XMP) tell.",
    }
    schema["required"] = [*schema["required"], "panorama"]
    body = {"required": True, "content": {MULTIPART: {"schema": schema}}}
    return {"requestBody": body, "parameters": [IDEMPOTENCY_KEY]}


@router.post(
    "/localise",
    summary="Localise a panorama",
    response_model=LocaliseAnswer,
    openapi_extra=_body_schema(),
    responses=problem_responses(
        InvalidHintError,
        InvalidPanoramaError,
        InvalidPoseError,
        InvalidRequestError,
        MalformedRequestError,
        UnknownFloorPlanError,
        PlanFailedError,
        PlanNotReadyError,
        UnsupportedMediaError,
        UploadTooLargeError,
        UploadTimeoutError,
        OverloadedError,
        StoreUnavailableError,
        StoppingError,
        DecoderNotReadyError,
        DeadlineExceededError,
        IdempotencyKeyReusedError,
        IdempotencyInProgressError,
    ),
)
async def localise(request: Request, runtime: Running, tenant: Tenant, party: Party) -> Response:
    """Find where in a stored floor plan a panorama was taken.

    A plan that is still preparing is waited for. When optimisation (`lpo`) cannot answer in time, the answer is
    the one before it, with `"stage": "vdr"`.
    """
    settings = runtime.settings
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /localise")
    media_type(request, (MULTIPART,))
    limits = UploadLimits.of(settings, "max_panorama_bytes")
    clock = StageClock()
    note(request, clock=clock)
    with clock.stage("upload"):
        known, told = set(LocaliseForm.model_fields), {"max_top_k": settings.max_top_k}
        check = partial(faults_of, LocaliseForm, context=told)
        parts = await read_parts(request, limits, files={"panorama"}, fields=known, check=check)
    begin = monotonic()
    form = validate_fields(LocaliseForm, parts.fields, told)
    if "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.max_top_k)})

    async def answer() -> Response:
        record = await plan_for_query(tenant, form.floorplan_id, runtime)
        note(request, plan=record.id, revision=record.revision_id)
        found = await runtime.localiser.answer(record, form, parts.files["panorama"], begin, clock, party)
        note(request, stage=found.stage)
        return Response(found.model_dump_json(), media_type=JSON)

    return await idempotent.run_async(parts, answer, runtime.reads)
