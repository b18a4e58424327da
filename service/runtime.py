"""The parts of a running service, built once at start-up and taken down in reverse order."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from fastapi import Request

from lalaloc_core import __version__
from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from service.conversion import Converter
from service.fair_share import with_headroom
from service.grids import GridProvider, Sweeper
from service.http import Admission, AdmissionLimits
from service.http.events import HEARTBEAT_S, PlanEvents
from service.preview import Drawings
from service.query import (
    Answering,
    Decoder,
    Localiser,
    LpoPool,
    Refining,
    VenueAnswering,
    VenueLocaliser,
    VenuePlans,
)
from service.schemas import ModelAnswer
from service.security import AccessControl
from service.settings import Settings
from service.storage import PlanLookup, Store, open_store
from service.telemetry import LOGGER_NAME, Telemetry
from service.telemetry.tracing import Tracing, otlp_exporter
from service.threads import BoundedReads, Threads

# Queries read little: their plan, and a grid that is not in memory.
_READ_THREADS = 4
# Small grids are computed on them: more of one tenant would take the cores from queries.
_UPLOAD_THREADS = with_headroom(2)
# Drawings in memory, and revisions that wait to be drawn.
# Poses of the plans of a venue that are searched together, besides a single larger plan: they are copied for a query.
_VENUE_POSES = 40_000
_DRAWINGS_BYTES, _MAX_DRAWN = 32 * 2**20, 16
# With keys that are not remembered, streams still look no more often.
_MIN_HEARTBEAT_S = 1.0
# Share of the time for stopping that LPO jobs may go on in.
_LPO_DRAIN = 0.1


class _Closable(Protocol):
    close: Callable[..., None]


Closed = TypeVar("Closed", bound=_Closable)


@dataclass(frozen=True, kw_only=True)
class Runtime:
    """Everything that the routes need.

    Attributes:
        uploads: threads that check, prepare and store plans.
        file_uploads: those for plans whose files a converter reads, which is waited for.
        reads: what queries read of the store.
        drawings: drawings and meshes of plans.
    """

    settings: Settings
    telemetry: Telemetry
    store: Store
    grids: GridProvider
    plan_lookup: PlanLookup
    pool: Refining
    decoder: Decoder
    converter: Converter
    localiser: Answering
    venue_localiser: VenueAnswering
    admission: Admission
    access_control: AccessControl
    events: PlanEvents
    uploads: Threads
    file_uploads: Threads
    reads: BoundedReads
    drawings: Drawings

    @property
    def ready(self) -> bool:
        """Whether workers are warm, as the model is before the first request is taken, and the service goes on."""
        return not self.admission.draining and self.pool.state.warmed_up and self.decoder.state.warmed_up


@dataclass(frozen=True, kw_only=True)
class Elsewhere:
    """What makes those parts that may be in other processes than the service's own and its workers; by default none is.

    Attributes:
        pool: who optimises poses.
        encoders: the networks, warm.
        queries: who answers queries; None: this process.
    """

    pool: Callable[[Bundle, Settings, Telemetry], Refining]
    encoders: Callable[[Bundle, Settings], Encoders]
    queries: Callable[[ModelAnswer, Settings, Telemetry], tuple[Answering, VenueAnswering]] | None = None


def warm_encoders(bundle: Bundle, settings: Settings) -> Encoders:
    """The networks, each of which has run once; the first run allocates."""
    encoders = Encoders(bundle, threads=settings.cores.onnx_threads)
    manifest = encoders.manifest
    image = np.zeros((manifest.image_height, manifest.image_width, 3), np.uint8)
    encoders.query(image, None, CameraHeight(1.5))
    encoders.layouts(np.full((1, manifest.profile_columns), 2.0), np.array([1.5]), np.array([2.5]))
    return encoders


HERE = Elsewhere(pool=LpoPool, encoders=warm_encoders)


def start_runtime(settings: Settings, telemetry: Telemetry, cleanup: ExitStack, elsewhere: Elsewhere = HERE) -> Runtime:
    """Open the store, load and warm the model, start the LPO pool, and queue unfinished grids.

    Blocks for as long as the model loads; the pool warms up in the background.

    Args:
        cleanup: takes what has to be closed, also when starting fails half-way.
        elsewhere: what is not in this process.

    Raises:
        ConfigError: the data folder or the database cannot be used.
        BundleError: there is no usable model.
    """

    def kept(part: Closed, *arguments: float) -> Closed:
        cleanup.callback(part.close, *arguments)
        return part

    if settings.otlp_endpoint is not None:
        telemetry.tracing = kept(Tracing(otlp_exporter(settings.otlp_endpoint), __version__))
    bundle = Bundle.open(settings.bundle)
    store = kept(open_store(settings))
    access_control = kept(AccessControl(store.keys, settings))
    # The pool first: loading torch in the workers overlaps with loading the model here.
    pool = kept(elsewhere.pool(bundle, settings, telemetry), _LPO_DRAIN * settings.stop_deadline_s)
    pool.start()
    decoder = kept(Decoder(bundle.manifest, settings, telemetry))
    decoder.start()
    encoders = elsewhere.encoders(bundle, settings)
    grids = kept(GridProvider(store, encoders, bundle.sha256, settings, telemetry))
    admission = Admission(AdmissionLimits.of(settings), telemetry)
    reads = kept(
        BoundedReads(threads=_READ_THREADS, max_pending=settings.pending_limit, wait_s=settings.database_wait_s)
    )
    uploads = kept(Threads("lalaloc-uploads", _UPLOAD_THREADS))
    # As many as may be read at a time, and after the converter in being closed: what waits for it must be let go first.
    file_uploads = kept(Threads("lalaloc-files", with_headroom(settings.import_workers)))
    converter = kept(Converter(settings, telemetry))
    localiser = kept(
        Localiser(
            settings=settings,
            bundle=bundle,
            encoders=encoders,
            grids=grids,
            pool=pool,
            decoder=decoder,
            queries=admission.queries,
            reads=reads,
            telemetry=telemetry,
        )
    )
    sweeper = kept(Sweeper(store, grids, sweep_s=settings.sweep_s, keep_answers_s=settings.keep_answers_s))
    sweeper.start()
    # One look at a time, which takes no thread from queries while the database is silent.
    looks = kept(BoundedReads(threads=1, max_pending=1, wait_s=settings.database_wait_s))
    answering: Answering = localiser
    venue_answering: VenueAnswering = VenueLocaliser(
        settings=settings,
        bundle=bundle,
        encoders=encoders,
        plans=kept(_venue_plans(store, grids, reads, settings)),
        localiser=localiser,
        decoder=decoder,
        queries=admission.queries,
    )
    if elsewhere.queries is not None:
        answering, venue_answering = elsewhere.queries(localiser.model, settings, telemetry)
    _tell_start(bundle, grids, telemetry)
    return Runtime(
        settings=settings,
        telemetry=telemetry,
        store=store,
        grids=grids,
        plan_lookup=PlanLookup(store, max_age_s=settings.plan_cache_age_s),
        pool=pool,
        decoder=decoder,
        converter=converter,
        localiser=answering,
        venue_localiser=venue_answering,
        admission=admission,
        access_control=access_control,
        events=_plan_events(store, grids, admission, looks, settings),
        uploads=uploads,
        file_uploads=file_uploads,
        reads=reads,
        drawings=kept(Drawings(limit_bytes=_DRAWINGS_BYTES, max_waiting=_MAX_DRAWN)),
    )


def _venue_plans(store: Store, grids: GridProvider, reads: BoundedReads, settings: Settings) -> VenuePlans:
    return VenuePlans(
        store,
        grids,
        reads,
        path=settings.data_dir / "prototypes.bin",
        file_bytes=settings.venue_file_bytes,
        limit_bytes=settings.venue_cache_bytes,
        max_poses=min(settings.max_grid_poses, _VENUE_POSES),
    )


async def runtime_of(request: Request) -> Runtime:
    """The running service that a request came to.

    A coroutine only so that the framework does not call it on one of its threads, which slow reads may fill.
    """
    return request.app.state.runtime


def _plan_events(
    store: Store, grids: GridProvider, admission: Admission, looks: BoundedReads, settings: Settings
) -> PlanEvents:
    # Their callers' keys are looked at again as often.
    heartbeat_s = max(min(settings.key_cache_s, HEARTBEAT_S), _MIN_HEARTBEAT_S) if settings.api_keys else HEARTBEAT_S
    return PlanEvents(store, grids, admission, looks, max_s=settings.stream_deadline_s, heartbeat_s=heartbeat_s)


def _tell_start(bundle: Bundle, grids: GridProvider, telemetry: Telemetry) -> None:
    manifest = bundle.manifest
    telemetry.describe_build(__version__, manifest.name, manifest.version, bundle.sha256)
    fields = {"model": manifest.name, "sha256": bundle.sha256, "grids_to_compute": grids.preparing}
    logging.getLogger(LOGGER_NAME).info("service started", extra={"fields": fields})
