"""Liveness, readiness and metrics."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Response, status
from prometheus_client import CONTENT_TYPE_LATEST

from service.pools import PoolState
from service.runtime import Runtime, runtime_of
from service.schemas import HealthAnswer, PoolAnswer, ReadyAnswer

router = APIRouter(tags=["operations"])


@router.get("/healthz", summary="Is the process alive?")
async def healthz() -> HealthAnswer:
    """Always `ok` while the service runs."""
    return HealthAnswer(status="ok")


@router.get(
    "/readyz",
    summary="Can it answer at full quality?",
    responses={
        503: {
            "model": ReadyAnswer,
            "description": "Not yet: LPO or decoding processes are still warming up. Or no longer: the service stops.",
        }
    },
)
async def readyz(runtime: Annotated[Runtime, Depends(runtime_of)], response: Response) -> ReadyAnswer:
    """200 once the model and every worker have been warm, 503 before, and from when the service is told to stop.

    A worker that is replaced later does not make the service unready: queries are answered by VDR, or wait.
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
    summary="Prometheus metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(runtime: Annotated[Runtime, Depends(runtime_of)]) -> Response:
    """All metrics in Prometheus' text format."""
    # From memory in milliseconds, and told also when every thread is busy.
    return Response(runtime.telemetry.render(), media_type=CONTENT_TYPE_LATEST)


def _pool(state: PoolState) -> PoolAnswer:
    return PoolAnswer(workers=state.workers, ready=state.ready, warmed_up=state.warmed_up, fault=state.fault)
