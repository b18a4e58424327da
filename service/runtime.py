"""Components of a running service, built at start-up and closed in reverse order."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

from fastapi import Request
from sqlalchemy.engine import make_url

from lalaloc_core import __version__
from lalaloc_core.bundle import Bundle
from service.albums.album_solver import AlbumSolver
from service.capacity.cores import usable_cores
from service.capacity.fair_share import with_headroom
from service.capacity.threads import BoundedReads, Threads
from service.grids import GridProvider, Sweeper
from service.http.events import ALBUM_ENDS, PLAN_ENDS, ProgressEvents, album_look, heartbeat_s, plan_look
from service.plan_files.converter import Converter
from service.plan_files.rendition_cache import RenditionCache
from service.query import Localiser
from service.query_components import LOCAL_BACKENDS, Backends, QueryComponents, closed_at_end, store_reads
from service.schemas.albums import AlbumEvent
from service.schemas.stored_plans import PlanEvent
from service.security import AccessControl, AuditTrail
from service.settings import Settings
from service.storage import PlanLookup, Store, open_store
from service.telemetry import LOGGER_NAME, Telemetry
from service.telemetry.tracing import Tracing, otlp_exporter
from service.venues.plan_indices import IndexSource, PlanIndices
from service.venues.venue_plans import VenuePlans

# Uploads compute small pose grids, so more threads would take cores from queries.
_UPLOAD_THREADS = with_headroom(2)
# Age up to which a plan in memory is used while the database is away.
_PLAN_CACHE_AGE_S = 600.0
# Timeout of an event stream; the client then reconnects.
STREAM_DEADLINE_S = 900.0
# Longest time that a thread keeps the interpreter while others wait. Python's 5 ms add up in a query, which waits for
# it several times beside other tenants' queries that compute.
_SWITCH_INTERVAL_S = 0.0005
# Timeout (s) of reading or writing the features and pins of an album.
_ALBUM_WAIT_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Runtime(QueryComponents):
    """Components that the routes use.

    Attributes:
        uploads: threads that check, prepare and store plans.
        file_uploads: threads for uploads that wait for the converter.
        venue_plans: rows of the plans of venues in memory.
        plan_indices: indices of venues in this process.
        renditions: files made from stored plans.
        albums: solves albums, while its `run` does.
    """

    plan_lookup: PlanLookup
    converter: Converter
    localiser: Localiser
    access_control: AccessControl
    audit_trail: AuditTrail
    events: ProgressEvents[PlanEvent]
    album_events: ProgressEvents[AlbumEvent]
    albums: AlbumSolver
    uploads: Threads
    file_uploads: Threads
    venue_plans: VenuePlans
    plan_indices: PlanIndices
    renditions: RenditionCache

    @property
    def ready(self) -> bool:
        """True if all workers have started and the service is not stopping."""
        return not self.admission.draining and self.optimiser.state.warmed_up and self.decoder.state.warmed_up


def start_runtime(
    settings: Settings, telemetry: Telemetry, cleanup: ExitStack, backends: Backends = LOCAL_BACKENDS
) -> Runtime:
    """Open the store, load the model, start the worker processes, and queue unfinished pose grids.

    Blocks while the model loads; workers start in the background. `cleanup` closes the components, also if the start
    fails.
    """
    cleanup.callback(sys.setswitchinterval, sys.getswitchinterval())
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    if settings.otlp_endpoint is not None:
        telemetry.tracing = closed_at_end(cleanup, Tracing(otlp_exporter(settings.otlp_endpoint), __version__))
    bundle = Bundle.open(settings.bundle)
    store = closed_at_end(cleanup, open_store(settings))
    telemetry.gauge(
        "lalaloc_database_up", "1 while the database answers.", lambda: float(store.database.state == "answers")
    )
    access_control = closed_at_end(cleanup, AccessControl(store.keys, settings))
    audit_trail = closed_at_end(cleanup, AuditTrail(store.audit_log))
    audit_trail.start()
    components = QueryComponents.start(settings, telemetry, cleanup, backends, bundle, store)
    uploads, file_uploads = _upload_threads(settings, telemetry, cleanup)
    converter = closed_at_end(cleanup, Converter(settings, telemetry))
    # A file can take its worker longer than the service may take to stop.
    components.admission.at_stop(converter.close)
    store.plans.parse_with(converter.parse)
    grids = components.grids
    sweep_s, keep_answers_s = settings.grids.sweep_s, settings.storage.keep_answers_s
    sweeper = Sweeper(store, grids, telemetry, sweep_s=sweep_s, keep_answers_s=keep_answers_s)
    closed_at_end(cleanup, sweeper).start()
    streams = _event_streams(settings, components, cleanup)
    plans, plan_indices = components.build_venue_plans(), closed_at_end(cleanup, components.build_plan_indices())
    indices: IndexSource = plan_indices if backends.indices is None else backends.indices(settings)
    localiser: Localiser = closed_at_end(cleanup, components.build_localiser(plans, indices))
    if backends.localiser is not None:
        localiser = backends.localiser(localiser.model, settings, telemetry)
    lookup = PlanLookup(store, max_age_s=_PLAN_CACHE_AGE_S)
    album_reads = closed_at_end(cleanup, BoundedReads(threads=2, max_pending=16, wait_s=_ALBUM_WAIT_S))
    _log_start(settings, bundle, grids, store, telemetry)
    return Runtime(
        **vars(components),
        plan_lookup=lookup,
        converter=converter,
        localiser=localiser,
        access_control=access_control,
        audit_trail=audit_trail,
        events=streams(partial(plan_look, store, grids), PlanEvent(status="deleted"), PLAN_ENDS),
        album_events=streams(partial(album_look, store, bundle.sha256), AlbumEvent(status="deleted"), ALBUM_ENDS),
        albums=AlbumSolver(store, lookup, localiser, album_reads, settings, telemetry),
        uploads=uploads,
        file_uploads=file_uploads,
        venue_plans=plans,
        plan_indices=plan_indices,
        renditions=closed_at_end(cleanup, components.build_renditions(converter)),
    )


def _upload_threads(settings: Settings, telemetry: Telemetry, cleanup: ExitStack) -> tuple[Threads, Threads]:
    """Return the threads that store plans, and those for uploads that wait for the converter."""
    # One thread per client beside other clients, because small uploads share the interpreter with queries.
    uploads = Threads("lalaloc-uploads", _UPLOAD_THREADS, telemetry.cpu_accounts, beside_others=1, rests=True)
    closed_at_end(cleanup, uploads)
    # As many threads as converter processes; fewer per client beside others, because plans are stored by this process.
    # Closed after the converter, because its waiting jobs must end first.
    count = with_headroom(settings.imports.workers)
    files = Threads("lalaloc-files", count, telemetry.cpu_accounts, beside_others=usable_cores(), rests=True)
    return uploads, closed_at_end(cleanup, files)


def _event_streams(
    settings: Settings, components: QueryComponents, cleanup: ExitStack
) -> Callable[..., ProgressEvents[Any]]:
    """Return a function that makes the event streams about resources of one kind; all of them share one thread."""
    # A thread of its own: a database that does not answer blocks no reads of queries.
    event_reads = closed_at_end(cleanup, store_reads(settings, threads=1, max_pending=1))
    return partial(
        ProgressEvents,
        admission=components.admission,
        reads=event_reads,
        max_s=STREAM_DEADLINE_S,
        heartbeat_s=heartbeat_s(settings),
    )


async def get_runtime(request: Request) -> Runtime:
    """Return the running service.

    A coroutine, because the framework would call a plain function on a thread pool that slow reads can fill.
    """
    return request.app.state.runtime


def _log_start(settings: Settings, bundle: Bundle, grids: GridProvider, store: Store, telemetry: Telemetry) -> None:
    manifest, logger = bundle.manifest, logging.getLogger(LOGGER_NAME)
    telemetry.describe_build(__version__, manifest.name, manifest.version, bundle.sha256)
    fields = {"model": manifest.name, "sha256": bundle.sha256, "grids_to_compute": grids.preparing}
    logger.info("service started", extra={"fields": fields})
    if not store.plans.any_stored():
        fields = {"database": make_url(settings.database_url).render_as_string(hide_password=True)}
        logger.warning("the database has no floor plans", extra={"fields": fields})
