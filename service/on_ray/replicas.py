"""Replicas of each deployment."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import ExitStack
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt64
from ray import serve
from ray.serve.handle import DeploymentHandle
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.venue.index_search import ShardSizes
from lalaloc_core.photograph import Photograph
from service.app import create_app
from service.errors import IndexTooLargeError, OverloadedError
from service.on_ray.index_shards import RemoteIndices, Stage
from service.on_ray.remote import RemoteLocaliser, RemoteOptimiser, RemotePhotographEncoder, Success, returning_failures
from service.query_components import Backends, warm_encoder
from service.runtime import start_runtime
from service.settings import Settings
from service.telemetry import Telemetry, configure_logging
from service.venues.plan_list import PlanList
from service.workers.lpo import load_refiner

# Indices that a shard makes at a time; they outlive the queries that wait for them.
_MAX_MAKING = 2


class EncoderReplica:
    """Encoder of photographs.

    Raises:
        RuntimeError: this machine has a different bundle.
    """

    def __init__(self, settings: Settings, model_sha256: str) -> None:
        self._encoder = warm_encoder(_same_bundle(settings, model_sha256), settings)

    def query(
        self,
        view: Photograph,
        heading: float | None,
        camera_height: CameraHeight,
        heading_tolerance: float,
        others: Sequence[tuple[Photograph, float]],
    ) -> Query:
        """See `PhotographEncoder.query`."""
        return self._encoder.query(view, heading, camera_height, heading_tolerance=heading_tolerance, others=others)


class LpoReplica:
    """Pose refinement on torch: the body of an LPO worker, in a process that Ray supervises."""

    def __init__(self, settings: Settings, model_sha256: str) -> None:
        self._refine = load_refiner(Path(settings.bundle), model_sha256, settings.compute.worker_threads)

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Return the result of a job."""
        # Copied, because torch warns about the read-only arrays of shared memory.
        return self._refine(deepcopy(job))


class _ServiceReplica:
    """The service without HTTP, with remote encoder and LPO; indices of venues are remote if there are `shards`."""

    def __init__(
        self,
        settings: Settings,
        model_sha256: str,
        encoder: DeploymentHandle,
        lpo: DeploymentHandle | None = None,
        shards: Sequence[DeploymentHandle] = (),
    ) -> None:
        _same_bundle(settings, model_sha256)
        configure_logging(settings.log_level)
        backends = Backends(
            optimiser=lambda _bundle, _settings, telemetry, *_: RemoteOptimiser(lpo, telemetry),
            encoder=lambda bundle, settings: RemotePhotographEncoder(bundle, settings, encoder),
            indices=(lambda settings: RemoteIndices(shards, settings)) if shards else None,
        )
        self._cleanup = ExitStack()
        self._runtime = start_runtime(settings, Telemetry(), self._cleanup, backends)

    def __del__(self) -> None:
        # Ray calls this when it stops a replica; `_cleanup` is missing if the start failed early.
        if (cleanup := self.__dict__.get("_cleanup")) is not None:
            cleanup.close()


class IndexReplica(_ServiceReplica):
    """Shard of the indices of venues; stages of a search are called by `index_shards.RemoteShard`."""

    def __init__(self, settings: Settings, model_sha256: str, encoder: DeploymentHandle) -> None:
        super().__init__(settings, model_sha256, encoder)
        self._making: dict[bytes, asyncio.Task[None]] = {}

    async def held(self, digest: bytes) -> Success[tuple[ShardSizes, UInt64[np.ndarray, "p"]] | None]:
        """Return the sizes of an index and the keys of its plans; None if it is not in memory.

        `digest` is that of the plans it was asked for, see `PlanList.digest`.
        """
        indexed = self._runtime.plan_indices.held(digest)
        return Success(None if indexed is None else (indexed.index.sizes, indexed.keys))

    @returning_failures
    async def hold(
        self, tenant: str, venue_id: str | None, plans: PlanList
    ) -> tuple[ShardSizes, UInt64[np.ndarray, "p"]]:
        """Index plans; return as `held` does.

        Raises:
            LaLaLocError: see `PlanIndices.index`.
            IndexTooLargeError: the index exceeds the memory for indices.
            OverloadedError: other indices are made already.
        """
        making = self._making.get(plans.digest)
        if making is None:
            if len(self._making) >= _MAX_MAKING:
                raise OverloadedError(_MAX_MAKING)
            making = self._making[plans.digest] = asyncio.create_task(self._make(tenant, venue_id, plans))
            making.add_done_callback(lambda _: self._making.pop(plans.digest))
        # A query that misses its deadline does not stop it, so that the next one finds the index.
        await asyncio.shield(making)
        indexed = self._runtime.plan_indices.held(plans.digest)
        if indexed is None:
            raise IndexTooLargeError(len(plans), self._runtime.settings.storage.venue_cache_bytes)
        return indexed.index.sizes, indexed.keys

    async def _make(self, tenant: str, venue_id: str | None, plans: PlanList) -> None:
        await self._runtime.plan_indices.index(tenant, plans, asyncio.to_thread, venue_id=venue_id)

    async def search(self, digest: bytes, stage: Stage, arguments: tuple[Any, ...]) -> Success[Any]:
        """Return the result of a stage of `Shard`; None if the index is not in memory."""
        indexed = self._runtime.plan_indices.held(digest)
        return Success(None if indexed is None else await asyncio.to_thread(getattr(indexed.index, stage)(*arguments)))


class SearchReplica(_ServiceReplica):
    """Search of plans and venues."""

    @returning_failures
    async def call(self, method: str, tenant: str, plan_id: str | None, venue_id: str | None, *arguments: Any) -> Any:
        """Return the result of a method of `Localiser` about a stored plan or venue."""
        where = await self._runtime.plan_lookup.place(tenant, plan_id, venue_id, self._runtime.reads)
        return await getattr(self._runtime.localiser, method)(where, *arguments)

    async def revisions(self) -> frozenset[str]:
        """Return the revisions of plans whose pose grids are in memory."""
        return frozenset(self._runtime.grids.revisions())


@serve.ingress()
class IngressReplica:
    """HTTP API: the normal application, with search replicas as its localisers."""

    def __init__(self, settings: Settings, lpo: DeploymentHandle | None, search: DeploymentHandle) -> None:
        self._settings, self._lpo, self._search = settings, lpo, search

    def __serve_build_asgi_app__(self) -> ASGIApp:
        backends = Backends(
            optimiser=lambda _bundle, _settings, telemetry, *_: RemoteOptimiser(self._lpo, telemetry),
            encoder=warm_encoder,
            localiser=lambda model, settings, telemetry: RemoteLocaliser(model, self._search, settings, telemetry),
        )
        return without_request_id(create_app(self._settings, backends))


def without_request_id(app: ASGIApp) -> ASGIApp:
    """Remove `X-Request-ID` from answers, because Ray's proxy adds it."""

    async def strip(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_stripped(message: Message) -> None:
            if message["type"] == "http.response.start":
                kept = [(name, value) for name, value in message["headers"] if name.lower() != b"x-request-id"]
                message = {**message, "headers": kept}
            await send(message)

        await app(scope, receive, send_stripped)

    return strip


def _same_bundle(settings: Settings, model_sha256: str) -> Bundle:
    bundle = Bundle.open(settings.bundle)
    if bundle.sha256 != model_sha256:
        raise RuntimeError(
            f"the bundle in {settings.bundle} has digest {bundle.sha256}; the application uses {model_sha256}"
        )
    return bundle
