"""Periodic reaction to other replicas: deleted plans, grids that they compute, and grids that no replica computes."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from dataclasses import asdict
from time import monotonic

from service.errors import StoreFullError, StoreUnavailableError
from service.grids.grid_provider import GridProvider
from service.storage import Store
from service.telemetry import LOGGER_NAME, Telemetry

# Revisions per query.
_BATCH_SIZE = 500
_POLL_S = 0.5
_PURGE_EVERY_S = 3600.0


class Sweeper:
    """Thread with a few cheap queries per period; failures of the database are retried."""

    def __init__(
        self, store: Store, grids: GridProvider, telemetry: Telemetry, *, sweep_s: float, keep_answers_s: float
    ) -> None:
        self._store, self._grids, self._telemetry = store, grids, telemetry
        self._sweep_s, self._keep_answers_s = sweep_s, keep_answers_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sweeper", daemon=True)

    def start(self) -> None:
        """Read the limits of tenants, clear the failures of earlier runs to try these grids again, start the thread."""
        self._store.tenants.refresh()
        # A full disk must not prevent the start, because deleting plans frees it.
        with suppress(StoreFullError):
            self._store.plans.clear_failures()
        self._grids.queue_missing()
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def sweep(self) -> None:
        """Drop plans and grids from memory, and cancel their computation, if any replica deleted their revisions."""
        in_memory = sorted(self._grids.revisions() | self._store.plan_cache.revisions())
        for first in range(0, len(in_memory), _BATCH_SIZE):
            batch = in_memory[first : first + _BATCH_SIZE]
            gone = set(batch) - self._store.plans.current_revisions(batch)
            if gone:
                self._grids.forget(gone)
                self._store.plan_cache.forget_revisions(gone)

    def _measure(self) -> None:
        """Set the metrics of the tenants' stored bytes."""
        for tenant, account in self._store.quota.accounts().items():
            self._telemetry.stored_bytes_limit.labels(tenant).set(account.limit)
            for kind, used in asdict(account.used).items():
                self._telemetry.stored_bytes.labels(tenant, kind).set(used)

    def _run(self) -> None:
        sweep_at = purge_at = monotonic()
        more = True
        while not self._stop.wait(min(_POLL_S, self._sweep_s)):
            try:
                self._grids.poll_remote()
                due = monotonic() >= sweep_at
                if due:
                    sweep_at = monotonic() + self._sweep_s
                    self._store.tenants.refresh()
                    self._measure()
                    self.sweep()
                    self._store.database.give_back(self._stop.is_set)
                # A backlog, as after a new model, continues as soon as the queued grids are done.
                if due or (more and self._grids.pending == 0):
                    more = self._grids.queue_missing()
                if monotonic() >= purge_at:
                    purge_at = monotonic() + _PURGE_EVERY_S
                    self._store.idempotency_keys.purge()
                    self._store.answers.purge(kept_s=self._keep_answers_s)
                    self._store.sessions.purge()
                    self._store.albums.purge()
                    self._store.audit_log.purge()
                    self._store.quota.recount()
            except StoreUnavailableError:
                continue
            except Exception:
                logging.getLogger(LOGGER_NAME).exception("sweeping grids failed")
