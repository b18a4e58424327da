"""State of the service: liveness, readiness, metrics, limits, and the use that a tenant makes of them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Response, status
from prometheus_client import CONTENT_TYPE_LATEST

from service.capacity.admission_control import PROBE, admitted_as
from service.capacity.fair_share import max_per_client
from service.errors import StoreUnavailableError
from service.http.problems import problem_responses
from service.routes.dependencies import Call, Running
from service.schemas import service_state as schemas

router = APIRouter(tags=["operations"])


@router.get("/healthz", summary="Check liveness")
@admitted_as(PROBE)
async def get_health() -> schemas.HealthAnswer:
    """Return `ok` while the process runs."""
    return schemas.HealthAnswer(status="ok")


@router.get(
    "/readyz",
    summary="Check readiness",
    responses={
        503: {
            "model": schemas.ReadyAnswer,
            "description": "LPO or decoder processes are still starting, or the service is stopping.",
        }
    },
)
@admitted_as(PROBE)
async def get_readiness(runtime: Running, response: Response) -> schemas.ReadyAnswer:
    """Return 200 once the model and all workers are ready, and 503 before that and while the service stops.

    Replacing a worker later does not make the service unready: queries wait, or keep the VDR pose.
    """
    if not runtime.ready:
        response.status_code = status.HTTP_503_SERVICE_UNAVAILABLE
        response.headers["Retry-After"] = "1"
    return schemas.ReadyAnswer(
        ready=runtime.ready,
        model=runtime.localiser.model,
        lpo_pool=schemas.PoolAnswer(**asdict(runtime.optimiser.state)),
        decode_pool=schemas.PoolAnswer(**asdict(runtime.decoder.state)),
        import_pool=schemas.PoolAnswer(**asdict(runtime.converter.state)),
        database=runtime.store.database.state,
        plans_preparing=runtime.grids.preparing,
    )


@router.get(
    "/metrics",
    summary="Get Prometheus metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
@admitted_as(PROBE)
async def get_metrics(runtime: Running) -> Response:
    """Return all metrics in Prometheus' text format."""
    # A coroutine, because it takes milliseconds and must work when every thread is busy.
    return Response(runtime.telemetry.render(), media_type=CONTENT_TYPE_LATEST)


@router.get("/limits", summary="Get the limits")
async def get_limits(runtime: Running) -> schemas.LimitsAnswer:
    """Return the limits of this service; an error about a limit names it."""
    settings = runtime.settings
    # Resolved, because 0 leaves these numbers to the service.
    resolved: dict[str, Any] = {
        "max_queries": settings.query_limit,
        "max_queries_per_tenant": max_per_client(settings.query_limit),
        "max_pending_requests": settings.pending_limit,
    }
    named = {name: settings.value(name) for name in schemas.LimitsAnswer.model_fields.keys() - resolved.keys()}
    return schemas.LimitsAnswer(**named, **resolved)


@router.get("/usage", summary="Get the tenant's usage", responses=problem_responses(StoreUnavailableError))
def get_usage(call: Call) -> schemas.UsageAnswer:
    """Return what the tenant of the API key uses, with its limits."""
    account = call.store.quota.account(call.tenant)
    stored = schemas.StoredBytesAnswer(
        used=account.used.total, limit=account.limit, by_kind=schemas.StoredBytesByKind(**asdict(account.used))
    )
    admission, client = call.runtime.admission, call.client
    in_flight = schemas.BytesInFlightAnswer(
        used=admission.bytes_in_flight.held_by(client), limit=admission.bytes_in_flight.limit_of(client)
    )
    cpu_s = round(admission.cpu_accounts.total_s(client), 3)
    return schemas.UsageAnswer(tenant=call.tenant, stored_bytes=stored, bytes_in_flight=in_flight, cpu_seconds=cpu_s)
