"""Which plans of a venue a query is compared with, and in what form."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from sqlalchemy import Row

from lalaloc_core.bundle import EvidenceModel
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.localise.camera_height import DEFAULT_STD_M, CameraHeight
from lalaloc_core.localise.evidence import EvidenceConfig
from lalaloc_core.localise.poses import LatentGrid, Query
from lalaloc_core.localise.prototypes import Prototypes, joined, log_masses, most_probable
from service.bounded_cache import BoundedCache
from service.grids import GridProvider
from service.schemas import EarthPoint, LocaliseForm
from service.storage import Store
from service.storage.plan_places import distances_m
from service.storage.records import PlanRecord
from service.threads import BoundedReads

# Plans that are searched in full, and what that may come to: poses of all of them, as many as one plan may have, and
# of these times hypotheses of the heading times camera heights.
MAX_SEARCHED = 128
_MAX_COMPARISONS = 8_000_000
# The largest circle around a plan, whose centre may be as far from a place that it covers; and plans near one place.
_LARGEST_REACH_M = 1000.0
_MAX_NEAR = 2000
# Prototypes that are read at a time, so that one read is short.
_AT_ONCE = 1000


@dataclass(frozen=True, eq=False)
class ChosenPlans:
    """What is searched in full, the most probable first.

    Attributes:
        members: the plans as `Venues.searched` tells them.
        log_mass: (p,) of all plans that are ready, chosen or not; see `localise.prototypes`.
        index: (m,) which of those were chosen.
    """

    members: Sequence[Row[Any]]
    log_mass: Float[np.ndarray, "p"]
    index: Int[np.ndarray, "m"]


class VenuePlans:
    """Finds the plans of a venue, and chooses among them by their prototypes, which are kept in memory."""

    def __init__(
        self, store: Store, grids: GridProvider, reads: BoundedReads, *, limit_bytes: int, max_poses: int
    ) -> None:
        """
        Args:
            limit_bytes: memory for prototypes.
            max_poses: that the grids of chosen plans may have in sum.
        """
        self._store = store
        self._grids = grids
        self._reads = reads
        self._max_poses = max_poses
        # By the ids of their grids, which never stand for anything else.
        self._prototypes: BoundedCache[int, Prototypes] = BoundedCache(limit_bytes, lambda one: one.nbytes)

    async def members(self, venue_id: str) -> Sequence[Row[Any]]:
        """All plans of a venue, each once."""
        rows = await self._reads.run(self._store.venues.searched, venue_id, *self._grids.model)
        return list({row.plan_id: row for row in rows}.values())

    async def near(self, tenant: str, place: EarthPoint, within_m: float) -> Sequence[Row[Any]]:
        """Plans of a tenant with an anchor that lie so near a place, the nearest first."""
        latitude, longitude = place.latitude, place.longitude
        reach_m = within_m + _LARGEST_REACH_M
        near = self._store.venues.searched_near
        rows = await self._reads.run(near, tenant, latitude, longitude, reach_m, *self._grids.model)
        away_m = distances_m(rows, None, latitude, longitude)
        order = np.argsort(away_m, kind="stable")
        unique = {rows[k].plan_id: rows[k] for k in order.tolist() if away_m[k] <= within_m}
        return list(unique.values())[:_MAX_NEAR]

    def needs_choice(self, ready: Sequence[Row[Any]], query: Query) -> bool:
        """Whether not all of some plans can be searched in full."""
        return len(ready) > MAX_SEARCHED or sum(row.poses for row in ready) > self._most_poses(query)

    async def prototypes(self, ready: Sequence[Row[Any]]) -> list[tuple[Row[Any], Prototypes]]:
        """Plans that are ready with their prototypes, from memory or from the store.

        Those of grids that an earlier version of the service stored are made of the grid, and stored; plans whose grid
        is not there any more are left out.
        """
        found = {row.grid_id: self._prototypes.get(row.grid_id) for row in ready}
        missing = [grid_id for grid_id, prototypes in found.items() if prototypes is None]
        for first in range(0, len(missing), _AT_ONCE):
            part = missing[first : first + _AT_ONCE]
            found |= await self._reads.run(self._store.grids.prototypes, part)
        known, fresh = [], set(missing)
        for row in ready:
            prototypes = found[row.grid_id]
            if prototypes is None:
                key = self._grids.key(row.revision_id, row.camera_height_m)
                prototypes = await self._reads.run(self._grids.make_prototypes, key, row.grid_id)
            if prototypes is not None:
                known.append((row, prototypes))
                if row.grid_id in fresh:
                    self._prototypes.put(row.grid_id, prototypes)
        return known

    def choose(
        self,
        known: Sequence[tuple[Row[Any], Prototypes]],
        query: Query,
        weights: EvidenceModel,
        log_prior: Callable[[Sequence[Row[Any]]], Float[np.ndarray, "p"]],
    ) -> ChosenPlans:
        """The most probable plans; takes a while with many.

        Args:
            log_prior: what is known of plans beforehand; -inf for those that are excluded.

        Raises:
            InvalidHintError: all are.
        """
        counts = [len(prototypes) for _, prototypes in known]
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        all_of_them = joined([prototypes for _, prototypes in known])
        log_mass = log_masses(all_of_them, first, query, weights, EvidenceConfig())
        log_mass = log_mass + log_prior([row for row, _ in known])
        if not np.isfinite(log_mass).any():
            raise InvalidHintError("strict", f"all hints hold in none of the {len(known)} floor plans that are ready")
        poses = np.array([row.poses for row, _ in known])
        index = most_probable(log_mass, poses, most_plans=MAX_SEARCHED, most_poses=self._most_poses(query))
        index = index[np.isfinite(log_mass[index])]
        return ChosenPlans([known[k][0] for k in index], log_mass, index)

    async def load(self, tenant: str, members: Sequence[Row[Any]]) -> list[tuple[Row[Any], PlanRecord, LatentGrid]]:
        """Chosen plans with their grids; those that were deleted or replaced a moment ago are left out."""
        loaded = []
        for row in members:
            record = await self._reads.run(self._store.plans.get_revision, tenant, row.plan_id, row.revision_id)
            key = self._grids.key(row.revision_id, row.camera_height_m)
            grid = self._grids.cached(key) or await self._reads.run(self._grids.find, key)
            if record is not None and grid is not None:
                loaded.append((row, record, grid))
        return loaded

    def _most_poses(self, query: Query) -> int:
        compared = len(query.roll) * len(query.camera_height.offsets)
        return min(self._max_poses, _MAX_COMPARISONS // compared)


def venue_height(form: LocaliseForm, ready: Sequence[Row[Any]]) -> CameraHeight:
    """What is known of the camera's height before anything is compared, the same for all plans of a venue.

    What the request says, else what all plans say, if they say the same; else nothing: then any height is possible.
    """
    if form.camera_height_m is not None:
        std_m = DEFAULT_STD_M if form.camera_height_std_m is None else form.camera_height_std_m
        return CameraHeight(form.camera_height_m, std_m)
    said = Counter((row.camera_height_m, row.camera_height_std_m) for row in ready)
    (height_m, std_m), _ = said.most_common(1)[0]
    if len(said) > 1 or std_m is None:
        std_m = math.inf
    return CameraHeight(height_m, std_m if form.camera_height_std_m is None else form.camera_height_std_m)
