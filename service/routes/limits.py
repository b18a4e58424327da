"""What requests may be."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends

from service.fair_share import max_per_client
from service.runtime import Runtime, runtime_of
from service.schemas import LimitsAnswer

router = APIRouter(tags=["operations"])


@router.get("/limits", summary="What may requests be?")
async def limits(runtime: Annotated[Runtime, Depends(runtime_of)]) -> LimitsAnswer:
    """The limits this service was started with; the error about one names it."""
    settings = runtime.settings
    # As they are in effect: the settings may leave these numbers to the service.
    resolved = {
        "max_queries": settings.query_limit,
        "max_queries_per_tenant": max_per_client(settings.query_limit),
        "max_pending_requests": settings.pending_limit,
    }
    values = settings.values() | resolved
    return LimitsAnswer(**{name: values[name] for name in LimitsAnswer.model_fields})
