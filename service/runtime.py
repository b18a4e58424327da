"""The parts of a running service, built once at start-up and taken down in reverse order."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from fastapi import Request

from lalaloc_core import __version__
from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.encoders import Encoders
from service.admission import Admission, AdmissionLimits
from service.decoding import Decoder
from service.events import PlanEvents
from service.grids.caretaker import Caretaker
from service.grids.grids import Grids
from service.grids.known_plans import KnownPlans
from service.localiser import Localiser
from service.refinement import LpoPool
from service.security.middleware import Gate
from service.settings import Settings
from service.storage.store import Store, open_store
from service.telemetry import LOGGER_NAME, Telemetry
from service.telemetry.tracing import Tracing, otlp_exporter


@dataclass(frozen=True)
class Runtime:
    """Everything that the routes need."""

    settings: Settings
    telemetry: Telemetry
    store: Store
    grids: Grids
    known_plans: KnownPlans
    pool: LpoPool
    decoder: Decoder
    localiser: Localiser
    admission: Admission
    gate: Gate
    events: PlanEvents

    @property
    def ready(self) -> bool:
        """Whether workers are warm, as the model is before the first request is taken, and the service goes on."""
        return not self.admission.stopping and self.pool.state.warmed_up and self.decoder.state.warmed_up


def start_runtime(settings: Settings, telemetry: Telemetry, cleanup: ExitStack) -> Runtime:
    """Open the store, load and warm the model, start the LPO pool, and take up unfinished grids.

    Blocks for as long as the model loads; the pool warms up in the background.

    Args:
        cleanup: takes what has to be closed, also when starting fails half-way.

    Raises:
        ConfigError: the data folder or the database cannot be used.
        BundleError: there is no usable model.
    """
    logger = logging.getLogger(LOGGER_NAME)
    if settings.otlp_endpoint is not None:
        telemetry.tracing = Tracing(otlp_exporter(settings.otlp_endpoint), __version__)
        cleanup.callback(telemetry.tracing.close)
    bundle = Bundle.open(settings.bundle)
    telemetry.describe_build(__version__, bundle.manifest.name, bundle.sha256)
    store = open_store(settings)
    cleanup.callback(store.close)
    gate = Gate(store.keys, settings)
    cleanup.callback(gate.close)
    # The pool first: loading torch in the workers overlaps with loading the model here.
    pool = LpoPool(bundle, settings, telemetry)
    cleanup.callback(pool.close)
    pool.start()
    decoder = Decoder(bundle.manifest, settings, telemetry)
    cleanup.callback(decoder.close)
    decoder.start()
    encoders = Encoders(bundle, threads=settings.cores.onnx_threads)
    _warm_up(encoders)
    grids = Grids(store, encoders, bundle.sha256, settings, telemetry)
    cleanup.callback(grids.close)
    admission = Admission(AdmissionLimits.of(settings), telemetry)
    localiser = Localiser(
        settings=settings,
        bundle=bundle,
        encoders=encoders,
        grids=grids,
        pool=pool,
        decoder=decoder,
        queries=admission.queries,
        telemetry=telemetry,
    )
    cleanup.callback(localiser.close)
    known_plans = KnownPlans(store, limit_bytes=settings.plan_cache_bytes, max_age_s=settings.plan_cache_age_s)
    caretaker = Caretaker(store, grids, known_plans, sweep_s=settings.sweep_s)
    cleanup.callback(caretaker.close)
    caretaker.start()
    events = PlanEvents(store, grids, admission, longest_s=settings.stream_deadline_s)
    fields = {"model": bundle.manifest.name, "sha256": bundle.sha256, "grids_to_compute": grids.pending}
    logger.info("service started", extra={"fields": fields})
    return Runtime(settings, telemetry, store, grids, known_plans, pool, decoder, localiser, admission, gate, events)


def runtime_of(request: Request) -> Runtime:
    """The running service that a request came to."""
    return request.app.state.runtime


def _warm_up(encoders: Encoders) -> None:
    """Run every network once; the first run allocates."""
    manifest = encoders.manifest
    image = np.zeros((manifest.image_height, manifest.image_width, 3), np.uint8)
    encoders.query(image, None, 1.5)
    encoders.layouts(np.full((1, manifest.profile_columns), 2.0), np.array([1.5]), np.array([2.5]))
