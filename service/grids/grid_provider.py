"""Provider of pose grids: found in memory or in the store, or computed; safe to share between threads."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from typing import Self

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.render.sampling import grid_size
from service.capacity.fair_share import FairSemaphore
from service.errors import OverloadedError, StoppingError
from service.grids.builder import GridBuilder, GridCache
from service.grids.embedding import RENDERED, embed, embed_small
from service.grids.grid_jobs import GridJob
from service.schemas.stored_plans import PlanStatus
from service.settings import Settings
from service.storage import Store
from service.storage.grid_format import SortedPrototypes, packed_bytes
from service.storage.records import ComputedGrid, GridKey, PlanRecord, PlanSummary, millimetres
from service.telemetry import LOGGER_NAME, Telemetry

# Other camera heights are rounded to multiples of this, so that a plan needs few grids.
HEIGHT_STEP_M = 0.02


def check_height_m(record: PlanRecord, height_m: float) -> None:
    """Check that a camera can have a height (m) in a plan: below the lowest ceiling, and not too low."""
    lowest = float(record.plan.ceiling_heights_m.min())
    if height_m != record.plan.camera_height_m and not MIN_CAMERA_HEIGHT_M <= height_m < lowest:
        raise InvalidPoseError(
            f"camera_height_m is {height_m:g}; it must be at least {MIN_CAMERA_HEIGHT_M:g} and below the plan's lowest "
            f"ceiling ({lowest:g} m)"
        )


def grid_height_m(record: PlanRecord, height_m: float, *, latents_alone: bool) -> float:
    """Return the camera height (m) of the grid that a query is compared with.

    Wall profiles do not depend on the height, so the plan's own grid serves all queries. Only models that compare
    latents alone have a grid per height, rounded to 2 cm.
    """
    own = record.plan.camera_height_m
    if not latents_alone or abs(height_m - own) < HEIGHT_STEP_M / 2.0:
        return own
    steps = round(height_m / HEIGHT_STEP_M)
    if steps * HEIGHT_STEP_M >= float(record.plan.ceiling_heights_m.min()):
        steps -= 1
    return steps * HEIGHT_STEP_M


# Missing grids queued at a time, so that replicas share a backlog.
_BATCH = 16
# Maximum size of all pose grids that are computed during the upload of several plans, in `inline_grid_poses`: a second
# or two of a core, and 0.6 kB per pose until they are stored.
_INLINE_TOTAL = 80


@dataclass(frozen=True)
class GridState:
    """Progress of a plan's own pose grid, whichever replica computes it; `poses` is None until it is computed."""

    status: PlanStatus
    progress: float
    poses: int | None
    reason: str | None = None

    @classmethod
    def after_upload(cls, prepared: ComputedGrid | None) -> Self:
        """Return the state of a plan that was stored just now, with or without its grid."""
        return cls("preparing", 0.0, None) if prepared is None else cls("ready", 1.0, len(prepared.grid.poses))

    @classmethod
    def of_stored(cls, failure: str | None, poses: int | None, remote: float | None, job: GridJob | None) -> Self:
        """Return the state of a stored plan."""
        if poses is not None:
            return cls("ready", 1.0, poses)
        if failure is not None and job is None:
            return cls("failed", 0.0, None, failure)
        return cls("preparing", max(remote or 0.0, job.progress if job else 0.0), None)


class GridProvider:
    """Pose grids of one model at one grid step.

    Attributes:
        cache: the grids that are computed, in memory or in the store.
    """

    def __init__(
        self,
        store: Store,
        encoders: PhotographEncoder,
        model_sha256: str,
        settings: Settings,
        telemetry: Telemetry,
        cores: FairSemaphore,
    ) -> None:
        self._store, self._encoders, self._model_sha256 = store, encoders, model_sha256
        self._settings, self._telemetry, self._cores = settings, telemetry, cores
        self.cache = GridCache(store, settings.storage.grid_cache_bytes, telemetry)
        self._jobs = GridBuilder(store, encoders, self.cache, cores, settings, telemetry).jobs
        self._unprepared = 0
        telemetry.gauge(
            "lalaloc_grids_pending", "Pose grids being computed or queued in this replica.", lambda: self.pending
        )
        telemetry.gauge(
            "lalaloc_grids_preparing", "Plans without a pose grid, in all replicas.", lambda: self.preparing
        )
        telemetry.gauge("lalaloc_grid_cache_bytes", "Size of the pose grids in memory.", lambda: self.cache.bytes)

    @property
    def pending(self) -> int:
        """Number of grids that are computed or queued here."""
        return len(self._jobs)

    @property
    def preparing(self) -> int:
        """Number of plans without a grid in all replicas, queued or not, as of the last `queue_missing`."""
        return max(self.pending, self._unprepared)

    @property
    def model(self) -> tuple[str, float]:
        """Digest of the model and grid step (m), the parts of a grid's key that all plans share."""
        return self._model_sha256, self._settings.grids.grid_step_m

    def key(self, revision_id: str, camera_height_m: float) -> GridKey:
        """Return the key of a revision's grid for this model and grid step."""
        return GridKey(
            revision_id=revision_id,
            model_sha256=self._model_sha256,
            step_m=self._settings.grids.grid_step_m,
            camera_height_mm=millimetres(camera_height_m),
        )

    def states(self, plans: list[PlanSummary]) -> list[GridState]:
        """Return the state of each plan's own grid, whichever replica computes it."""
        keys = [self.key(summary.revision_id, summary.camera_height_m) for summary in plans]
        revision_ids = [summary.revision_id for summary in plans]
        places = [(key.revision_id, key.camera_height_mm) for key in keys]
        jobs = [self._jobs.get(key) for key in keys]
        stored = self._store.grids.poses(*self.model, revision_ids)
        leased = {}
        if not all(place in stored for place in places):
            leased = self._store.leases.progress(*self.model, revision_ids)
            # Read again, because a grid can have been stored, and its lease ended, in between.
            stored = self._store.grids.poses(*self.model, revision_ids)
        return [
            GridState.of_stored(summary.failure, stored.get(place), leased.get(place), job)
            for summary, place, job in zip(plans, places, jobs, strict=True)
        ]

    def prepare(self, plan: FloorPlan, client: str) -> ComputedGrid | None:
        """Compute the own grid of a client's small plan at once; None leaves it to the background."""
        if self._estimate(plan) > self._settings.grids.inline_grid_poses:
            return None
        try:
            hold = partial(self._cores.hold, client)
            # Work of a few milliseconds needs one core; each core can wake another thread.
            is_brief = self._estimate(plan) <= RENDERED
            with hold() if is_brief else nullcontext():
                part = nullcontext if is_brief else hold
                with self._telemetry.grid_seconds.time():
                    grid = embed(
                        plan,
                        self._encoders,
                        step_m=self._settings.grids.grid_step_m,
                        camera_height_m=millimetres(plan.camera_height_m) / 1000.0,
                        computing=part,
                    )
                with part():
                    prototypes = SortedPrototypes.of_grid(grid, plan)
            return ComputedGrid(model_sha256=self._model_sha256, grid=grid, prototypes=prototypes)
        except Exception:
            # The background will fail as well, and store the error with the plan.
            logging.getLogger(LOGGER_NAME).exception("pose grid failed")
            return None

    def prepare_all(self, plans: Sequence[FloorPlan], client: str) -> list[ComputedGrid | None]:
        """Compute the own grids of a client's plans at once, as `prepare` does for one.

        Small plans come first, and the total is limited; the background computes the others.
        """
        limit, poses = self._settings.grids.inline_grid_poses, [self._estimate(plan) for plan in plans]
        order = sorted(range(len(plans)), key=lambda number: poses[number])
        total, chosen = 0, list[int]()
        for number in order:
            total += poses[number]
            if poses[number] > limit or total > _INLINE_TOTAL * limit:
                break
            chosen.append(number)
        # In the order of the file, whose neighbours are often alike.
        chosen.sort()
        found: list[ComputedGrid | None] = [None] * len(plans)
        if not self._encoders.predicts_profile or len(chosen) < 2:
            for number in chosen:
                found[number] = self.prepare(plans[number], client)
            return found
        made = self._embed_small([plans[number] for number in chosen], client)
        for number, (grid, prototypes) in zip(chosen, made, strict=False):
            found[number] = ComputedGrid(model_sha256=self._model_sha256, grid=grid, prototypes=prototypes)
        return found

    def _embed_small(self, plans: Sequence[FloorPlan], client: str) -> list[tuple[PoseGrid, SortedPrototypes]]:
        """Return the grids of plans and their prototypes; after an error, those before it."""
        made: list[tuple[PoseGrid, SortedPrototypes]] = []
        step_m, hold = self._settings.grids.grid_step_m, partial(self._cores.hold, client)
        try:
            with self._telemetry.grid_seconds.time():
                for part in embed_small(plans, self._encoders, step_m=step_m, computing=hold):
                    made += part
        except Exception:
            # As in `prepare`.
            logging.getLogger(LOGGER_NAME).exception("pose grids failed")
        return made

    def expected_bytes(self, plan: FloorPlan) -> int:
        """Estimate the stored bytes of a plan's own grid."""
        manifest = self._encoders.manifest
        latent_size = 0 if self._encoders.predicts_profile else manifest.latent_size
        return packed_bytes(self._estimate(plan), manifest.profile_columns, latent_size)

    def on_plan_stored(self, record: PlanRecord, prepared: ComputedGrid | None) -> None:
        """Cache the grid that was stored with a plan, or queue its computation.

        Beyond a share of the cache, small grids enter memory with the first query that reads them, so that the upload
        of thousands of homes does not displace the grids that queries use.
        """
        if prepared is not None:
            put = self.cache.put_unread if len(prepared.grid.poses) <= RENDERED else self.cache.put
            put(prepared.key(record.revision_id), prepared.grid)
            return
        # A grid that cannot be queued now is queued later, here or by another replica.
        with suppress(StoppingError, OverloadedError):
            self.compute(record, record.plan.camera_height_m)

    def make_prototypes(self, key: GridKey, grid_id: int) -> SortedPrototypes | None:
        """Make and store the prototypes of a grid that was stored without; None if the grid was deleted."""
        grid, record = self.cache.find(key), self._store.plans.get_by_revision(key.revision_id)
        if grid is None or record is None:
            return None
        prototypes = SortedPrototypes.of_grid(grid, record.plan)
        self._store.grids.put_prototypes(grid_id, prototypes)
        return prototypes

    def compute(self, record: PlanRecord, camera_height_m: float) -> Future[PoseGrid]:
        """Compute a grid in the background; a second call during the computation returns the same future.

        The future raises `UnknownFloorPlanError` if the plan is deleted, `PlanNotReadyError` if it gets a new revision,
        `StoppingError` if the service stops, and `StoreUnavailableError` if the database fails. It cannot be
        cancelled, because other queries can wait for it.
        """
        key = self.key(record.revision_id, camera_height_m)
        on_demand = key.camera_height_mm != millimetres(record.plan.camera_height_m)
        poses = self._estimate(record.plan)
        return self._jobs.add(key, plan_id=record.id, poses=poses, on_demand=on_demand).future

    def progress(self, key: GridKey) -> float:
        """Return the computed share of a grid, 0 to 1; 0 for one that is not computed here."""
        job = self._jobs.get(key)
        return job.progress if job else 0.0

    def forget(self, revision_ids: set[str]) -> None:
        """Drop grids of deleted revisions from memory, and cancel their computation."""
        self.cache.drop(lambda key, _: key.revision_id in revision_ids)
        for revision_id in revision_ids:
            self._jobs.cancel(revision_id)

    def cancel(self, revision_id: str) -> None:
        """Cancel the grids of a revision that was deleted or replaced."""
        self._jobs.cancel(revision_id)

    def revisions(self) -> set[str]:
        """Return the revisions with grids in memory or in the queue."""
        return {key.revision_id for key, _ in self.cache.items()} | self._jobs.revisions()

    def queue_missing(self) -> bool:
        """Queue the oldest grids that no replica computes, unless the queue is long; tell whether more are left."""
        if len(self._jobs) >= _BATCH:
            return True
        missing = self._store.grids.missing(*self.model, _BATCH)
        self._unprepared = self._store.grids.count_unprepared(*self.model)
        with suppress(StoppingError, OverloadedError):
            for summary in missing:
                key = self.key(summary.revision_id, summary.camera_height_m)
                poses = summary.room_count + int(summary.area_m2 / key.step_m**2)
                self._jobs.add(key, plan_id=summary.id, poses=poses, on_demand=False)
        return len(missing) == _BATCH

    def poll_remote(self) -> None:
        """Read the progress of other replicas, and queue jobs whose lease ended again."""
        jobs = self._jobs.remote()
        if not jobs:
            return
        leased = self._store.leases.progress(*self.model, [job.key.revision_id for job in jobs])
        for job in jobs:
            progress = leased.get((job.key.revision_id, job.key.camera_height_mm))
            if progress is None or job.cancelled.is_set():
                self._jobs.requeue(job)
            else:
                job.progress = progress

    def close(self) -> None:
        """Stop computing; unfinished grids are left to another replica or to the next start."""
        self._jobs.close()

    def _estimate(self, plan: FloorPlan) -> int:
        return grid_size(plan, self._settings.grids.grid_step_m)
