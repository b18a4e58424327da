"""Latent grids: computed in the background, kept in the store, cached in memory up to a number of bytes."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from lalaloc_core.errors import InvalidPoseError, LaLaLocError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.poses import LatentGrid
from lalaloc_core.sampling import PoseSet, grid_size, pose_grid
from service.errors import OverloadedError, PlanTooLargeError, StoppingError, UnknownFloorPlanError
from service.schemas import PlanStatus
from service.settings import Settings
from service.store import GridKey, PlanRecord, PlanSummary, Store
from service.telemetry import LOGGER_NAME, Telemetry

# Another camera height is rounded to this, so that a plan needs few grids.
HEIGHT_STEP_M = 0.02
# Rays times walls that are cast at once: bounds the memory of a plan with rooms of many corners.
_CAST_AT_ONCE = 2_000_000
_MAX_CHUNK, _MIN_CHUNK = 256, 8
_MAX_PENDING_HEIGHTS = 16


@dataclass(frozen=True)
class GridState:
    """How far a plan's own latent grid is; `poses` is None until it is computed."""

    status: PlanStatus
    progress: float
    poses: int | None
    reason: str | None = None


@dataclass(eq=False)
class _Task:
    on_demand: bool
    future: Future[LatentGrid]
    cancelled: threading.Event = field(default_factory=threading.Event)
    progress: float = 0.0


class Grids:
    """Finds or computes latent grids; safe to share between threads."""

    def __init__(
        self, store: Store, encoders: Encoders, model_sha256: str, settings: Settings, telemetry: Telemetry
    ) -> None:
        self._store = store
        self._encoders = encoders
        self._model_sha256 = model_sha256
        self._settings = settings
        self._telemetry = telemetry
        self._cache = _Cache(settings.grid_cache_bytes)
        self._lock = threading.Lock()
        self._tasks: dict[GridKey, _Task] = {}
        self._closing = False
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="grids")
        telemetry.gauge("lalaloc_grids_pending", "Latent grids computed or waiting for it.", lambda: self.pending)
        telemetry.gauge("lalaloc_grid_cache_bytes", "Latent grids in memory.", lambda: self._cache.bytes)

    @property
    def pending(self) -> int:
        """Latent grids being computed or waiting for it."""
        return len(self._tasks)

    def key(self, plan_id: str, camera_height_m: float) -> GridKey:
        """The key of a plan's grid for this model and grid step."""
        return GridKey(
            plan_id=plan_id,
            model_sha256=self._model_sha256,
            step_m=self._settings.grid_step_m,
            camera_height_mm=round(camera_height_m * 1000.0),
        )

    def resume(self) -> int:
        """Start computing the grid of every plan that has none for this model; returns how many."""
        stored = self._store.grid_poses(self._model_sha256, self._settings.grid_step_m)
        started = 0
        for summary in reversed(self._store.plans()):
            key = self.key(summary.id, summary.camera_height_m)
            if (summary.id, key.camera_height_mm) not in stored:
                self._store.set_failure(summary.id, None)
                self.compute(key)
                started += 1
        return started

    def states(self, plans: list[PlanSummary]) -> list[GridState]:
        """How far each plan's own grid is."""
        stored = self._store.grid_poses(
            self._model_sha256, self._settings.grid_step_m, [summary.id for summary in plans]
        )
        result = []
        for summary in plans:
            key = self.key(summary.id, summary.camera_height_m)
            poses = stored.get((summary.id, key.camera_height_mm))
            task = self._tasks.get(key)
            if poses is not None:
                result.append(GridState("ready", 1.0, poses))
            elif task is None and summary.failure is not None:
                result.append(GridState("failed", 0.0, None, summary.failure))
            else:
                result.append(GridState("preparing", task.progress if task else 0.0, None))
        return result

    def check_size(self, plan: FloorPlan) -> None:
        """Refuse a plan whose grid would be too large.

        Raises:
            PlanTooLargeError: states the estimated number of poses and the limit.
        """
        estimate = grid_size(plan, self._settings.grid_step_m)
        if estimate > self._settings.max_grid_poses:
            raise PlanTooLargeError(estimate, self._settings.max_grid_poses, self._settings.grid_step_m)

    def find(self, key: GridKey) -> LatentGrid | None:
        """A grid that has been computed before, from memory or from the store."""
        grid = self._cache.get(key)
        if grid is None:
            grid = self._store.grid(key)
            if grid is not None:
                self._cache.put(key, grid)
        return grid

    def compute(self, key: GridKey, *, on_demand: bool = False) -> Future[LatentGrid]:
        """Compute a grid in the background; asking again while that runs gives the same future.

        The future raises UnknownFloorPlanError when the plan is deleted meanwhile, StoppingError when the service
        stops; cancelling it has no effect, others may be waiting for it too.

        Raises:
            OverloadedError: too many grids asked for on demand are waiting already.
            StoppingError: the service stops.
        """
        with self._lock:
            task = self._tasks.get(key)
            if task is not None:
                return task.future
            if on_demand and sum(other.on_demand for other in self._tasks.values()) >= _MAX_PENDING_HEIGHTS:
                raise OverloadedError(_MAX_PENDING_HEIGHTS)
            if self._closing:
                raise StoppingError()
            task = _Task(on_demand, Future())
            task.future.set_running_or_notify_cancel()
            self._tasks[key] = task
            self._executor.submit(self._run, key, task)
            return task.future

    def progress(self, key: GridKey) -> float:
        """Share of a grid that is computed, 0 to 1; 0 also for one that nobody computes."""
        task = self._tasks.get(key)
        return task.progress if task else 0.0

    def forget(self, plan_id: str) -> None:
        """Drop a deleted plan's grids from memory and stop computing them."""
        with self._lock:
            for key, task in self._tasks.items():
                if key.plan_id == plan_id:
                    task.cancelled.set()
        self._cache.drop(plan_id)

    def close(self) -> None:
        """Stop computing; what was not finished is taken up again by `resume` at the next start."""
        with self._lock:
            self._closing = True
            tasks = list(self._tasks.values())
        for task in tasks:
            task.cancelled.set()
        self._executor.shutdown(wait=True)

    def _run(self, key: GridKey, task: _Task) -> None:
        """Compute one grid on the background thread; whatever happens ends up in the task's future."""
        grid: LatentGrid | None = None
        fault: Exception = StoppingError()
        try:
            grid = self.find(key) or self._compute_and_store(key, task)
        except Exception as error:
            fault = error
            self._note_failure(key, task, error)
        # First forget the task, so that who wakes up from the future sees the plan's final state.
        with self._lock:
            del self._tasks[key]
        if grid is not None:
            task.future.set_result(grid)
        else:
            task.future.set_exception(fault)

    def _compute_and_store(self, key: GridKey, task: _Task) -> LatentGrid:
        record = self._store.plan(key.plan_id)
        if record is None:
            raise UnknownFloorPlanError(key.plan_id)
        self.check_size(record.plan)
        with self._telemetry.timed(self._telemetry.grid_seconds):
            grid = self._embed(record.plan, key, task)
        own_height = self.key(key.plan_id, record.plan.camera_height_m).camera_height_mm
        if not self._store.put_grid(key, grid, keep=self._settings.max_grids_per_plan, always_keep_mm=own_height):
            raise UnknownFloorPlanError(key.plan_id)
        self._cache.put(key, grid)
        return grid

    def _embed(self, plan: FloorPlan, key: GridKey, task: _Task) -> LatentGrid:
        """Sample, render and embed the grid in chunks."""
        poses = pose_grid(plan, key.step_m)
        rays = self._encoders.manifest.profile_columns * plan.walls_m.shape[1]
        chunk = min(max(_CAST_AT_ONCE // rays, _MIN_CHUNK), _MAX_CHUNK)
        latents, profiles_m = [], []
        for first in range(0, len(poses), chunk):
            if task.cancelled.is_set():
                raise StoppingError() if self._closing else UnknownFloorPlanError(key.plan_id)
            part = PoseSet(poses.position_m[first : first + chunk], poses.room_index[first : first + chunk])
            latent, profile_m = self._encoders.poses(plan, part, np.zeros(len(part)), key.camera_height_m)
            latents.append(latent)
            profiles_m.append(profile_m)
            task.progress = min(first + chunk, len(poses)) / len(poses)
        return LatentGrid(poses, np.concatenate(latents), np.concatenate(profiles_m), key.step_m, key.camera_height_m)

    def _note_failure(self, key: GridKey, task: _Task, error: Exception) -> None:
        logger = logging.getLogger(LOGGER_NAME)
        if isinstance(error, UnknownFloorPlanError | StoppingError):
            logger.info("latent grid abandoned", extra={"fields": {"floorplan": key.plan_id, "reason": str(error)}})
            return
        logger.error("latent grid failed", exc_info=error, extra={"fields": {"floorplan": key.plan_id}})
        if task.on_demand:
            return
        # Only errors raised on purpose have a text that is fit for users.
        reason = str(error) if isinstance(error, LaLaLocError) else "internal error"
        try:
            self._store.set_failure(key.plan_id, reason)
        except Exception:
            logger.exception("cannot record the failure", extra={"fields": {"floorplan": key.plan_id}})


def query_height_m(record: PlanRecord, asked_m: float | None) -> float:
    """The camera height that a query is compared at: the plan's, or the one asked for, rounded to 2 cm.

    Raises:
        InvalidPoseError: not below the lowest ceiling.
    """
    own = record.plan.camera_height_m
    if asked_m is None or abs(asked_m - own) < HEIGHT_STEP_M / 2.0:
        return own
    lowest = float(record.plan.ceiling_heights_m.min())
    if not 0.0 < asked_m < lowest:
        raise InvalidPoseError(
            f"camera_height_m is {asked_m:g}, it must lie above 0 and below the plan's lowest ceiling ({lowest:g} m)"
        )
    steps = max(round(asked_m / HEIGHT_STEP_M), 1)
    if steps * HEIGHT_STEP_M >= lowest:
        steps -= 1
    return steps * HEIGHT_STEP_M


class _Cache:
    """Least recently used grids, up to a number of bytes."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._grids: OrderedDict[GridKey, LatentGrid] = OrderedDict()
        self._lock = threading.Lock()
        self.bytes = 0

    def get(self, key: GridKey) -> LatentGrid | None:
        with self._lock:
            grid = self._grids.get(key)
            if grid is not None:
                self._grids.move_to_end(key)
            return grid

    def put(self, key: GridKey, grid: LatentGrid) -> None:
        with self._lock:
            if key in self._grids:
                self.bytes -= _size(self._grids.pop(key))
            self._grids[key] = grid
            self.bytes += _size(grid)
            while self.bytes > self._limit:
                self.bytes -= _size(self._grids.popitem(last=False)[1])

    def drop(self, plan_id: str) -> None:
        with self._lock:
            for key in [key for key in self._grids if key.plan_id == plan_id]:
                self.bytes -= _size(self._grids.pop(key))


def _size(grid: LatentGrid) -> int:
    arrays = (grid.latents, grid.profile_m, grid.poses.position_m, grid.poses.room_index)
    return sum(array.nbytes for array in arrays)
