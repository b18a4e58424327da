"""Limits of the service, and the use that a tenant makes of them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter

from service.capacity.fair_share import max_per_client
from service.errors import StoreUnavailableError
from service.http.problems import problem_responses
from service.routes.dependencies import Client, Running, Tenant
from service.schemas import BytesInFlightAnswer, LimitsAnswer, StoredBytesAnswer, StoredBytesByKind, UsageAnswer

router = APIRouter(tags=["operations"])


@router.get("/limits", summary="Get the limits")
async def get_limits(runtime: Running) -> LimitsAnswer:
    """Return the limits of this service; an error about a limit names it."""
    settings = runtime.settings
    # Resolved, because 0 leaves these numbers to the service.
    resolved: dict[str, Any] = {
        "max_queries": settings.query_limit,
        "max_queries_per_tenant": max_per_client(settings.query_limit),
        "max_pending_requests": settings.pending_limit,
    }
    named = {name: settings.value(name) for name in LimitsAnswer.model_fields.keys() - resolved.keys()}
    return LimitsAnswer(**named, **resolved)


@router.get("/usage", summary="Get the tenant's usage", responses=problem_responses(StoreUnavailableError))
def get_usage(runtime: Running, tenant: Tenant, client: Client) -> UsageAnswer:
    """Return what the tenant of the API key uses, with its limits."""
    account = runtime.store.quota.account(tenant)
    stored = StoredBytesAnswer(
        used=account.used.total, limit=account.limit, by_kind=StoredBytesByKind(**asdict(account.used))
    )
    admission = runtime.admission
    in_flight = BytesInFlightAnswer(
        used=admission.bytes_in_flight.held_by(client), limit=admission.bytes_in_flight.limit_of(client)
    )
    cpu_s = round(admission.cpu_accounts.total_s(client), 3)
    return UsageAnswer(tenant=tenant, stored_bytes=stored, bytes_in_flight=in_flight, cpu_seconds=cpu_s)
