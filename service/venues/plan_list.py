"""Rows of the plans of a venue, with the columns and sums that each query needs of them."""

from __future__ import annotations

import hashlib
from bisect import insort
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from functools import cached_property
from operator import itemgetter
from typing import Any, Self

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from sqlalchemy import Row

# Approximate memory of a row.
ROW_BYTES = 600
# Odd factor of the ids of grids in their keys.
_FACTOR = np.uint64(0x9E3779B97F4A7C15)


class PlanList(list[Row[Any]]):
    """Rows of plans as `Venues.searchable_plans` returns them; never changed after it was filled."""

    @cached_property
    def ready(self) -> PlanList:
        """The plans with a pose grid."""
        grids = self._column("grid_id")
        if None not in grids:
            return self
        return PlanList([row for row, grid_id in zip(self, grids, strict=True) if grid_id is not None])

    @cached_property
    def failed(self) -> int:
        """Number of plans whose pose grid failed."""
        columns = zip(self._column("grid_id"), self._column("failure"), strict=True)
        return sum(grid_id is None and failure is not None for grid_id, failure in columns)

    @cached_property
    def poses(self) -> Int[np.ndarray, "p"]:
        """Number of grid poses of each plan that is ready."""
        return np.array(self.ready._column("poses"), np.int64)

    @cached_property
    def area_m2(self) -> Float[np.ndarray, "p"]:
        """Area (m²) of each plan."""
        return np.array(self._column("area_m2"), np.float64)

    @cached_property
    def most_common_height(self) -> tuple[float, float | None, bool]:
        """Camera height (m) and its standard deviation (m) of most plans; True if all plans have them."""
        heights = Counter(zip(self._column("camera_height_m"), self._column("camera_height_std_m"), strict=True))
        (height_m, std_m), _ = heights.most_common(1)[0]
        return height_m, std_m, len(heights) == 1

    @cached_property
    def keys(self) -> UInt64[np.ndarray, "p"]:
        """Key of each plan's pose grid; equal keys of different grids are as rare as equal hashes of 64 bits."""
        digests = np.frombuffer(bytes.fromhex("".join(self._column("grid_sha256"))), np.uint64)
        return digests[::4] + np.array(self._column("grid_id"), np.uint64) * _FACTOR

    @cached_property
    def digest(self) -> bytes:
        """Digest of the plans' pose grids in order."""
        return hashlib.sha256(self.keys.tobytes()).digest()

    @property
    def members(self) -> Iterator[tuple[float, str, str | None]]:
        """Level, id and name in the venue of each plan, as `Venues.members` returns them."""
        return zip(self._column("level"), self._column("plan_id"), self._column("name_in_venue"), strict=True)

    def plan_ids_among(self, plan_ids: Iterable[str]) -> set[str]:
        """Return those ids that are ids of plans in the list."""
        return set(plan_ids).intersection(self._column("plan_id"))

    def updated(self, removed: Collection[str], added: Iterable[Row[Any]]) -> PlanList:
        """Return the list, ordered by level and id, without some plans and with other rows in their places."""
        rows = list(self)
        if removed:
            ids = self._column("plan_id")
            rows = [row for row, plan_id in zip(self, ids, strict=True) if plan_id not in removed]
        for row in added:
            insort(rows, row, key=lambda own: (own.level, own.plan_id))
        return PlanList(rows)

    def chosen(self, kept: Bool[np.ndarray, "p"]) -> PlanList:
        """Return the plans that are kept; this list if all are."""
        return self if kept.all() else PlanList([self[k] for k in np.flatnonzero(kept).tolist()])

    def _column(self, name: str) -> list[Any]:
        """Return a column by its number, which is several times as fast as attributes of rows."""
        return list(map(itemgetter(self[0]._fields.index(name)), self)) if self else []

    @classmethod
    def of(cls, rows: list[Row[Any]]) -> Self:
        """Return rows of plans, each plan once, in order."""
        return cls({row.plan_id: row for row in rows}.values())
