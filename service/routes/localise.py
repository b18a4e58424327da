"""The query: where was this panorama taken?"""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request

from lalaloc_core.errors import InvalidPanoramaError, InvalidPoseError
from service.errors import (
    DeadlineExceededError,
    InvalidRequestError,
    MalformedRequestError,
    OverloadedError,
    PlanFailedError,
    PlanNotReadyError,
    StoppingError,
    UnknownFloorPlanError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.problems import problem_responses
from service.routes.floorplans import stored_plan
from service.runtime import Runtime, runtime_of
from service.schemas import LocaliseAnswer, LocaliseForm
from service.uploads import MULTIPART, UploadLimits, media_type, read_parts, validate_fields

router = APIRouter(tags=["localisation"])


def _body_schema() -> dict[str, Any]:
    schema = LocaliseForm.model_json_schema()
    schema["properties"]["panorama"] = {
        "type": "string",
        "format": "binary",
        "description": "Full 360° equirectangular panorama, twice as wide as high: JPEG, PNG or WebP.",
    }
    schema["required"] = [*schema["required"], "panorama"]
    return {"requestBody": {"required": True, "content": {MULTIPART: {"schema": schema}}}}


@router.post(
    "/localise",
    summary="Localise a panorama",
    openapi_extra=_body_schema(),
    responses=problem_responses(
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
        StoppingError,
        DeadlineExceededError,
    ),
)
async def localise(request: Request, runtime: Annotated[Runtime, Depends(runtime_of)]) -> LocaliseAnswer:
    """Find where in a stored floor plan a panorama was taken.

    A plan that is still preparing is waited for. When optimisation (`lpo`) cannot answer in time, the answer is
    the one before it, with `"stage": "vdr"`.
    """
    settings = runtime.settings
    media_type(request, (MULTIPART,))
    limits = UploadLimits(settings.max_panorama_bytes, settings.upload_deadline_s)
    with runtime.slots.one():
        parts = await read_parts(request, limits, files={"panorama"}, fields=set(LocaliseForm.model_fields))
        form = validate_fields(LocaliseForm, parts.fields)
        record = await asyncio.to_thread(stored_plan, form.floorplan_id, runtime)
        return await runtime.localiser.answer(record, form, parts.files["panorama"])
