"""Common parts of queries: the multipart form with its photographs, the search in a plan or venue, and the answer."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from fastapi import Response
from pydantic import BaseModel

from lalaloc_core.errors import InvalidFeaturesError
from lalaloc_core.localise.encode.features import MAX_BYTES, read_features
from lalaloc_core.localise.search.pipeline import StageClock
from service import errors
from service.http.fields import faults_of, validate_fields
from service.http.uploads import (
    GEOJSON,
    GEOPOSE,
    JSON,
    MULTIPART,
    Parts,
    Repeats,
    Settable,
    UploadLimits,
    media_type,
    read_parts,
)
from service.query import Content, QueryContext
from service.routes.dependencies import ApiCall
from service.routes.descriptions import BINARY, IDEMPOTENCY_KEY
from service.schemas import LocaliseAnswer, SequenceAnswer
from service.schemas.photographs import PhotographFields
from service.schemas.query_fields import CameraFields
from service.storage.records import PlanRecord, VenueRecord

PHOTO, FEATURES, FILM = "photo", "features", "film"
# Name of the part in versions up to 0.5.
_EARLIER_PHOTO = "panorama"
VARY = {"Vary": "Accept"}
Form = TypeVar("Form", bound=BaseModel)
Answer = TypeVar("Answer", LocaliseAnswer, SequenceAnswer)


def body_schema(
    form: type[BaseModel], photo: Mapping[str, Any], *, film: Mapping[str, Any] | None = None, idempotent: bool = True
) -> dict[str, Any]:
    """Return the description of a query's body, and of its idempotency key."""
    schema = form.model_json_schema(ref_template="#/components/schemas/{model}")
    # `http.api_description` adds these schemas.
    schema.pop("$defs", None)
    schema["properties"][PHOTO] = dict(photo)
    schema["properties"][_EARLIER_PHOTO] = {**photo, "description": f"Earlier name of `{PHOTO}`.", "deprecated": True}
    schema["properties"][FEATURES] = {
        **({"type": "array", "items": BINARY} if photo["type"] == "array" else BINARY),
        "description": f"Instead of `{PHOTO}`: its features, computed on the device with the image encoder of this "
        "service (`GET /model/{file}`; docs/reference/features.md), so that the photograph stays there.",
    }
    if film is not None:
        schema["properties"][FILM] = dict(film)
    # One of these is needed. None is described as required, because of alternatives generated clients make a union
    # of types.
    body = {"required": True, "content": {MULTIPART: {"schema": schema}}}
    return {"requestBody": body} | ({"parameters": [IDEMPOTENCY_KEY]} if idempotent else {})


async def read_query(
    call: ApiCall,
    form_type: type[Form],
    limit: Settable,
    *,
    files: Collection[str] = (),
    repeated: Mapping[str, Repeats] | None = None,
    film: bool = False,
) -> tuple[Form, Parts, QueryContext]:
    """Read a form with photographs and start the clock of its deadline.

    The query has at most as many candidates as the settings allow.
    """
    media_type(call.request, (MULTIPART,))
    settings = call.settings
    clock = StageClock()
    call.log(clock=clock)
    bounds = {"max_top_k": settings.photographs.max_top_k}
    limits = UploadLimits.of(settings, limit)
    if settings.photographs.require_features:
        # Small, and never written to disk.
        count = max((repeats.most for repeats in (repeated or {}).values()), default=1)
        limits = replace(limits, max_bytes=min(limits.max_bytes, count * MAX_BYTES), memory_bytes=0)
    with clock.stage("upload"):
        try:
            parts = await read_parts(
                call.request,
                limits,
                files=set(files),
                fields=set(form_type.model_fields),
                check=partial(faults_of, form_type, context=bounds),
                repeated=repeated or {},
                aliases={_EARLIER_PHOTO: PHOTO},
                substitutes={FEATURES: PHOTO} | ({FILM: PHOTO} if film else {}),
            )
        except errors.UploadTooLargeError as error:
            if settings.photographs.require_features:
                raise errors.FeaturesRequiredError from error
            raise
    if settings.photographs.require_features and (parts.named(PHOTO) or parts.named(FILM)):
        raise errors.FeaturesRequiredError
    form = validate_fields(form_type, parts.fields, bounds)
    if isinstance(form, CameraFields) and "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.photographs.max_top_k)})
    return form, parts, QueryContext.starting(call.client, settings.requests.request_deadline_s, clock)


def photographs_of(parts: Parts, form: PhotographFields, call: ApiCall) -> list[Content]:
    """Return the photographs of a query in order: their files, or what was read of their features."""
    features = parts.named(FEATURES)
    if not features:
        return [*parts.named(PHOTO)]
    if stated := sorted(form.model_fields_set & PhotographFields.model_fields.keys()):
        raise errors.InvalidRequestError(
            [(name, f"is stated when {FEATURES} are computed; leave it out of the query") for name in stated]
        )
    for index, file in enumerate(features):
        if len(file) > MAX_BYTES:
            raise InvalidFeaturesError(f"{FEATURES}[{index}] has {len(file)} bytes; the limit is {MAX_BYTES}")
    return [read_features(file.read(), call.runtime.bundle) for file in features]


def check_anchor(place: PlanRecord | VenueRecord, media: str) -> None:
    """Check that the answer in a plan can be in latitude and longitude; in a venue it depends on the plan."""
    if media in (GEOJSON, GEOPOSE) and isinstance(place, PlanRecord) and place.plan.anchor is None:
        raise errors.UnanchoredPlanError(place.id)


def answer_as(answer: Answer, media: str, on_earth: Mapping[str, Callable[[Answer], Any]]) -> Response:
    """Return an answer as JSON, or in a form on Earth: the functions return None without an anchor."""
    if media == JSON:
        return Response(answer.model_dump_json(), headers=VARY, media_type=JSON)
    document = on_earth[media](answer)
    if document is None:
        raise errors.UnanchoredPlanError(answer.floorplan_id, answer.venue_id)
    return Response(json.dumps(document), headers=VARY, media_type=media)


async def keep_answer(answer: LocaliseAnswer, call: ApiCall) -> LocaliseAnswer:
    """Store an answer if `keep_answers_s` is set; return it with its id."""
    storage = call.settings.storage
    if storage.keep_answers_s == 0.0:
        return answer

    def with_id(answer_id: str) -> str:
        return answer.model_copy(update={"answer_id": answer_id}).model_dump_json()

    keep = partial(call.store.answers.add, limit=storage.max_kept_answers)
    try:
        answer_id = await call.read(keep, call.tenant, answer.floorplan_id, with_id)
    except (errors.StoreUnavailableError, errors.StorageQuotaError):
        # The answer is valid although it could not be kept.
        return answer
    return answer.model_copy(update={"answer_id": answer_id})
