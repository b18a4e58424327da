"""The parts of a running service, built once at start-up and taken down in reverse order."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from fastapi import Request

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import ConfigError
from lalaloc_core.localise.encoders import Encoders
from service.grids import Grids
from service.localiser import Localiser
from service.refinement import LpoPool
from service.settings import Settings
from service.store import Store
from service.telemetry import LOGGER_NAME, Telemetry
from service.uploads import Slots


@dataclass(frozen=True)
class Runtime:
    """Everything that the routes need."""

    settings: Settings
    telemetry: Telemetry
    store: Store
    grids: Grids
    pool: LpoPool
    localiser: Localiser
    slots: Slots

    @property
    def ready(self) -> bool:
        """Whether model and LPO pool are warm; the model is before the first request is taken."""
        return self.pool.state.warmed_up


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
    bundle = Bundle.open(settings.bundle)
    if settings.database_url is None:
        try:
            settings.data_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"cannot create the data folder '{settings.data_dir}': {error.strerror}") from error
    store = Store(settings.resolved_database_url)
    cleanup.callback(store.close)
    # The pool first: loading torch in the workers overlaps with loading the model here.
    pool = LpoPool(bundle, settings, telemetry)
    cleanup.callback(pool.close)
    pool.start()
    encoders = Encoders(bundle, threads=settings.onnx_threads)
    _warm_up(encoders)
    grids = Grids(store, encoders, bundle.sha256, settings, telemetry)
    cleanup.callback(grids.close)
    localiser = Localiser(
        settings=settings, bundle=bundle, encoders=encoders, grids=grids, pool=pool, telemetry=telemetry
    )
    cleanup.callback(localiser.close)
    resumed = grids.resume()
    fields = {"model": bundle.manifest.name, "sha256": bundle.sha256, "grids_to_compute": resumed}
    logger.info("service started", extra={"fields": fields})
    slots = Slots(settings.max_pending_requests)
    telemetry.gauge("lalaloc_requests_in_flight", "Uploads and queries not yet answered.", lambda: slots.taken)
    return Runtime(settings, telemetry, store, grids, pool, localiser, slots)


def runtime_of(request: Request) -> Runtime:
    """The running service that a request came to."""
    return request.app.state.runtime


def _warm_up(encoders: Encoders) -> None:
    """Run every network once; the first run allocates."""
    manifest = encoders.manifest
    image = np.zeros((manifest.image_height, manifest.image_width, 3), np.uint8)
    encoders.query(image, None, 1.5)
    encoders.layouts(np.full((1, manifest.profile_columns), 2.0), np.array([1.5]), np.array([2.5]))
