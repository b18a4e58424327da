"""Liveness, readiness and metrics."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Response, status
from prometheus_client import CONTENT_TYPE_LATEST

from service.pools import PoolState
from service.runtime import Runtime, get_runtime
from service.schemas import HealthAnswer, PoolAnswer, ReadyAnswer

router = APIRouter(tags=["operations"])


@router.get("/healthz", summary="Check liveness")
async def get_health() -> HealthAnswer:
    """Return `ok` while the process runs."""
    return HealthAnswer(status="ok")


@router.get(
    "/readyz",
    summary="Check readiness",
    responses={
        503: {
            "model": ReadyAnswer,
            "description": "LPO or decoder processes are still starting, or the service is stopping.",
        }
    },
)
async def get_readiness(runtime: Annotated[Runtime, Depends(get_runtime)], response: Response) -> ReadyAnswer:
    """Return 200 once the model and all workers are ready, and 503 before that and while the service stops.

    Replacing a worker later does not make the service unready: queries wait, or keep the VDR pose.
    """
    if not runtime.ready:
        response.status_code = status.HTTP_503_SERVICE_UNAVAILABLE
        response.headers["Retry-After"] = "1"
    return ReadyAnswer(
        ready=runtime.ready,
        model=runtime.localiser.model,
        lpo_pool=_pool(runtime.optimiser.state),
        decode_pool=_pool(runtime.decoder.state),
        import_pool=_pool(runtime.converter.state),
        plans_preparing=runtime.grids.preparing,
    )


@router.get(
    "/metrics",
    summary="Get Prometheus metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def get_metrics(runtime: Annotated[Runtime, Depends(get_runtime)]) -> Response:
    """Return all metrics in Prometheus' text format."""
    # A coroutine, because it takes milliseconds and must work when every thread is busy.
    return Response(runtime.telemetry.render(), media_type=CONTENT_TYPE_LATEST)


def _pool(state: PoolState) -> PoolAnswer:
    return PoolAnswer(workers=state.workers, ready=state.ready, warmed_up=state.warmed_up, fault=state.fault)
