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
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from service.conversion import Converter
from service.fair_share import with_headroom
from service.grids import GridProvider, Sweeper
from service.http import Admission, AdmissionLimits
from service.http.events import HEARTBEAT_S, PlanEvents
from service.preview import Drawings
from service.query import (
    Decoder,
    Localiser,
    LocaliserBackend,
    LpoPool,
    OptimiserBackend,
    VenueLocaliser,
    VenueLocaliserBackend,
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
# Poses of the plans of a venue that are searched together, besides a single larger plan: they are copied for a query.
_VENUE_POSES = 40_000
# Drawings in memory, and revisions that wait to be drawn.
_DRAWINGS_BYTES, _MAX_DRAWN = 32 * 2**20, 16
# Age up to which a plan in memory is used while the database is away.
_PLAN_CACHE_AGE_S = 600.0
# Timeout of an event stream; the client then asks again.
STREAM_DEADLINE_S = 900.0
# With keys that are not remembered, streams still look no more often.
_MIN_HEARTBEAT_S = 1.0
# Share of the time for stopping that LPO jobs may go on in.
_LPO_DRAIN = 0.1


class _Closable(Protocol):
    close: Callable[..., None]


Part = TypeVar("Part", bound=_Closable)


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
    optimiser: OptimiserBackend
    decoder: Decoder
    converter: Converter
    localiser: LocaliserBackend
    venue_localiser: VenueLocaliserBackend
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
        return not self.admission.draining and self.optimiser.state.warmed_up and self.decoder.state.warmed_up


@dataclass(frozen=True, kw_only=True)
class Backends:
    """What makes those parts that may be in other processes than the service's own and its workers.

    Attributes:
        optimiser: who optimises poses.
        encoders: the networks, warm.
        localisers: who answers queries; None: this process.
    """

    optimiser: Callable[[Bundle, Settings, Telemetry], OptimiserBackend]
    encoders: Callable[[Bundle, Settings], Encoders]
    localisers: Callable[[ModelAnswer, Settings, Telemetry], tuple[LocaliserBackend, VenueLocaliserBackend]] | None = (
        None
    )


def warm_encoders(bundle: Bundle, settings: Settings) -> Encoders:
    """The networks, each of which has run once; the first run allocates."""
    encoders = Encoders(bundle, threads=settings.cores.onnx_threads)
    manifest = encoders.manifest
    image = np.zeros((manifest.image_height, manifest.image_width, 3), np.uint8)
    encoders.query(image, None, CameraHeight(1.5))
    encoders.layouts(np.full((1, manifest.profile_columns), 2.0), np.array([1.5]), np.array([2.5]))
    return encoders


# None is in another process.
LOCAL_BACKENDS = Backends(optimiser=LpoPool, encoders=warm_encoders)


def start_runtime(
    settings: Settings, telemetry: Telemetry, cleanup: ExitStack, backends: Backends = LOCAL_BACKENDS
) -> Runtime:
    """Open the store, load and warm the model, start the worker processes, and queue unfinished grids.

    Blocks for as long as the model loads; the workers warm up in the background.

    Args:
        cleanup: takes what has to be closed, also when starting fails half-way.
        backends: what may be in other processes.

    Raises:
        ConfigError: the data folder or the database cannot be used.
        BundleError: there is no usable model.
    """
    if settings.otlp_endpoint is not None:
        telemetry.tracing = _closing(cleanup, Tracing(otlp_exporter(settings.otlp_endpoint), __version__))
    bundle = Bundle.open(settings.bundle)
    store = _closing(cleanup, open_store(settings))
    access_control = _closing(cleanup, AccessControl(store.keys, settings))
    searching = _Searching.start(settings, telemetry, cleanup, backends, bundle, store)
    uploads = _closing(cleanup, Threads("lalaloc-uploads", _UPLOAD_THREADS))
    # As many as may be read at a time, and after the converter in being closed: what waits for it must be let go first.
    file_uploads = _closing(cleanup, Threads("lalaloc-files", with_headroom(settings.imports.workers)))
    converter = _closing(cleanup, Converter(settings, telemetry))
    grids, localiser = searching.grids, _closing(cleanup, searching.localiser())
    sweeper = Sweeper(store, grids, sweep_s=settings.grids.sweep_s, keep_answers_s=settings.storage.keep_answers_s)
    _closing(cleanup, sweeper).start()
    # One read at a time, which takes no thread from queries while the database is silent.
    event_reads = _closing(cleanup, _reads(settings, threads=1, max_pending=1))
    venue_localiser = searching.venue_localiser(localiser, _closing(cleanup, searching.venue_plans()))
    if backends.localisers is None:
        localisers = localiser, venue_localiser
    else:
        localisers = backends.localisers(localiser.model, settings, telemetry)
    _log_start(bundle, grids, telemetry)
    return Runtime(
        settings=settings,
        telemetry=telemetry,
        store=store,
        grids=grids,
        plan_lookup=PlanLookup(store, max_age_s=_PLAN_CACHE_AGE_S),
        optimiser=searching.optimiser,
        decoder=searching.decoder,
        converter=converter,
        localiser=localisers[0],
        venue_localiser=localisers[1],
        admission=searching.admission,
        access_control=access_control,
        events=_plan_events(store, grids, searching.admission, event_reads, settings),
        uploads=uploads,
        file_uploads=file_uploads,
        reads=searching.reads,
        drawings=_closing(cleanup, Drawings(limit_bytes=_DRAWINGS_BYTES, max_waiting=_MAX_DRAWN)),
    )


@dataclass(frozen=True, kw_only=True)
class _Searching:
    """What queries are answered with in this process."""

    settings: Settings
    telemetry: Telemetry
    bundle: Bundle
    store: Store
    encoders: Encoders
    grids: GridProvider
    optimiser: OptimiserBackend
    decoder: Decoder
    admission: Admission
    reads: BoundedReads

    @classmethod
    def start(
        cls,
        settings: Settings,
        telemetry: Telemetry,
        cleanup: ExitStack,
        backends: Backends,
        bundle: Bundle,
        store: Store,
    ) -> _Searching:
        """Start the worker processes, which warm up in the background, and load the model."""
        # The workers first: loading torch in them overlaps with loading the model here.
        optimiser = backends.optimiser(bundle, settings, telemetry)
        _closing(cleanup, optimiser, _LPO_DRAIN * settings.requests.stop_deadline_s).start()
        decoder = _closing(cleanup, Decoder(bundle.manifest, settings, telemetry))
        decoder.start()
        encoders = backends.encoders(bundle, settings)
        return cls(
            settings=settings,
            telemetry=telemetry,
            bundle=bundle,
            store=store,
            encoders=encoders,
            grids=_closing(cleanup, GridProvider(store, encoders, bundle.sha256, settings, telemetry)),
            optimiser=optimiser,
            decoder=decoder,
            admission=Admission(AdmissionLimits.of(settings), telemetry),
            reads=_closing(cleanup, _reads(settings, threads=_READ_THREADS, max_pending=settings.pending_limit)),
        )

    def localiser(self) -> Localiser:
        """What answers queries about plans."""
        return Localiser(
            settings=self.settings,
            bundle=self.bundle,
            encoders=self.encoders,
            grids=self.grids,
            optimiser=self.optimiser,
            decoder=self.decoder,
            queries=self.admission.queries,
            reads=self.reads,
            telemetry=self.telemetry,
        )

    def venue_plans(self) -> VenuePlans:
        """What finds the plans of a venue."""
        return VenuePlans(
            self.store,
            self.grids,
            self.reads,
            path=self.settings.data_dir / "prototypes.bin",
            file_bytes=self.settings.storage.venue_file_bytes,
            limit_bytes=self.settings.storage.venue_cache_bytes,
            max_poses=min(self.settings.grids.max_grid_poses, _VENUE_POSES),
        )

    def venue_localiser(self, localiser: Localiser, plans: VenuePlans) -> VenueLocaliser:
        """What answers queries about venues."""
        return VenueLocaliser(
            settings=self.settings,
            bundle=self.bundle,
            encoders=self.encoders,
            plans=plans,
            localiser=localiser,
            decoder=self.decoder,
            queries=self.admission.queries,
        )


def _closing(cleanup: ExitStack, part: Part, *arguments: float) -> Part:
    """A part, which is closed with everything else."""
    cleanup.callback(part.close, *arguments)
    return part


def _reads(settings: Settings, *, threads: int, max_pending: int) -> BoundedReads:
    return BoundedReads(threads=threads, max_pending=max_pending, wait_s=settings.database.wait_s)


async def runtime_of(request: Request) -> Runtime:
    """The running service that a request came to.

    A coroutine only so that the framework does not call it on one of its threads, which slow reads may fill.
    """
    return request.app.state.runtime


def _plan_events(
    store: Store, grids: GridProvider, admission: Admission, reads: BoundedReads, settings: Settings
) -> PlanEvents:
    # Their callers' keys are looked at again as often.
    heartbeat_s = (
        max(min(settings.access.key_cache_s, HEARTBEAT_S), _MIN_HEARTBEAT_S)
        if settings.access.api_keys
        else HEARTBEAT_S
    )
    return PlanEvents(store, grids, admission, reads, max_s=STREAM_DEADLINE_S, heartbeat_s=heartbeat_s)


def _log_start(bundle: Bundle, grids: GridProvider, telemetry: Telemetry) -> None:
    manifest = bundle.manifest
    telemetry.describe_build(__version__, manifest.name, manifest.version, bundle.sha256)
    fields = {"model": manifest.name, "sha256": bundle.sha256, "grids_to_compute": grids.preparing}
    logging.getLogger(LOGGER_NAME).info("service started", extra={"fields": fields})
