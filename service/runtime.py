"""Components of a running service, built at start-up and closed in reverse order."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeVar

from fastapi import Request
from sqlalchemy.engine import make_url

from lalaloc_core import __version__
from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from service.albums.album_solver import AlbumSolver
from service.capacity.admission_control import Admission, AdmissionLimits
from service.capacity.cores import usable_cores
from service.capacity.cpu_accounts import PROBES
from service.capacity.fair_share import FairSemaphore, with_headroom
from service.capacity.threads import BoundedReads, IdleCores, Threads
from service.decoding.decoder import Decoder
from service.grids import GridProvider, Sweeper
from service.http.events import ALBUM_ENDS, PLAN_ENDS, ProgressEvents, album_look, heartbeat_s, plan_look
from service.plan_files.converter import Converter
from service.plan_files.rendition_cache import RenditionCache
from service.query import (
    Executor,
    Grounds,
    Localiser,
    LocaliserBackend,
    LpoPool,
    OptimiserBackend,
    PhotographReader,
    QueryParts,
)
from service.schemas import ModelAnswer
from service.schemas.albums import AlbumEvent
from service.schemas.stored_plans import PlanEvent
from service.security import AccessControl, AuditTrail
from service.settings import Settings
from service.storage import PlanLookup, Store, open_store
from service.storage.records import DEFAULT_TENANT
from service.telemetry import LOGGER_NAME, Telemetry
from service.telemetry.tracing import Tracing, otlp_exporter
from service.venues.plan_indices import IndexSource, PlanIndices
from service.venues.venue_plans import VenuePlans
from service.venues.venue_search import VenueSearch

# Queries read little: a plan, and a pose grid that is not in memory.
_READ_THREADS = 4
# Uploads compute small pose grids, so more threads would take cores from queries.
_UPLOAD_THREADS = with_headroom(2)
# Limit of the poses that a venue query searches, because it copies them. A single plan can have more.
_VENUE_POSES = 40_000
# Limit of the files of stored plans that are made or wait.
_MAX_PENDING_RENDITIONS = 16
# Age up to which a plan in memory is used while the database is away.
_PLAN_CACHE_AGE_S = 600.0
# Timeout of an event stream; the client then reconnects.
STREAM_DEADLINE_S = 900.0
# Longest time that a thread keeps the interpreter while others wait. Python's 5 ms add up in a query, which waits for
# it several times beside other tenants' queries that compute.
_SWITCH_INTERVAL_S = 0.0005
# Timeout (s) of reading or writing the features and pins of an album.
_ALBUM_WAIT_S = 30.0
# Share of the stop timeout in which running LPO jobs can finish.
_LPO_DRAIN = 0.1


class _Closable(Protocol):
    close: Callable[..., None]


Part = TypeVar("Part", bound=_Closable)


@dataclass(frozen=True, kw_only=True)
class Runtime:
    """Components that the routes use.

    Attributes:
        bundle: the model.
        uploads: threads that check, prepare and store plans.
        file_uploads: threads for uploads that wait for the converter.
        reads: store reads of queries.
        venue_plans: rows of the plans of venues in memory.
        plan_indices: indices of venues in this process.
        renditions: files made from stored plans.
        permits: permits to compute, of which each piece of work holds one.
        albums: solves albums, while its `run` does.
    """

    settings: Settings
    telemetry: Telemetry
    bundle: Bundle
    store: Store
    grids: GridProvider
    plan_lookup: PlanLookup
    optimiser: OptimiserBackend
    decoder: Decoder
    converter: Converter
    localiser: LocaliserBackend
    admission: Admission
    access_control: AccessControl
    audit_trail: AuditTrail
    events: ProgressEvents[PlanEvent]
    album_events: ProgressEvents[AlbumEvent]
    albums: AlbumSolver
    uploads: Threads
    file_uploads: Threads
    reads: BoundedReads
    venue_plans: VenuePlans
    plan_indices: PlanIndices
    renditions: RenditionCache
    permits: FairSemaphore

    @property
    def ready(self) -> bool:
        """True if all workers have started and the service is not stopping."""
        return not self.admission.draining and self.optimiser.state.warmed_up and self.decoder.state.warmed_up


@dataclass(frozen=True, kw_only=True)
class Backends:
    """Builders of the components that can run in other processes.

    Attributes:
        optimiser: builds the pool of LPO workers; the last argument tells whether poses are refined by latents.
        encoder: loads the networks and warms them up.
        localiser: builds the localiser; None: this process computes answers.
        indices: builds the source of the indices of venues; None: they are in this process.
    """

    optimiser: Callable[[Bundle, Settings, Telemetry, FairSemaphore, bool], OptimiserBackend]
    encoder: Callable[[Bundle, Settings], PhotographEncoder]
    localiser: Callable[[ModelAnswer, Settings, Telemetry], LocaliserBackend] | None = None
    indices: Callable[[Settings], IndexSource] | None = None


def warm_encoder(bundle: Bundle, settings: Settings) -> PhotographEncoder:
    """Load the networks and run each once, because the first run allocates memory."""
    encoder = PhotographEncoder(bundle, threads=settings.cores.onnx_threads)
    encoder.warm_up()
    return encoder


# All components in this process.
LOCAL_BACKENDS = Backends(optimiser=LpoPool, encoder=warm_encoder)


def start_runtime(
    settings: Settings, telemetry: Telemetry, cleanup: ExitStack, backends: Backends = LOCAL_BACKENDS
) -> Runtime:
    """Open the store, load the model, start the worker processes, and queue unfinished pose grids.

    Blocks while the model loads; workers start in the background.

    Args:
        settings: settings of the service.
        telemetry: metrics and tracing.
        cleanup: closes the components, also if the start fails.
        backends: builders of the components that can run in other processes.

    Raises:
        ConfigError: the data folder or the database cannot be used.
        BundleError: the model bundle is missing or damaged.
    """
    cleanup.callback(sys.setswitchinterval, sys.getswitchinterval())
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    if settings.otlp_endpoint is not None:
        telemetry.tracing = _closing(cleanup, Tracing(otlp_exporter(settings.otlp_endpoint), __version__))
    bundle = Bundle.open(settings.bundle)
    store = _closing(cleanup, open_store(settings))
    telemetry.gauge("lalaloc_database_up", "1 while the database answers.", lambda: float(store.state == "answers"))
    access_control = _closing(cleanup, AccessControl(store.keys, settings))
    audit_trail = _closing(cleanup, AuditTrail(store.audit_log))
    audit_trail.start()
    components = _QueryComponents.start(settings, telemetry, cleanup, backends, bundle, store)
    # One thread per client beside other clients, because small uploads share the interpreter with queries.
    uploads = Threads("lalaloc-uploads", _UPLOAD_THREADS, telemetry.cpu_accounts, cores=1, rests=True)
    _closing(cleanup, uploads)
    # As many threads as converter processes; fewer per client beside others, because plans are stored by this process.
    # Closed after the converter, because its waiting jobs must end first.
    count = with_headroom(settings.imports.workers)
    file_threads = Threads("lalaloc-files", count, telemetry.cpu_accounts, cores=usable_cores(), rests=True)
    file_uploads = _closing(cleanup, file_threads)
    converter = _closing(cleanup, Converter(settings, telemetry))
    # A file can take its worker longer than the service may take to stop.
    components.admission.at_stop(converter.close)
    store.plans.parse_with(converter.parse)
    grids = components.grids
    sweep_s, keep_answers_s = settings.grids.sweep_s, settings.storage.keep_answers_s
    sweeper = Sweeper(store, grids, telemetry, sweep_s=sweep_s, keep_answers_s=keep_answers_s)
    _closing(cleanup, sweeper).start()
    # A thread of its own: a database that does not answer blocks no reads of queries.
    event_reads = _closing(cleanup, _reads(settings, threads=1, max_pending=1))
    plans, plan_indices = components.venue_plans(), _closing(cleanup, components.plan_indices())
    indices: IndexSource = plan_indices if backends.indices is None else backends.indices(settings)
    localiser: LocaliserBackend = _closing(cleanup, components.localiser(plans, indices))
    if backends.localiser is not None:
        localiser = backends.localiser(localiser.model, settings, telemetry)
    renditions = RenditionCache(
        store.plans,
        converter,
        bundle,
        step_m=settings.grids.grid_step_m,
        limit_bytes=settings.storage.plan_cache_bytes,
        max_pending=_MAX_PENDING_RENDITIONS,
        # There is one worker.
        turns=FairSemaphore(1, telemetry.cpu_accounts),
        permits=components.permits,
    )
    lookup = PlanLookup(store, max_age_s=_PLAN_CACHE_AGE_S)
    album_reads = _closing(cleanup, BoundedReads(threads=2, max_pending=16, wait_s=_ALBUM_WAIT_S))
    streams = partial(
        ProgressEvents,
        admission=components.admission,
        reads=event_reads,
        max_s=STREAM_DEADLINE_S,
        heartbeat_s=heartbeat_s(settings),
    )
    _log_start(bundle, grids, telemetry)
    if not store.plans.any_stored():
        fields = {"database": make_url(settings.database_url).render_as_string(hide_password=True)}
        logging.getLogger(LOGGER_NAME).warning("the database has no floor plans", extra={"fields": fields})
    return Runtime(
        settings=settings,
        telemetry=telemetry,
        bundle=bundle,
        store=store,
        grids=grids,
        plan_lookup=lookup,
        optimiser=components.optimiser,
        decoder=components.decoder,
        converter=converter,
        localiser=localiser,
        admission=components.admission,
        access_control=access_control,
        audit_trail=audit_trail,
        events=streams(partial(plan_look, store, grids), PlanEvent(status="deleted"), PLAN_ENDS),
        album_events=streams(partial(album_look, store, bundle.sha256), AlbumEvent(status="deleted"), ALBUM_ENDS),
        albums=AlbumSolver(store, lookup, localiser, album_reads, settings, telemetry),
        uploads=uploads,
        file_uploads=file_uploads,
        reads=components.reads,
        venue_plans=plans,
        plan_indices=plan_indices,
        renditions=_closing(cleanup, renditions),
        permits=components.permits,
    )


@dataclass(frozen=True, kw_only=True)
class _QueryComponents:
    """Components of this process that compute answers."""

    settings: Settings
    telemetry: Telemetry
    bundle: Bundle
    store: Store
    encoder: PhotographEncoder
    grids: GridProvider
    optimiser: OptimiserBackend
    decoder: Decoder
    admission: Admission
    reads: BoundedReads
    permits: FairSemaphore
    idle_cores: IdleCores

    @classmethod
    def start(
        cls,
        settings: Settings,
        telemetry: Telemetry,
        cleanup: ExitStack,
        backends: Backends,
        bundle: Bundle,
        store: Store,
    ) -> _QueryComponents:
        """Start the worker processes in the background and load the model."""
        cores = settings.cores
        count = cores.compute_threads + cores.workers + settings.decode.workers
        permits = FairSemaphore(with_headroom(count), telemetry.cpu_accounts, cores=usable_cores())
        decoder = _closing(cleanup, Decoder(bundle.manifest, settings, telemetry, permits))
        decoder.start()
        encoder = backends.encoder(bundle, settings)
        idle_cores = _closing(cleanup, IdleCores(usable_cores(), telemetry.cpu_accounts, permits))
        encoder.use_helper(idle_cores.if_any)
        by_latents = not encoder.predicts_profile
        optimiser = backends.optimiser(bundle, settings, telemetry, permits, by_latents)
        _closing(cleanup, optimiser, _LPO_DRAIN * settings.requests.stop_deadline_s).start()
        return cls(
            settings=settings,
            telemetry=telemetry,
            bundle=bundle,
            store=store,
            encoder=encoder,
            grids=_closing(cleanup, GridProvider(store, encoder, bundle.sha256, settings, telemetry, permits)),
            optimiser=optimiser,
            decoder=decoder,
            admission=_admission(settings, telemetry, store),
            reads=_closing(cleanup, _reads(settings, threads=_READ_THREADS, max_pending=settings.pending_limit)),
            permits=permits,
            idle_cores=idle_cores,
        )

    def localiser(self, plans: VenuePlans, indices: IndexSource) -> Localiser:
        """Build the localiser."""
        executor = Executor(self.settings, self.optimiser, self.telemetry, self.permits)
        queries, tolerance_deg = self.admission.queries, self.settings.photographs.compass_tolerance_deg
        search = VenueSearch(plans=plans, indices=indices, encoder=self.encoder, queries=queries)
        parts = QueryParts(
            bundle=self.bundle,
            encoder=self.encoder,
            decoder=self.decoder,
            reader=PhotographReader(self.decoder, self.encoder, executor, compass_tolerance_deg=tolerance_deg),
            grounds=Grounds(
                encoder=self.encoder,
                grids=self.grids,
                queries=queries,
                reads=self.reads,
                executor=executor,
                plans=plans,
                search=search,
            ),
            executor=executor,
        )
        albums = Threads("albums", 1, self.telemetry.cpu_accounts)
        return Localiser(parts, queries, albums, self.permits)

    def venue_plans(self) -> VenuePlans:
        """Build the lookup of a venue's plans."""
        return VenuePlans(
            self.store,
            self.grids,
            self.reads,
            limit_bytes=self.settings.storage.venue_cache_bytes,
            max_poses=min(self.settings.grids.max_grid_poses, _VENUE_POSES),
            idle_cores=self.idle_cores,
        )

    def plan_indices(self) -> PlanIndices:
        """Build the indices of plans."""
        return PlanIndices(
            self.store,
            self.grids,
            self.reads,
            path=self.settings.data_dir / "prototypes.bin",
            file_bytes=self.settings.storage.venue_file_bytes,
            limit_bytes=self.settings.storage.venue_cache_bytes,
        )


def _closing(cleanup: ExitStack, part: Part, *arguments: float) -> Part:
    """Register a component to be closed, and return it."""
    cleanup.callback(part.close, *arguments)
    return part


def _admission(settings: Settings, telemetry: Telemetry, store: Store) -> Admission:
    def by_tenant(values: Mapping[str, float]) -> Mapping[str, float]:
        # Without keys clients are addresses, and all of them are one tenant.
        tenants = {client: value for client, value in values.items() if client != PROBES}
        return tenants if settings.access.api_keys else {DEFAULT_TENANT: sum(tenants.values())}

    limits = store.tenant_limits
    telemetry.cpu_accounts.share = lambda client: limits.of(client).cpu_share or 1.0
    return Admission(
        AdmissionLimits.from_settings(settings),
        telemetry,
        bytes_limit_of=lambda client: limits.of(client).bytes_in_flight,
        by_tenant=by_tenant,
    )


def _reads(settings: Settings, *, threads: int, max_pending: int) -> BoundedReads:
    return BoundedReads(threads=threads, max_pending=max_pending, wait_s=settings.database.wait_s)


async def get_runtime(request: Request) -> Runtime:
    """Return the running service.

    A coroutine, because the framework would call a plain function on a thread pool that slow reads can fill.
    """
    return request.app.state.runtime


def _log_start(bundle: Bundle, grids: GridProvider, telemetry: Telemetry) -> None:
    manifest = bundle.manifest
    telemetry.describe_build(__version__, manifest.name, manifest.version, bundle.sha256)
    fields = {"model": manifest.name, "sha256": bundle.sha256, "grids_to_compute": grids.preparing}
    logging.getLogger(LOGGER_NAME).info("service started", extra={"fields": fields})
