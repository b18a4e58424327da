"""Components that compute answers: model, workers, pose grids, and what builds those of them in other processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Protocol, TypeVar

from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.answers.documents import ModelAnswer
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from service.capacity.admission_control import Admission
from service.capacity.cores import usable_cores
from service.capacity.cpu_accounts import PROBES
from service.capacity.fair_share import FairSemaphore, with_headroom
from service.capacity.threads import BoundedReads, IdleCores, Threads
from service.decoding.decoder import Decoder
from service.grids import GridProvider
from service.plan_files.converter import Converter
from service.plan_files.rendition_cache import RenditionCache
from service.query import Executor, Grounds, Localiser, LocalLocaliser, LpoPool, Optimiser, PhotographReader, QueryParts
from service.query.album_search import AT_A_TIME
from service.settings import Settings
from service.storage import Store
from service.storage.records import DEFAULT_TENANT
from service.telemetry import Telemetry
from service.venues.plan_indices import IndexSource, PlanIndices
from service.venues.venue_plans import VenuePlans
from service.venues.venue_search import VenueSearch

# Queries read little: a plan, and a pose grid that is not in memory.
_READ_THREADS = 4
# Limit of the poses that a venue query searches, because it copies them. A single plan can have more.
_VENUE_POSES = 40_000
# Limit of the files of stored plans that are made or wait.
_MAX_PENDING_RENDITIONS = 16
# Share of the stop timeout in which running LPO jobs can finish.
_LPO_DRAIN = 0.1


class _Closable(Protocol):
    close: Callable[..., None]


Part = TypeVar("Part", bound=_Closable)


@dataclass(frozen=True, kw_only=True)
class Backends:
    """Builders of the components that can run in other processes.

    Attributes:
        optimiser: builds the pool of LPO workers; the last argument tells whether poses are refined by latents.
        encoder: loads the networks and warms them up.
        localiser: builds the localiser; None: this process computes answers.
        indices: builds the source of the indices of venues; None: they are in this process.
    """

    optimiser: Callable[[Bundle, Settings, Telemetry, FairSemaphore, bool], Optimiser]
    encoder: Callable[[Bundle, Settings], PhotographEncoder]
    localiser: Callable[[ModelAnswer, Settings, Telemetry], Localiser] | None = None
    indices: Callable[[Settings], IndexSource] | None = None


def warm_encoder(bundle: Bundle, settings: Settings) -> PhotographEncoder:
    """Load the networks and run each once, because the first run allocates memory."""
    encoder = PhotographEncoder(bundle, threads=settings.cores.onnx_threads)
    encoder.warm_up()
    return encoder


# All components in this process.
LOCAL_BACKENDS = Backends(optimiser=LpoPool, encoder=warm_encoder)


@dataclass(frozen=True, kw_only=True)
class QueryComponents:
    """Components of this process that compute answers.

    Attributes:
        reads: store reads of queries.
        cores: cores to compute on, of which each piece of work holds one.
    """

    settings: Settings
    telemetry: Telemetry
    bundle: Bundle
    store: Store
    encoder: PhotographEncoder
    grids: GridProvider
    optimiser: Optimiser
    decoder: Decoder
    admission: Admission
    reads: BoundedReads
    cores: FairSemaphore
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
    ) -> QueryComponents:
        """Start the worker processes in the background and load the model."""
        shares = settings.cores
        count = shares.compute_threads + shares.workers + settings.decode.workers
        cores = FairSemaphore(with_headroom(count), telemetry.cpu_accounts, cores=usable_cores())
        decoder = closed_at_end(cleanup, Decoder(bundle.manifest, settings, telemetry, cores))
        decoder.start()
        encoder = backends.encoder(bundle, settings)
        idle_cores = closed_at_end(cleanup, IdleCores(usable_cores(), telemetry.cpu_accounts, cores))
        encoder.use_helper(idle_cores.if_any)
        by_latents = not encoder.predicts_profile
        optimiser = backends.optimiser(bundle, settings, telemetry, cores, by_latents)
        closed_at_end(cleanup, optimiser, _LPO_DRAIN * settings.requests.stop_deadline_s).start()
        return cls(
            settings=settings,
            telemetry=telemetry,
            bundle=bundle,
            store=store,
            encoder=encoder,
            grids=closed_at_end(cleanup, GridProvider(store, encoder, bundle.sha256, settings, telemetry, cores)),
            optimiser=optimiser,
            decoder=decoder,
            admission=_admission(settings, telemetry, store),
            reads=closed_at_end(
                cleanup, store_reads(settings, threads=_READ_THREADS, max_pending=settings.pending_limit)
            ),
            cores=cores,
            idle_cores=idle_cores,
        )

    def build_localiser(self, plans: VenuePlans, indices: IndexSource) -> LocalLocaliser:
        """Build the localiser."""
        executor = Executor(self.settings, self.optimiser, self.telemetry, self.cores)
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
        accounts = self.telemetry.cpu_accounts
        # Albums take turns on half the cores, which leaves the others to queries.
        turns = FairSemaphore(max(usable_cores() // 2, 1), accounts)
        return LocalLocaliser(parts, queries, Threads("albums", AT_A_TIME, accounts), turns, self.cores)

    def build_venue_plans(self) -> VenuePlans:
        """Build the lookup of a venue's plans."""
        return VenuePlans(
            self.store,
            self.grids,
            self.reads,
            limit_bytes=self.settings.storage.venue_cache_bytes,
            max_poses=min(self.settings.grids.max_grid_poses, _VENUE_POSES),
            idle_cores=self.idle_cores,
        )

    def build_plan_indices(self) -> PlanIndices:
        """Build the indices of plans."""
        return PlanIndices(
            self.store,
            self.grids,
            self.reads,
            path=self.settings.data_dir / "prototypes.bin",
            file_bytes=self.settings.storage.venue_file_bytes,
            limit_bytes=self.settings.storage.venue_cache_bytes,
        )

    def build_renditions(self, converter: Converter) -> RenditionCache:
        """Build the cache of files made from stored plans."""
        return RenditionCache(
            self.store.plans,
            converter,
            self.bundle,
            step_m=self.settings.grids.grid_step_m,
            limit_bytes=self.settings.storage.plan_cache_bytes,
            max_pending=_MAX_PENDING_RENDITIONS,
            # There is one worker.
            turns=FairSemaphore(1, self.telemetry.cpu_accounts),
            cores=self.cores,
        )


def closed_at_end(cleanup: ExitStack, part: Part, *arguments: float) -> Part:
    """Register a component to be closed, and return it."""
    cleanup.callback(part.close, *arguments)
    return part


def _admission(settings: Settings, telemetry: Telemetry, store: Store) -> Admission:
    def by_tenant(values: Mapping[str, float]) -> Mapping[str, float]:
        # Without keys clients are addresses, and all of them are one tenant.
        tenants = {client: value for client, value in values.items() if client != PROBES}
        return tenants if settings.access.api_keys else {DEFAULT_TENANT: sum(tenants.values())}

    limits = store.tenants
    telemetry.cpu_accounts.share = lambda client: limits.of(client).cpu_share or 1.0
    return Admission(
        settings, telemetry, bytes_limit_of=lambda client: limits.of(client).bytes_in_flight, by_tenant=by_tenant
    )


def store_reads(settings: Settings, *, threads: int, max_pending: int) -> BoundedReads:
    """Return threads for reads of the store."""
    return BoundedReads(threads=threads, max_pending=max_pending, wait_s=settings.database.wait_s)
