"""Clients of other deployments, with the interfaces of the local components."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from time import monotonic
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from ray.exceptions import RayError
from ray.serve.exceptions import BackPressureError
from ray.serve.handle import DeploymentHandle

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import LaLaLocError
from lalaloc_core.localise.answers.documents import ModelAnswer
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.photograph import Photograph
from service.errors import DeadlineExceededError, OverloadedError
from service.pools import LostReason, PoolState
from service.query import SOLVE_S, AlbumQuery, AnyQuery, PictureQuery, QueryContext, Where
from service.schemas import LocaliseAnswer, SequenceAnswer
from service.schemas.query_fields import HeightFields
from service.settings import Settings
from service.storage.records import VenueRecord
from service.telemetry import Telemetry

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")


@dataclass(frozen=True)
class Success(Generic[T]):
    """Answer."""

    value: T


@dataclass(frozen=True)
class Failure:
    """Error for the caller."""

    error: LaLaLocError


def returning_failures(
    method: Callable[Concatenate[S, P], Awaitable[T]],
) -> Callable[Concatenate[S, P], Coroutine[Any, Any, Success[T] | Failure]]:
    """Make a replica's method return its answer or the `LaLaLocError` that it raises as an outcome."""

    @wraps(method)
    async def wrapper(self: S, *args: P.args, **kwargs: P.kwargs) -> Success[T] | Failure:
        try:
            return Success(await method(self, *args, **kwargs))
        except LaLaLocError as error:
            return Failure(error)

    return wrapper


# Calls store nothing, so they are repeated if a replica dies.
_ATTEMPTS = 2
# Extra time for the answer of the remote service, whose own timeout error is more specific.
_ON_THE_WAY_S = 1.0

AnswerT = TypeVar("AnswerT")


def result_of(begin: Callable[[], Any], deadline_s: float, missed: str) -> Any:
    """Return the result of a call, which is begun again if the replica dies; blocks, so call it from a thread."""
    for _ in range(_ATTEMPTS):
        response = begin()
        try:
            return response.result(timeout_s=deadline_s)
        except TimeoutError:
            response.cancel()
            break
        except RayError:
            continue
    raise DeadlineExceededError(deadline_s, missed)


class RemotePhotographEncoder(PhotographEncoder):
    """Networks of which those for photographs are remote."""

    def __init__(self, bundle: Bundle, settings: Settings, encoder: DeploymentHandle) -> None:
        super().__init__(bundle, threads=settings.cores.onnx_threads)
        self._deadline_s, self._encoder = settings.requests.request_deadline_s, encoder

    def query(
        self,
        photograph: Photograph,
        heading: float | None,
        camera_height: CameraHeight,
        *,
        heading_tolerance: float = 0.0,
        others: Sequence[tuple[Photograph, float]] = (),
    ) -> Query:
        """Compute a query as `PhotographEncoder.query` does; blocks, so call it from a thread.

        Raises:
            InvalidPhotographError: see `PhotographEncoder.query`.
        """
        self.check(photograph)
        begin = partial(self._encoder.query.remote, photograph, heading, camera_height, heading_tolerance, others)
        return result_of(begin, self._deadline_s, "the photograph was not encoded")


class RemoteOptimiser:
    """Remote LPO; if a job fails for any reason, the query keeps the VDR pose, as with `LpoPool`."""

    def __init__(self, lpo: DeploymentHandle | None, telemetry: Telemetry) -> None:
        self._lpo, self._telemetry = lpo, telemetry

    def start(self) -> None:
        """Do nothing: Ray starts the replicas."""

    @property
    def state(self) -> PoolState:
        """Return the state of one worker that is always ready; Ray starts and replaces the replicas."""
        workers = 0 if self._lpo is None else 1
        return PoolState(workers=workers, ready=workers, warmed_up=True, fault=None)

    async def refine(self, job: RefinementJob, timeout_s: float, client: str = "") -> RefinementResult | None:
        """Refine as `LpoPool.refine` does, but without taking turns between clients."""
        if self._lpo is None or timeout_s <= 0.0:
            return None
        deadline = monotonic() + timeout_s
        for _ in range(_ATTEMPTS):
            response = self._lpo.refine.remote(job)
            try:
                async with asyncio.timeout(max(deadline - monotonic(), 0.0)):
                    return await response
            except TimeoutError:
                response.cancel()
                return self._missed("deadline")
            except BackPressureError:
                return self._missed("queue-full")
            except RayError:
                continue
        return self._missed("died")

    def close(self, drain_s: float = 0.0) -> None:
        """Do nothing: Ray stops the replicas."""

    def _missed(self, reason: LostReason) -> None:
        self._telemetry.lpo_missed.labels(reason).inc()


class RemoteLocaliser:
    """Localisation by search replicas; queries about the same plan or venue go to the same one."""

    def __init__(self, model: ModelAnswer, search: DeploymentHandle, settings: Settings, telemetry: Telemetry) -> None:
        self.model, self._search, self._settings, self._telemetry = model, search, settings, telemetry

    async def answer(self, where: Where, query: AnyQuery[AnswerT]) -> AnswerT:
        """See `Localiser.answer`."""
        context = query.context.with_time(SOLVE_S) if isinstance(query, AlbumQuery) else query.context
        found = await self._call("answer", where, context, query)
        answer = found[0] if isinstance(query, PictureQuery) else found
        if isinstance(answer, LocaliseAnswer | SequenceAnswer):
            # The metrics of this process are scraped.
            self._telemetry.observe_answer(answer.timings_ms.model_dump(exclude_none=True), answer.stage)
        return found

    async def check(self, where: Where, form: HeightFields) -> None:
        """See `Localiser.check`."""
        context = QueryContext.starting(where.tenant, self._settings.requests.request_deadline_s)
        await self._call("check", where, context, form)

    async def _call(self, method: str, where: Where, context: QueryContext, argument: Any) -> Any:
        # Each replica has the record of the plan or venue in its own cache.
        place = (None, where.id) if isinstance(where, VenueRecord) else (where.id, None)
        with context.clock.stage("search"):
            for _ in range(_ATTEMPTS):
                response = self._search.options(session_id=where.id).call.remote(method, where.tenant, *place, argument)
                try:
                    async with asyncio.timeout(max(context.left_s + _ON_THE_WAY_S, 0.0)):
                        outcome: Success[Any] | Failure = await response
                except TimeoutError:
                    response.cancel()
                    break
                except BackPressureError as error:
                    raise OverloadedError(self._settings.query_limit) from error
                except RayError:
                    continue
                if isinstance(outcome, Failure):
                    raise outcome.error
                return outcome.value
        raise DeadlineExceededError(self._settings.requests.request_deadline_s)
