"""Limits of requests."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends

from service.fair_share import max_per_client
from service.runtime import Runtime, get_runtime
from service.schemas import LimitsAnswer

router = APIRouter(tags=["operations"])


@router.get("/limits", summary="Get the limits")
async def limits(runtime: Annotated[Runtime, Depends(get_runtime)]) -> LimitsAnswer:
    """Return the limits of this service; an error about a limit names it."""
    settings = runtime.settings
    # Resolved, because 0 leaves these numbers to the service.
    resolved = {
        "max_queries": settings.query_limit,
        "max_queries_per_tenant": max_per_client(settings.query_limit),
        "max_pending_requests": settings.pending_limit,
    }
    values = settings.values() | resolved
    return LimitsAnswer(**{name: values[name] for name in LimitsAnswer.model_fields})
